// Requests to the service: token, errors, and paths relative to the page.

const KEY = "modalwatch.token";

/** An error answer of the service, or a request without an answer (status 0). */
export class ApiError extends Error {
  constructor(status, body, requestId) {
    super(body?.detail ?? body?.title ?? `the service answered with HTTP status ${status}`);
    this.status = status;
    this.title = body?.title ?? (status === 0 ? "The service cannot be reached" : `HTTP status ${status}`);
    this.code = body?.code ?? null;
    this.errors = body?.errors ?? [];
    this.requestId = body?.request_id ?? requestId ?? null;
  }
}

let askForToken = null;

/** Registers `ask(error)`, which asks the user for a token. If it resolves to true, the request is sent again. */
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
 * Sends a request with the token; throws `ApiError`. On status 401 the user is asked for a token and the request is repeated,
 * except for background requests (`mayAsk` false), which the user has not triggered.
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
      throw new ApiError(
        0,
        { detail: "The service did not respond. Check that it is running and that the network is available." },
        null,
      );
    }
    if (response.ok) return response;
    const body = await response.json().catch(() => null);
    const error = new ApiError(response.status, body, response.headers.get("x-request-id"));
    // Another request may have obtained a token in the meantime.
    const renewed = response.status === 401 && token() !== sent && token();
    if (renewed) continue;
    if (response.status !== 401 || !mayAsk || !(await askForToken?.(error))) throw error;
  }
}

/** Requests a path and returns its JSON. */
export async function read(path, mayAsk = true) {
  return (await request(path, {}, mayAsk)).json();
}

/** Sends JSON and returns the JSON of the answer. */
export async function send(path, body, method = "POST") {
  const options =
    body === undefined ? {} : { headers: { "content-type": "application/json" }, body: JSON.stringify(body) };
  return (await request(path, { method, ...options })).json();
}

/** API path of a structure, with its id escaped. */
export function at(structure, rest = "") {
  return `v1/structures/${encodeURIComponent(structure)}${rest}`;
}
