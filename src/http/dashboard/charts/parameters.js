// For each parameter, the mean with its 90 % interval and the threshold, and below it the probability of damage.

import { h } from "../dom.js";
import { changePercent, count, inWords, local, number, percent, percentWithin, scale, timeElement } from "../format.js";
import {
  band,
  chart,
  curve,
  draw,
  edge,
  fewPoints,
  mark,
  merged,
  rule,
  seconds,
  shade,
  timeAxis,
  valueAxis,
  withGaps,
} from "./base.js";
import { figure, keyList } from "./figure.js";
import { drawNotes } from "./notes.js";
import { help } from "../help.js";
import { colour } from "./theme.js";
import { paddedRange } from "./tracks.js";

const KEYS = [
  { mark: "line-1", text: "mean" },
  { mark: "band-1", text: "90 % interval" },
  { mark: "dash-bad", text: "damage threshold δ" },
  { mark: "dash", text: "mean of the reference" },
  { mark: "line-2", text: "probability of damage" },
  { mark: "dash-2", text: "probability in the reference" },
  { mark: "cross", text: "withheld: batch rejected" },
  { mark: "alarm-span", text: "alarm" },
  { mark: "maintenance-span", text: "maintenance" },
  { mark: "note-flag", text: "note" },
];

/** Name of the control chart for the fit of the simulation; all other charts have the name of their parameter. */
export const FIT_CHART = "simulation:fit";

/** Name of the control chart of all parameters together. */
export const JOINT_CHART = "structure:joint";

/** End of an open alarm: later than any measurement, in seconds. */
const OPEN_END_S = 1e11;

/** Time spans `[from_s, to_s]` of the alarms of a chart, without withdrawn ones. */
export function alarmSpans(alarms, chart) {
  const isOfChart = (a) =>
    chart === FIT_CHART
      ? a.kind === "simulation_does_not_fit"
      : a.kind === "damage" && (chart === JOINT_CHART || a.parameters.includes(chart));
  return alarms
    .filter((a) => isOfChart(a) && a.state !== "withdrawn")
    .map((a) => [seconds(a.opened_at), a.ended_at ? seconds(a.ended_at) : OPEN_END_S]);
}

/** IDs of rejected batches, whose probability of damage is withheld. Batches of the reference have no probability either. */
export function rejectedBatches(series) {
  return new Set(series.trust.filter((item) => item.verdict === "rejected").map((item) => item.batch));
}

/** Charts of all parameters in a grid; `selectBatch(id)` is called when the user selects a point. */
export function parameters(group, selectBatch) {
  const grid = h("div", { class: "grid", dataset: { figures: "parameters" } });
  const made = new Map();
  return {
    element: h("div", { class: "stack" }, h("div", { class: "figure-title" }, h("h3", null, "Parameters and probability of damage"), help("probability of damage")), keyList(KEYS), grid),
    update(series, usual) {
      const names = series.parameters.map((p) => p.name);
      for (const [name, one] of made) {
        if (!names.includes(name)) {
          one.end();
          one.element.remove();
          made.delete(name);
        }
      }
      for (const parameter of series.parameters) {
        if (!made.has(parameter.name)) {
          const one = parameterFigure(group, parameter, selectBatch);
          made.set(parameter.name, one);
          grid.append(one.element);
        }
        made.get(parameter.name).update(parameter, series, usual);
      }
    },
  };
}

