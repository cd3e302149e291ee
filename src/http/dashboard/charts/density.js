// Prior, reference and posterior density of each parameter for one batch.

import { h } from "../dom.js";
import { inWords, number, quantity } from "../format.js";
import { acrossAxis, band, chart, curve, draw, edge, rule, valueAxis } from "./base.js";
import { figure, keyList } from "./figure.js";
import { help } from "../help.js";
import { colour } from "./theme.js";

const KEYS = [
  { mark: "band-1", text: "this batch" },
  { mark: "line-3-dash", text: "undamaged reference" },
  { mark: "dash", text: "prior" },
  { mark: "dash-bad", text: "damage threshold δ" },
];

export function densities() {
  const grid = h("div", { class: "grid three", dataset: { figures: "densities" } });
  let charts = [];
  return {
    element: h("div", { class: "stack" }, h("div", { class: "figure-title" }, h("h3", null, "Probability densities"), help("posterior")), keyList(KEYS), grid),
    update(detail) {
      charts.forEach((c) => c.end());
      charts = [];
      grid.replaceChildren();
      for (const p of detail?.parameters ?? []) {
        const frame = figure({ name: `density-${p.name}`, title: inWords(p.name), level: "h4", fileKeys: KEYS });
        grid.append(frame.element);
        if (p.grid.length === 0) {
          frame.empty("No samples for this parameter.");
          continue;
        }
        charts.push(densityChart(frame, p));
      }
    },
  };
}

function densityChart(frame, p) {
  const unit = p.unit && p.unit !== "1" ? p.unit : "";
  const undamaged = p.undamaged ?? p.grid.map(() => null);
  const { u, end } = chart(
    frame.plot,
    {
      height: 190,
      series: [
        {},
        curve("ink-soft", { dash: [6, 4] }),
        curve("curve-3", { dash: [10, 3] }),
        curve("curve-1", { width: 2 }),
        edge(),
      ],
      bands: [band(3, 4, "curve-1", 0.22)],
      axes: [
        acrossAxis(unit ? `${inWords(p.name)} (${unit})` : inWords(p.name)),
        valueAxis(unit ? `density (1/${unit.includes("/") ? `(${unit})` : unit})` : "density"),
      ],
      scales: {
        x: { time: false, range: span(p) },
        y: { range: (u, low, high) => [0, (high || 1) * 1.06] },
      },
      hooks: {
        draw: [
          (u) => {
            rule(u, p.threshold, "bad", [2, 3], "x");
            if (p.threshold !== null && p.threshold !== undefined) label(u, p.threshold);
          },
        ],
        setCursor: [(u) => frame.read(readout(u))],
      },
    },
    [p.grid, p.prior, undamaged, p.posterior, p.grid.map(() => 0)],
  );
  function readout(u) {
    const i = u.cursor.idx;
    if (i === null || i === undefined) return "";
    return `${quantity(p.grid[i], unit)}: this batch ${number(p.posterior[i], 3)}, undamaged reference ${number(undamaged[i], 3)}, prior ${number(p.prior[i], 3)}`;
  }
  const peak = (values) => p.grid[values.indexOf(Math.max(...values))];
  frame.summarise(
    `Density of ${inWords(p.name)}. This batch peaks at ${quantity(peak(p.posterior), unit)}` +
      `${p.undamaged ? `, the undamaged reference at ${quantity(peak(p.undamaged), unit)}` : ""}` +
      `${p.threshold === null || p.threshold === undefined ? "" : `; damage threshold δ ${quantity(p.threshold, unit)}`}. Use the arrow keys to read the values.`,
  );
  const perUnit = unit ? `1/(${unit})` : "1";
  frame.record(() => ({
    columns: [
      unit ? `${inWords(p.name)} (${unit})` : inWords(p.name),
      ...["this batch", "undamaged reference", "prior"].map((words) => `density of ${words} (${perUnit})`),
    ],
    rows: p.grid.map((x, i) => [x, p.posterior[i], undamaged[i], p.prior[i]]),
  }));
  frame.tabulate(() => ({
    columns: [unit ? `${inWords(p.name)} (${unit})` : inWords(p.name), "This batch", "Undamaged reference", "Prior"],
    rows: p.grid.map((x, i) => [
      number(x, 5),
      number(p.posterior[i], 3),
      number(undamaged[i], 3),
      number(p.prior[i], 3),
    ]),
    newestLast: false,
  }));
  return { u, end };
}

/** Share of its peak below which a density is negligible. */
const NEGLIGIBLE = 0.005;
/** Smallest share of the prior range that is shown. */
const LEAST_SHOWN = 0.25;

/** The part of the prior range in which the densities are not negligible, with padding; the table shows the whole range. */
function span({ grid, posterior, undamaged, threshold }) {
  const places = [posterior, undamaged ?? []].flatMap((values) => {
    const peak = Math.max(...values);
    return grid.filter((_, i) => values[i] > NEGLIGIBLE * peak);
  });
  if (threshold !== null && threshold !== undefined) places.push(threshold);
  const [first, last] = [grid[0], grid.at(-1)];
  const [low, high] = [Math.min(...places, last), Math.max(...places, first)];
  const half = Math.max(0.65 * (high - low), 0.5 * LEAST_SHOWN * (last - first));
  const middle = (low + high) / 2;
  return [Math.max(first, middle - half), Math.min(last, middle + half)];
}

function label(u, value) {
  const x = u.valToPos(value, "x", true);
  if (x < u.bbox.left || x > u.bbox.left + u.bbox.width) return;
  draw(u, (pen) => {
    pen.fillStyle = colour("bad");
    pen.font = `${13 * devicePixelRatio}px system-ui, sans-serif`;
    pen.textAlign = "left";
    pen.fillText("δ", x + 4 * devicePixelRatio, u.bbox.top + 13 * devicePixelRatio);
  });
}
