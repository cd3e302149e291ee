// The condition report of a structure over a period, made for print.

import { at, request } from "./api.js";
import { fill, h } from "./dom.js";
import { hosted } from "./report.js";

/** `query` has the ends of the period, `from` and `to`; without them it is the whole record. */
export function condition(id, query) {
  const element = h("div", { class: "view", dataset: { page: "condition-report" } });
  const load = async () => {
    const period = new URLSearchParams([...query].filter(([name]) => name === "from" || name === "to"));
    const html = await (await request(at(id, `/report?${period}`))).text();
    const file = URL.createObjectURL(new Blob([html], { type: "text/html" }));
    fill(
      element,
      h(
        "p",
        { class: "crumbs" },
        h("a", { href: "#/" }, "Fleet"),
        " / ",
        h("a", { href: `#/structures/${encodeURIComponent(id)}` }, id),
        " / Condition report",
      ),
      h(
        "p",
        { class: "buttons start" },
        h("button", { type: "button", class: "primary", onclick: () => window.print() }, "Print or save as PDF"),
        h("a", { class: "button", href: file, download: `condition-${id}.html` }, "Download as an HTML file"),
      ),
      hosted(html),
    );
  };
  return { title: `Condition of ${id}`, element, load };
}
