// The report of a diagnosis. It is shown inside this page, so that it is requested with the token of this tab.

import { read, request } from "./api.js";
import { fill, h, icon } from "./dom.js";

const path = (id, rest = "") => `v1/diagnoses/${encodeURIComponent(id)}${rest}`;

/**
 * Parses the report. The content security policy forbids inline styles even in parsed documents. The style sheet is therefore
 * moved to a template and `style` attributes are renamed to `data-style`; both are applied later through the CSSOM.
 */
function parsed(html) {
  const withoutStyles = html
    .replace(/<style([^>]*)>/g, "<template data-sheet>")
    .replaceAll("</style>", "</template>")
    .replace(/(<[a-z][^<>]*?)\sstyle=/g, "$1 data-style=");
  return new DOMParser().parseFromString(withoutStyles, "text/html");
}

/** The style sheet of the report. Rules for the root of its page apply to the host of the shadow root instead. */
function sheetOf(page) {
  const sheet = new CSSStyleSheet();
  const text = [...page.querySelectorAll("template[data-sheet]")].map((style) => style.content.textContent).join("\n");
  sheet.replaceSync(text.replace(/(^|[\s,{}])(?::root|html|body)(?=[\s,{])/g, "$1:host"));
  return sheet;
}

/** A report as an element of this page: its HTML in a shadow root, with its own style sheet and without anything that runs or loads. */
export function hosted(html) {
  const page = parsed(html);
  const host = h("article", { class: "report", "aria-label": page.title });
  const root = host.attachShadow({ mode: "open" });
  root.adoptedStyleSheets = [sheetOf(page)];
  page.querySelectorAll("template, script, link, iframe, object, base, meta").forEach((e) => e.remove());
  page.querySelectorAll("[data-style]").forEach((e) => (e.style.cssText = e.dataset.style));
  root.append(...page.body.childNodes);
  return host;
}

export function report(id) {
  const element = h("div", { class: "view", dataset: { page: "report" } });
  const load = async () => {
    const [diagnosis, html] = await Promise.all([read(path(id)), request(path(id, "/report")).then((r) => r.text())]);
    const host = hosted(html);
    const file = URL.createObjectURL(new Blob([html], { type: "text/html" }));
    fill(
      element,
      h(
        "p",
        { class: "crumbs" },
        h("a", { href: "#/" }, "Fleet"),
        " / ",
        h("a", { href: `#/structures/${encodeURIComponent(diagnosis.structure)}` }, diagnosis.structure),
        " / Diagnosis",
      ),
      h("h1", null, `Diagnosis of ${diagnosis.structure}`),
      diagnosis.result?.lasting_change &&
        h(
          "p",
          { class: "callout bad", dataset: { finding: "lasting-change" } },
          icon("alarm"),
          diagnosis.result.lasting_change.sentence,
        ),
      h(
        "p",
        null,
        h("a", { href: file, download: `diagnosis-${diagnosis.structure}-${id}.html` }, "Download as an HTML file"),
      ),
      host,
    );
  };
  return { title: "Diagnosis", element, load };
}
