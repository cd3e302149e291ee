// Server-sent events with automatic reconnection. They are read with `fetch`, because `EventSource` cannot send the token
// in a header.

import { request } from "./api.js";

/** A connection without any byte for this long is considered dead: the service sends a heartbeat every 15 s. */
const SILENCE_MS = 40000;
const LONGEST_WAIT_MS = 30000;

/** Parser of an event stream: takes chunks of text and passes each complete `{event, data}` to `deliver`. */
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
 * Follows the event stream at `path` until the page is closed. Calls `on.event(name, data)` for each event, `on.state(state)`
 * with `live`, `reconnecting` or `signed-out`, and `on.missed()` after a lost connection has been restored: the data
 * must then be read again, because events may have been missed.
 */
export function follow(path, on) {
  let failures = 0;
  let wake = null;
  let controller = null;
  /** True while the browser keeps the page in its back/forward cache. The connection is closed then, because browsers allow
   * only six connections per host. */
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

  // Reconnect without delay when the page is shown again, the network returns, or the token changes.
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
