// Talks to the service: one place for the token, for errors and for addresses relative to the page.

const KEY = "modalwatch.token";

/** An answer that is no success, or none at all. */
export class ApiError extends Error {
  constructor(status, body, requestId) {
    super(body?.detail ?? body?.title ?? `the service answered ${status}`);
    this.status = status;
    this.title = body?.title ?? (status === 0 ? "The service cannot be reached" : `Answer ${status}`);
    this.code = body?.code ?? null;
    this.errors = body?.errors ?? [];
    this.requestId = body?.request_id ?? requestId ?? null;
  }
}

let askForToken = null;

/** `ask(error)` resolves to true when somebody has given a token, so that the request is sent again. */
export function onUnauthorized(ask) {
  askForToken = ask;
}

export function token() {
  return sessionStorage.getItem(KEY);
}

export function keepToken(value) {
  if (value) sessionStorage.setItem(KEY, value);
  else sessionStorage.removeItem(KEY);
  window.dispatchEvent(new Event("token"));
}

/**
 * A response, with the token along; throws `ApiError`. A 401 asks for a token and tries again, unless the request comes from
 * the background (`mayAsk` false): nobody would know what the question is about.
 */
export async function request(path, options = {}, mayAsk = true) {
  for (;;) {
    const sent = token();
    const headers = new Headers(options.headers);
    if (sent) headers.set("authorization", `Bearer ${sent}`);
    let response;
    try {
      response = await fetch(path, { ...options, headers, cache: "no-store" });
    } catch (cause) {
      if (options.signal?.aborted) throw cause;
      throw new ApiError(0, { detail: "The service did not answer. Is it running, and is the network up?" }, null);
    }
    if (response.ok) return response;
    const body = await response.json().catch(() => null);
    const error = new ApiError(response.status, body, response.headers.get("x-request-id"));
    // Another request may have got a token in the meantime.
    const renewed = response.status === 401 && token() !== sent && token();
    if (renewed) continue;
    if (response.status !== 401 || !mayAsk || !(await askForToken?.(error))) throw error;
  }
}

/** JSON of a path. */
export async function read(path, mayAsk = true) {
  return (await request(path, {}, mayAsk)).json();
}

/** Posts JSON and reads what comes back. */
export async function send(path, body, method = "POST") {
  const options =
    body === undefined ? {} : { headers: { "content-type": "application/json" }, body: JSON.stringify(body) };
  return (await request(path, { method, ...options })).json();
}

/** Path of a structure, its id safe for an address. */
export function at(structure, rest = "") {
  return `v1/structures/${encodeURIComponent(structure)}${rest}`;
}
