// The mode shapes of a batch: measured and simulated ones in the drawing of the structure, and their MAC as a table.

import { at, request } from "../api.js";
import { motion } from "../charts/motion.js";
import { cell, fill, h } from "../dom.js";
import { count, number } from "../format.js";
import { help } from "../help.js";

/** `update(batch, found)` takes the `mode_shapes` of the detail of a batch; without any, nothing is shown. */
export function shapes(structure) {
  const place = h("div", { class: "drawing" });
  const picker = h("select", { id: "batch-shape", onchange: () => load() });
  const moving = motion();
  const table = h("div", { class: "table-wrap", role: "region", tabindex: 0, "aria-label": "MAC of the mode shapes" });
  const element = h(
    "div",
    { class: "figure", dataset: { shapes: structure }, hidden: true },
    h("div", { class: "figure-title" }, h("h3", null, "Mode shapes"), help("MAC")),
    h("p", { class: "row" }, h("label", { for: "batch-shape" }, "Measured mode"), picker, moving.button),
    place,
    h(
      "p",
      { class: "fine" },
      "Dashed green: simulated with the parameters of the batch. Violet circles: the mean of the measured shapes at the measured points. " +
        "The modal assurance criterion (MAC) says how alike two shapes are: 1 for equal shapes of any size, 0 for shapes without resemblance.",
    ),
    table,
  );
  let shown = null;

  const load = async () => {
    const batch = shown;
    const query = new URLSearchParams({ mode: picker.value, batch });
    const answer = await request(at(structure, `/drawing.svg?${query}`));
    const svg = new DOMParser().parseFromString(await answer.text(), "image/svg+xml").documentElement;
    if (batch !== shown) return;
    const drawn = document.importNode(svg, true);
    fill(place, drawn);
    moving.watch(drawn);
  };

  return {
    element,
    async update(batch, found) {
      shown = batch;
      element.hidden = !found;
      if (!found) return;
      const chosen = picker.value;
      fill(
        picker,
        found.measured.map((m) => h("option", { value: m.mode }, `mode ${m.mode}`)),
      );
      if (found.measured.some((m) => String(m.mode) === chosen)) picker.value = chosen;
      fill(table, macTable(found));
      await load();
    },
  };
}

function macTable({ simulated, measured }) {
  const columns = simulated.map((s) => `Simulated ${s.mode} (${number(s.frequency_hz)} Hz)`);
  const line = (m) =>
    h(
      "tr",
      null,
      h("th", { scope: "row" }, `Measured ${m.mode}`),
      m.mac.map((mac, i) => {
        const text = mac.toFixed(3);
        return cell(columns[i], i + 1 === m.simulated_mode ? h("strong", null, text) : text);
      }),
      cell(
        "Single shapes",
        m.measurements === 1
          ? "1 measurement"
          : `${m.mac_lowest.toFixed(3)} to ${m.mac_highest.toFixed(3)}, ${count(m.measurements, "measurement")}`,
      ),
    );
  return h(
    "table",
    { class: "cards" },
    h("caption", null, "MAC of the measured with the simulated shapes; bold: the simulated mode that belongs to the measured one"),
    h(
      "thead",
      null,
      h(
        "tr",
        null,
        ["Mode", ...columns, "Single shapes"].map((c) => h("th", { scope: "col" }, c)),
      ),
    ),
    h("tbody", null, measured.map(line)),
  );
}