function parameterFigure(group, { name, unit }, selectBatch) {
  const frame = figure({ name: `parameter-${name}`, title: inWords(name), level: "h4", fileKeys: KEYS });
  let charts = [];
  const end = () => {
    charts.forEach((c) => c.end());
    charts = [];
  };

  const update = (given, series, usual) => {
    end();
    const p = inReadableUnit(given, unit);
    const title = p.unit ? `${inWords(name)} (${p.unit})` : inWords(name);
    if (p.times.length === 0) return frame.empty("No assessed batch in this time span.");
    frame.empty(null);
    const filled = withGaps(p.times.map(seconds), [
      p.mean,
      p.low,
      p.high,
      p.probability_of_damage,
      p.pod_low,
      p.pod_high,
    ]);
    const [mean, lower, upper, pod, podLow, podHigh] = filled.columns;
    const alarms = alarmSpans(series.alarms, name);
    const windows = series.maintenance.map((w) => [seconds(w.from), seconds(w.to)]);
    const background = (u) => {
      shade(u, windows, "maintenance");
      drawNotes(u, series.notes);
      shade(u, alarms, "bad", { opacity: 0.16 });
      shade(u, filled.gaps, "ink-soft", { striped: true });
    };
    const select = (index) => filled.origin[index] >= 0 && selectBatch(p.batches[filled.origin[index]]);
    const points = fewPoints(p.times.length);
    const include = [p.threshold, p.undamaged_mean].filter((v) => v !== null && v !== undefined);

    const above = merged(group.options(), {
      height: 175,
      select,
      series: [{}, curve("curve-1", { points }), edge(), edge()],
      bands: [band(3, 2, "curve-1", 0.22)],
      axes: [timeAxis(false), valueAxis(title), changeAxis(p.undamaged_mean, unit)],
      scales: {
        y: {
          range: (u, a, b) => paddedRange(Math.min(a ?? Infinity, ...include), Math.max(b ?? -Infinity, ...include)),
        },
      },
      hooks: {
        drawClear: [background],
        draw: [
          (u) => {
            rule(u, p.undamaged_mean, "ink-soft");
            rule(u, p.threshold, "bad", [2, 3]);
          },
        ],
        setCursor: [(u) => frame.read(readout(u))],
      },
    });
    const rejected = rejectedBatches(series);
    const isWithheld = (row) => row >= 0 && rejected.has(p.batches[row]);
    const withheld = filled.times.filter((_, i) => pod[i] === null && isWithheld(filled.origin[i]));
    const below = merged(group.options(), {
      height: 135,
      select,
      series: [{}, curve("curve-2", { points }), edge(), edge()],
      bands: [band(3, 2, "curve-2", 0.22)],
      axes: [
        timeAxis(),
        valueAxis("probability (%)", { values: (u, splits) => splits.map((v) => String(Math.round(100 * v))) }),
        // Keeps the time axes of both charts aligned.
        changeAxis(null, unit),
      ],
      scales: { y: { range: [-0.04, 1.04] } },
      hooks: {
        drawClear: [background],
        draw: [
          (u) => {
            rule(u, usual, "curve-2", [6, 4]);
            crosses(u, withheld);
          },
        ],
      },
    });
    charts = [
      chart(frame.plot, above, [filled.times, mean, lower, upper], frame.plot),
      chart(frame.plot, below, [filled.times, pod, podLow, podHigh], null),
    ];

    function readout(u) {
      const row = filled.origin[u.cursor.idx ?? -1] ?? -1;
      if (row < 0) return "";
      const damage = p.probability_of_damage[row] ?? null;
      const damageText =
        damage === null
          ? isWithheld(row)
            ? "probability of damage withheld"
            : "not compared with an undamaged reference"
          : `probability of damage ${percentWithin(damage, p.pod_low[row], p.pod_high[row])}`;
      return [
        timeElement(p.times[row]),
        ` · ${number(p.mean[row])} ${p.unit} (${number(p.low[row])} to ${number(p.high[row])})${changeText(p, row)} · ${damageText}`,
      ];
    }
    const last = p.probability_of_damage.at(-1);
    frame.summarise(
      `${count(p.times.length, "batch", "batches")} to ${local(p.times.at(-1))}. Latest mean ${number(p.mean.at(-1))} ${p.unit}` +
        `${p.threshold === null ? "" : `, threshold ${number(p.threshold)} ${p.unit}`}${changeText(p, p.times.length - 1)}, probability of damage ` +
        `${last === null || last === undefined ? "not available" : percent(last)}; withheld for ${count(withheld.length, "batch", "batches")}. ` +
        "Use the arrow keys to read the values and Enter to open the batch.",
    );
    const inUnit = (words) => (p.unit ? `${words} (${p.unit})` : words);
    frame.record(() => ({
      columns: [
        "time",
        inUnit(`mean of ${inWords(name)}`),
        inUnit("lower end of its 90 % interval"),
        inUnit("upper end of its 90 % interval"),
        "probability of damage (1)",
        "lower end of its 90 % interval (1)",
        "upper end of its 90 % interval (1)",
        inUnit("damage threshold"),
        inUnit("mean of the undamaged reference"),
        "batch",
      ],
      rows: p.times.map((time, i) => [
        time,
        p.mean[i],
        p.low[i],
        p.high[i],
        p.probability_of_damage[i],
        p.pod_low[i],
        p.pod_high[i],
        p.threshold,
        p.undamaged_mean,
        p.batches[i],
      ]),
    }));
    frame.tabulate(() => ({
      columns: [
        "Time",
        `Mean${p.unit ? ` (${p.unit})` : ""}`,
        "90 % interval of the mean",
        "Probability of damage",
        "90 % interval of the probability",
      ],
      rows: p.times.map((time, i) => [
        timeElement(time),
        number(p.mean[i]),
        `${number(p.low[i])} to ${number(p.high[i])}`,
        (p.probability_of_damage[i] ?? null) === null
          ? isWithheld(i)
            ? "withheld"
            : "–"
          : percent(p.probability_of_damage[i]),
        (p.pod_low[i] ?? null) === null ? "–" : `${percent(p.pod_low[i])} to ${percent(p.pod_high[i])}`,
      ]),
    }));
  };
  const changeText = (p, row) =>
    Number.isFinite(p.undamaged_mean) && Number.isFinite(p.mean[row])
      ? ` · ${signed(changePercent(p.mean[row] / p.factor, p.undamaged_mean / p.factor, unit))} % of the undamaged mean`
      : "";
  return { element: frame.element, update, end };
}

