// Construction of DOM elements without a framework, and elements that several views share.

const SVG = "http://www.w3.org/2000/svg";

/** Creates an element: `h("a", { class: "x", href: "#/", onclick: go }, "text", child, [more])`. */
export function h(tag, attributes, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes ?? {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "dataset") Object.assign(element.dataset, value);
    else if (name in PROPERTIES) element[name] = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat(3).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

const PROPERTIES = { value: 1, checked: 1, selected: 1, disabled: 1, hidden: 1, open: 1 };

/** A table cell that carries the name of its column. On narrow screens, tables are shown as cards with these names. */
export function cell(column, ...content) {
  return h("td", { "data-label": column }, h("span", { class: "cell" }, content));
}

/** Replaces the content of an element. */
export function fill(element, ...children) {
  element.replaceChildren(...children.flat(3).filter((c) => c !== null && c !== undefined && c !== false));
  return element;
}

/** SVG paths of the icons, on a 16 × 16 grid. */
const ICONS = {
  check: "M3 8.5l3.2 3.2L13 4.8",
  alarm: "M8 2L15 14H1zM8 6.5v3.5M8 11.8v.4",
  pending: "M8 1.5a6.5 6.5 0 1 0 .01 0M8 4.5V8l2.5 1.8",
  recovering: "M2 4l4.5 5 3-3L14 12M14 7.5V12H9.5",
  silent: "M2 2l12 12M4 8a4 4 0 0 1 1.5-3M10.5 11a4 4 0 0 0 1.2-2.2M8 7.5v1",
  unassessed: "M5.5 6a2.5 2.5 0 1 1 3.5 2.3c-.7.3-1 .8-1 1.5M8 12.5v.4",
  cross: "M3.5 3.5l9 9M12.5 3.5l-9 9",
  note: "M8 2a6 6 0 1 0 .01 0M8 7.5v4M8 4.8v.4",
  save: "M8 2v8M4.5 7L8 10.5 11.5 7M2.5 13.5h11",
  table: "M2 3h12v10H2zM2 6.5h12M2 9.7h12M6.5 3v10",
  chart: "M2 2v12h12M4.5 10.5l3-4 2.5 2 3.5-5",
  sun: "M8 5a3 3 0 1 0 .01 0M8 1v1.5M8 13.5V15M1 8h1.5M13.5 8H15M3 3l1 1M12 12l1 1M13 3l-1 1M4 12l-1 1",
  moon: "M13 10A6 6 0 0 1 6 3a5.5 5.5 0 1 0 7 7z",
  auto: "M8 2a6 6 0 1 0 .01 0M8 2v12M10 3v10M12 4.8v6.5",
  left: "M10 3L5 8l5 5",
  right: "M6 3l5 5-5 5",
  wrench: "M10 6.5a3.5 3.5 0 0 0 4.3-4.3l-2.2 2.2-1.8-.4-.4-1.8L12 .2A3.5 3.5 0 0 0 7.6 4.6L2 10.2a2 2 0 0 0 2.8 2.8z",
};

/** A decorative icon, hidden from screen readers: the text beside it carries the meaning. */
export function icon(name) {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", "0 0 16 16");
  svg.setAttribute("class", "icon");
  svg.setAttribute("aria-hidden", "true");
  const path = document.createElementNS(SVG, "path");
  path.setAttribute("d", ICONS[name]);
  svg.append(path);
  return svg;
}

/** Replaces the content of a list whose entries carry `data-key`, and restores the focus to the button or link that had it. */
export function refill(element, ...children) {
  const focused = element.contains(document.activeElement) ? document.activeElement : null;
  const entry = focused?.closest("[data-key]")?.dataset.key;
  const word = focused?.textContent;
  fill(element, ...children);
  if (entry === undefined) return;
  const same = [...element.querySelectorAll("button, a")].find(
    (other) => other.textContent === word && other.closest("[data-key]")?.dataset.key === entry,
  );
  same?.focus();
}

/** Shows a message at the top of the page; it disappears after some seconds. */
export function notify(message, kind = "note") {
  const notice = h("p", { class: `notice ${kind}` }, icon(kind === "error" ? "alarm" : "note"), message);
  const close = h("button", { type: "button", class: "quiet", "aria-label": "Dismiss" }, icon("cross"));
  close.addEventListener("click", () => notice.remove());
  notice.append(close);
  document.getElementById("notices").append(notice);
  setTimeout(() => notice.remove(), kind === "error" ? 20000 : 6000);
}

/** An error for the user: title, reason, rejected fields, and the request ID under which the service has logged it. */
export function problem(error, retry) {
  const details = (error.errors ?? []).map((e) => h("li", null, h("code", null, e.pointer), ` ${e.message}`));
  return h(
    "div",
    { class: "problem", role: "alert" },
    h("p", null, icon("alarm"), h("strong", null, error.title ?? "Something went wrong")),
    h("p", null, error.message),
    details.length > 0 && h("ul", null, details),
    error.requestId && h("p", { class: "fine" }, "Request ID in the log: ", h("code", null, error.requestId)),
    retry && h("p", null, h("button", { type: "button", onclick: retry }, "Try again")),
  );
}

/**
 * Opens a dialog with a form. If `submit(values)` throws, the error is shown and the dialog stays open. Escape and "Cancel"
 * close it; the focus then returns to where it was. Resolves to the result of `submit`, or to `undefined` if cancelled.
 */
export function ask({ title, body, fields = [], confirm, danger = false, cancel = "Cancel", submit }) {
  return new Promise((resolve) => {
    let outcome;
    const errorBox = h("div", null);
    const inputs = fields.map((field) => {
      const id = `field-${field.name}`;
      const kind = field.type === "textarea" ? "textarea" : "input";
      const input = h(kind, {
        id,
        name: field.name,
        type: kind === "input" ? (field.type ?? "text") : null,
        required: field.required ?? false,
        autocomplete: field.autocomplete ?? "off",
        maxlength: field.maxlength,
        value: field.value ?? "",
        "aria-describedby": field.hint ? `${id}-hint` : null,
      });
      const hint = field.hint && h("span", { class: "fine", id: `${id}-hint` }, field.hint);
      const label = h("label", { for: id }, field.label);
      return h("p", { class: "field" }, field.help ? h("span", null, label, " ", field.help) : label, input, hint);
    });
    const send = h("button", { type: "submit", class: danger ? "danger" : "primary" }, confirm);
    const stop = h("button", { type: "button", onclick: () => dialog.close() }, cancel);
    const form = h(
      "form",
      { method: "dialog" },
      h("h2", { id: "dialog-title" }, title),
      body,
      inputs,
      errorBox,
      h("p", { class: "buttons" }, cancel !== null && stop, send),
    );
    const dialog = h("dialog", { "aria-labelledby": "dialog-title" }, form);
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      send.disabled = true;
      try {
        outcome = (await submit(Object.fromEntries(new FormData(form)))) ?? true;
        dialog.close();
      } catch (error) {
        fill(errorBox, problem(error));
      } finally {
        send.disabled = false;
      }
    });
    const before = document.activeElement;
    dialog.addEventListener("close", () => {
      dialog.remove();
      if (before?.isConnected) before.focus();
      resolve(outcome);
    });
    document.body.append(dialog);
    dialog.showModal();
  });
}

