// Server-sent events, read by fetch so that the token goes along in a header; connects again by itself.

import { request } from "./api.js";

/** No byte for this long means a dead connection: the service sends a heartbeat every 15 s. */
const SILENCE_MS = 40000;
const LONGEST_WAIT_MS = 30000;

/** Parser of an event stream: feed it text, it hands out `{event, data}`. */
export function parser(deliver) {
  let rest = "";
  let event = "message";
  let data = [];
  return (text) => {
    rest += text;
    const lines = rest.split(/\r\n|\n|\r(?!$)/);
    rest = lines.pop();
    for (const line of lines) {
      if (line === "") {
        if (data.length > 0) deliver({ event, data: data.join("\n") });
        event = "message";
        data = [];
      } else if (!line.startsWith(":")) {
        const [, field, value] = line.match(/^([^:]*):? ?(.*)$/s);
        if (field === "event") event = value;
        else if (field === "data") data.push(value);
      }
    }
  };
}

/**
 * Follows `path` for as long as the page lives. `on.event(name, data)` for each event, `on.state(state)` with `connecting`,
 * `live`, `reconnecting` or `signed-out`, `on.missed()` after a connection was lost: what happened meanwhile has to be read again.
 */
export function follow(path, on) {
  let failures = 0;
  let wake = null;
  let controller = null;
  /** True while the page is left but kept by the browser, which would keep its connection too: there are six for a host. */
  let away = false;

  const attempt = async () => {
    controller = new AbortController();
    let watchdog = null;
    const alive = () => {
      clearTimeout(watchdog);
      watchdog = setTimeout(() => controller.abort(), SILENCE_MS);
    };
    alive();
    try {
      const options = { headers: { accept: "text/event-stream" }, signal: controller.signal };
      const response = await request(path, options, false);
      on.state("live");
      if (failures > 0) on.missed();
      failures = 0;
      const feed = parser(({ event, data }) => on.event(event, JSON.parse(data)));
      const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
      for (;;) {
        const { value, done } = await reader.read();
        if (done) break;
        alive();
        feed(value);
      }
    } finally {
      clearTimeout(watchdog);
    }
  };

  const loop = async () => {
    for (;;) {
      const error = await attempt().catch((error) => error);
      failures += 1;
      on.state(error?.status === 401 ? "signed-out" : "reconnecting");
      const wait = Math.min(LONGEST_WAIT_MS, 500 * 2 ** Math.min(failures, 6)) * (0.75 + 0.5 * Math.random());
      await new Promise((resolve) => {
        wake = resolve;
        if (!away) setTimeout(resolve, wait);
      });
    }
  };

  // A laptop that wakes up, a network that comes back, a token just given: no need to wait.
  window.addEventListener("pagehide", () => {
    away = true;
    controller?.abort();
  });
  window.addEventListener("pageshow", () => {
    away = false;
    wake?.();
  });
  window.addEventListener("online", () => wake?.());
  window.addEventListener("token", () => {
    controller?.abort();
    wake?.();
  });
  loop();
}