export const signed = (value) => `${value < 0 ? "−" : "+"}${number(Math.abs(value), 2)}`;

/** The values of a parameter in a unit with a prefix, so that they are easy to read. */
function inReadableUnit(p, unit) {
  const { unit: shown, factor } = scale(unit, p.undamaged_mean ?? p.mean.find((v) => v !== null));
  const times = (value) => (value === null || value === undefined ? value : factor * value);
  return {
    ...p,
    unit: shown,
    factor,
    mean: p.mean.map(times),
    low: p.low.map(times),
    high: p.high.map(times),
    threshold: times(p.threshold),
    undamaged_mean: times(p.undamaged_mean),
  };
}

/** Steps of the axis of changes, per cent. */
const CHANGE_STEPS = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500];

/** The second axis of values: their change from the mean of the undamaged reference in per cent. Without a mean it is empty. */
function changeAxis(reference, unit) {
  const known = Number.isFinite(reference) && reference !== 0;
  const valueAt = (change) =>
    unit === "ln" ? reference + Math.log1p(change / 100) : reference * (1 + change / 100);
  return valueAxis(null, {
    scale: "y",
    side: 1,
    size: 44,
    grid: { show: false },
    splits: (u, axis, low, high) => {
      if (!known) return [];
      const ends = [low, high].map((v) => changePercent(v, reference, unit)).sort((a, b) => a - b);
      const step = CHANGE_STEPS.find((s) => (ends[1] - ends[0]) / s <= 6) ?? 1000;
      const ticks = [];
      for (let n = Math.ceil(ends[0] / step); n * step <= ends[1]; n += 1) ticks.push(valueAt(n * step));
      return ticks;
    },
    values: (u, splits) =>
      splits.map((v) => {
        const change = changePercent(v, reference, unit);
        return Math.abs(change) < 1e-6 ? "0 %" : `${signed(change)} %`;
      }),
  });
}

/** Crosses where the probability is withheld. */
function crosses(u, withheld) {
  draw(u, (pen) => {
    pen.strokeStyle = colour("bad");
    pen.lineWidth = 2 * devicePixelRatio;
    for (const time of withheld) {
      const x = u.valToPos(time, "x", true);
      if (x < u.bbox.left || x > u.bbox.left + u.bbox.width) continue;
      mark(pen, "cross", x, u.bbox.top + u.bbox.height - 8 * devicePixelRatio, 8);
    }
  });
}