/** A time in seconds as the value of a field for a local time, to the minute. */
export function fieldTime(time_s) {
  const time = new Date(1000 * time_s);
  return new Date(time - 60000 * time.getTimezoneOffset()).toISOString().slice(0, 16);
}

/**
 * Wraps `work` so that it runs at most once every `wait_ms`; calls in between are merged into one that runs afterwards. It does not begin
 * again before it has ended, unless that takes more than half a minute: an answer that arrives late must not take the place of a newer one.
 */
export function throttled(work, wait_ms) {
  const longest_ms = 30_000;
  let waiting = false;
  let running = false;
  let last = -Infinity;
  const plan = () => {
    const rest = Math.max(0, last + wait_ms - performance.now());
    setTimeout(async () => {
      waiting = false;
      running = true;
      last = performance.now();
      try {
        await Promise.race([work(), new Promise((resolve) => setTimeout(resolve, longest_ms))]);
      } finally {
        running = false;
        if (waiting) plan();
      }
    }, rest);
  };
  return () => {
    if (waiting) return;
    waiting = true;
    if (!running) plan();
  };
}

/**
 * Writes what the view at `path` shows into the address, so that it can be kept and passed on. If the user has just followed a link, the
 * address is that of another view already, although this one is still shown: it then stays as it is.
 */
export function keepInAddress(path, parts) {
  if (location.hash.split("?")[0] !== path) return;
  const text = parts.toString();
  history.replaceState(null, "", text ? `${path}?${text}` : path);
}
