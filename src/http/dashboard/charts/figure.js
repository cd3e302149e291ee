// The frame of every chart: title, legend, plot, a line with the values at the cursor, and the data as a table.

import { fill, h, icon, notify } from "../dom.js";
import { help } from "../help.js";
import { chartsIn } from "./base.js";
import { csv, download, figureSvg, fileName, png } from "./save.js";

/** Maximum number of rows of a table; a longer table is cut, and its caption says so. */
const MOST_ROWS = 500;

let numbering = 0;

/** The legend of one or several figures. */
export function keyList(keys) {
  return h(
    "ul",
    { class: "keys", hidden: keys.length === 0 },
    keys.map(({ mark, text }) => h("li", null, h("span", { class: `mark ${mark}`, "aria-hidden": "true" }), text)),
  );
}

/**
 * Creates a figure. `keys` are the legend entries `{mark, text}`; marks are classes of `figures.css`. Returns the `element`,
 * the `plot` to draw in, `explain(text)` (another hint), and `summarise(text)` (for screen readers), `read(nodes)` (values at the cursor), `empty(text)`
 * (why there is no plot, or `null`), `tabulate(() => ({columns, rows, newestLast}))`, and `record(() => ({columns, rows}))`: exactly the
 * numbers that are plotted, with units in the names of the columns, for a file. `term` is an entry of the glossary; `fileKeys` is the
 * legend in files if the page shows it elsewhere.
 */
export function figure({ title, hint, keys = [], fileKeys = keys, name, level = "h3", tools, term }) {
  numbering += 1;
  const id = `figure-${numbering}`;
  const plot = h("div", {
    class: "plot",
    role: "img",
    tabindex: 0,
    "aria-labelledby": `${id}-title`,
    "aria-describedby": `${id}-summary`,
  });
  const summary = h("p", { class: "hidden-text", id: `${id}-summary` });
  const readout = h("p", { class: "readout" });
  const note = h("p", { class: "empty", hidden: true });
  const table = h("div", {
    class: "table-wrap",
    role: "region",
    tabindex: 0,
    hidden: true,
    id: `${id}-table`,
    "aria-label": `${title} as a table`,
  });
  const toggle = h(
    "button",
    { type: "button", class: "quiet as-table", "aria-expanded": "false", "aria-controls": `${id}-table` },
    icon("table"),
    "Show as table",
  );
  let makeRecord = null;
  const save = (format) => async () => {
    menu.open = false;
    menu.firstChild.focus();
    const structure = element.closest("[data-structure]")?.dataset.structure;
    const heading = structure ? `${structure}: ${title}` : title;
    const file = `${fileName(heading)}.${format}`;
    try {
      if (format === "csv") return download(file, "text/csv", csv(makeRecord()));
      const svg = await figureSvg({ title: heading, keys: fileKeys, charts: chartsIn(plot) });
      if (format === "svg") download(file, "image/svg+xml", svg);
      else download(file, "image/png", await png(svg));
    } catch (error) {
      console.error(error);
      notify(`The file could not be made: ${error.message}`, "error");
    }
  };
  const choice = (format, words) =>
    h("button", { type: "button", class: "quiet", dataset: { format }, onclick: save(format) }, words);
  const menu = h(
    "details",
    { class: "menu" },
    h("summary", null, icon("save"), "Save", h("span", { class: "hidden-text" }, ` ${title}`)),
    h("div", { class: "menu-items" }, choice("png", "PNG"), choice("svg", "SVG"), choice("csv", "CSV (the plotted numbers)")),
  );
  menu.addEventListener("focusout", (event) => {
    if (event.relatedTarget && !menu.contains(event.relatedTarget)) menu.open = false;
  });
  const legend = keyList(keys);
  const explanation = h("p", { class: "fine", hidden: !hint }, hint ?? "");
  const element = h(
    "figure",
    { class: "figure", dataset: { figure: name } },
    h(
      "figcaption",
      null,
      h("div", { class: "figure-title" }, h(level, { id: `${id}-title` }, title), term && help(term)),
      explanation,
      tools,
    ),
    legend,
    note,
    plot,
    summary,
    h("div", { class: "below" }, toggle, menu, readout),
    table,
  );

  let makeTable = null;
  const drawTable = () => {
    if (table.hidden || !makeTable) return;
    const { columns, rows, newestLast = true } = makeTable();
    const shown = newestLast ? rows.slice(-MOST_ROWS).reverse() : rows.slice(0, MOST_ROWS);
    const cut =
      rows.length > shown.length
        ? `, the ${newestLast ? "newest" : "first"} ${shown.length} of ${rows.length} rows`
        : "";
    fill(
      table,
      h(
        "table",
        null,
        h("caption", null, `${title}${cut}`),
        h(
          "thead",
          null,
          h(
            "tr",
            null,
            columns.map((c) => h("th", { scope: "col" }, c)),
          ),
        ),
        h(
          "tbody",
          null,
          shown.map((row) =>
            h(
              "tr",
              null,
              row.map((cell) => h("td", null, cell)),
            ),
          ),
        ),
      ),
    );
  };
  toggle.addEventListener("click", () => {
    table.hidden = !table.hidden;
    toggle.setAttribute("aria-expanded", String(!table.hidden));
    fill(toggle, icon(table.hidden ? "table" : "chart"), table.hidden ? "Show as table" : "Hide table");
    drawTable();
  });
  // Charts share a cursor; only the focused chart announces its values to screen readers.
  plot.addEventListener("focus", () => readout.setAttribute("aria-live", "polite"));
  plot.addEventListener("blur", () => readout.removeAttribute("aria-live"));

  return {
    element,
    plot,
    summarise: (text) => fill(summary, text),
    explain: (text) => {
      explanation.hidden = false;
      fill(explanation, text);
    },
    read: (...nodes) => fill(readout, nodes),
    empty: (text) => {
      note.hidden = !text;
      fill(note, text ?? "");
      plot.hidden = Boolean(text);
      legend.hidden = Boolean(text) || keys.length === 0;
      toggle.hidden = Boolean(text);
      menu.hidden = Boolean(text);
      if (text) fill(plot);
    },
    record: (make) => (makeRecord = make),
    tabulate: (make) => {
      makeTable = make;
      drawTable();
    },
  };
}
