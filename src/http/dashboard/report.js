// The report of a diagnosis, shown inside the page so that it needs no second sign-in.

import { read, request } from "./api.js";
import { h } from "./dom.js";

const path = (id, rest = "") => `v1/diagnoses/${encodeURIComponent(id)}${rest}`;

/**
 * The report as a document without inline styles, which our policy forbids even to a parser: its sheet waits in a template,
 * its style attributes under another name, until the CSSOM sets them.
 */
function parsed(html) {
  const harmless = html
    .replace(/<style([^>]*)>/g, "<template data-sheet>")
    .replaceAll("</style>", "</template>")
    .replace(/(<[a-z][^<>]*?)\sstyle=/g, "$1 data-style=");
  return new DOMParser().parseFromString(harmless, "text/html");
}

/** The report's own style; it is written for a page of its own, whose root is our shadow root's host. */
function sheetOf(page) {
  const sheet = new CSSStyleSheet();
  const text = [...page.querySelectorAll("template[data-sheet]")].map((style) => style.content.textContent).join("\n");
  sheet.replaceSync(text.replace(/(^|[\s,{}])(?::root|html|body)(?=[\s,{])/g, "$1:host"));
  return sheet;
}

export function report(id) {
  const element = h("div", { class: "view", dataset: { page: "report" } });
  const load = async () => {
    const [diagnosis, html] = await Promise.all([read(path(id)), request(path(id, "/report")).then((r) => r.text())]);
    const page = parsed(html);
    const host = h("article", { class: "report", "aria-label": page.title });
    const root = host.attachShadow({ mode: "open" });
    root.adoptedStyleSheets = [sheetOf(page)];
    page.querySelectorAll("template, script, link, iframe, object, base, meta").forEach((e) => e.remove());
    page.querySelectorAll("[data-style]").forEach((e) => (e.style.cssText = e.dataset.style));
    root.append(...page.body.childNodes);
    const file = URL.createObjectURL(new Blob([html], { type: "text/html" }));
    element.replaceChildren(
      h(
        "p",
        { class: "crumbs" },
        h("a", { href: "#/" }, "Fleet"),
        " / ",
        h("a", { href: `#/structures/${encodeURIComponent(diagnosis.structure)}` }, diagnosis.structure),
        " / diagnosis",
      ),
      h("h1", null, `Diagnosis of ${diagnosis.structure}`),
      h(
        "p",
        null,
        h("a", { href: file, download: `diagnosis-${diagnosis.structure}-${id}.html` }, "Download as one HTML file"),
      ),
      host,
    );
  };
  return { title: "Diagnosis", element, load };
}
