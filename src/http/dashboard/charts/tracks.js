// Frequencies over time, one panel per mode, with the covariates below. Pauses are striped, missing modes are marked.

import { count, local, number, quantity, timeElement } from "../format.js";
import { GAP_SHARE, chart, curve, draw, fewPoints, mark, merged, seconds, shade, timeAxis, valueAxis } from "./base.js";
import { figure } from "./figure.js";
import { drawNotes } from "./notes.js";
import { colour } from "./theme.js";

const LANE_PX = 112;

/** Units by the end of the name of a covariate, which is left out where the label names the unit. */
const UNITS = {
  c: "°C",
  k: "K",
  hz: "Hz",
  n: "N",
  kn: "kN",
  m: "m",
  mm: "mm",
  percent: "%",
  pa: "Pa",
  kpa: "kPa",
  bar: "bar",
  kg: "kg",
  t: "t",
  v: "V",
  s: "s",
};

/** The label of a covariate with its unit, which is stated in the structure file or at the end of the name. */
export function covariateLabel(name, unit) {
  const cut = name.lastIndexOf("_");
  const ending = name.endsWith("m_per_s") ? "m/s" : UNITS[name.slice(cut + 1)];
  const rest = name.endsWith("m_per_s") ? name.slice(0, -8) : name.slice(0, cut);
  const plain = cut > 0 && unit && unit === ending ? rest : name;
  const words = plain.replaceAll("_", " ");
  return { label: unit ? `${words} (${unit})` : words, unit: unit ?? "" };
}

/** Values of mode `m` in all measurements of the series. */
const lane = (frequencies, m) => frequencies.values_hz.map((row) => row?.[m] ?? null);

export function tracks(group) {
  const frame = figure({
    name: "tracks",
    title: "Measured frequencies and covariates",
    term: "covariate",
    hint: "One panel per mode. Drag to zoom, double-click to reset.",
    keys: [
      { mark: "line-1", text: "frequency (Hz)" },
      { mark: "dash", text: "nominal frequency" },
      { mark: "line-3", text: "covariate" },
      { mark: "cross", text: "mode not identified" },
      { mark: "striped", text: "no measurements" },
    ],
  });
  let charts = [];

  return {
    element: frame.element,
    update({ frequencies, maintenance, notes, reduced }) {
      charts.forEach((c) => c.end());
      charts = [];
      const times = frequencies?.times.map(seconds) ?? [];
      if (times.length === 0) return frame.empty("No measurements in this time span.");
      frame.empty(null);
      const modes = Array.from({ length: frequencies.modes }, (_, m) => lane(frequencies, m));
      const covariates = Object.entries(frequencies.covariates ?? {});
      const units = frequencies.covariate_units ?? {};
      const isPause = times.map((_, i) =>
        [...modes, ...covariates.map(([, values]) => values)].every((values) => (values[i] ?? null) === null),
      );
      const pauses = times.flatMap((_, i) =>
        isPause[i] ? [[times[i - 1] ?? times[i], times[i + 1] ?? times[i]]] : [],
      );
      // Measurements may arrive in bursts with a pause after each; only pauses much longer than the usual one are striped.
      const lengths = pauses.map(([from, to]) => to - from).sort((a, b) => a - b);
      const usual = lengths.length > 4 ? 2 * lengths[Math.floor(lengths.length / 2)] : 0;
      const least = Math.max(usual, GAP_SHARE * (times.at(-1) - times[0]));
      const gaps = pauses.filter(([from, to]) => to - from > least);
      const windows = maintenance.map((w) => [seconds(w.from), seconds(w.to)]);
      const lanes = [
        ...modes.map((values, m) => ({
          label: `mode ${m + 1} (Hz)`,
          values,
          nominal: frequencies.nominal_hz?.[m],
          colour: "curve-1",
          missing: true,
        })),
        ...covariates.map(([name, values]) => ({ ...covariateLabel(name, units[name]), values, colour: "curve-3" })),
      ];
      lanes.forEach((one, index) => {
        const last = index === lanes.length - 1;
        const holes = one.missing ? times.filter((_, i) => !isPause[i] && one.values[i] === null) : [];
        const options = merged(group.options(), {
          height: LANE_PX + (last ? 32 : 0),
          series: [{}, curve(one.colour, { points: fewPoints(times.length) })],
          axes: [timeAxis(last), valueAxis(one.label)],
          scales: { y: { range: (u, low, high) => paddedRange(low, high) } },
          hooks: {
            drawClear: [
              (u) => {
                shade(u, gaps, "ink-soft", { striped: true });
                shade(u, windows, "maintenance");
            drawNotes(u, notes);
              },
            ],
            draw: [
              (u) => {
                nominal(u, one.nominal);
                marks(u, holes);
              },
            ],
            setCursor: index === 0 ? [(u) => frame.read(readout(u))] : [],
          },
        });
        charts.push(chart(frame.plot, options, [times, one.values], index === 0 ? frame.plot : null));
      });

      function readout(u) {
        const row = u.cursor.idx ?? -1;
        if (row < 0 || isPause[row]) return "";
        const values = modes.map(
          (values, m) => `mode ${m + 1} ${values[row] === null ? "not identified" : quantity(values[row], "Hz", 5)}`,
        );
        const covariateValues = covariates.map(([name, values]) => `${name} ${quantity(values[row], units[name])}`);
        return [timeElement(frequencies.times[row]), ` · ${[...values, ...covariateValues].join(" · ")}`];
      }
      const missing = modes.reduce((sum, values) => sum + values.filter((v, i) => v === null && !isPause[i]).length, 0);
      frame.summarise(
        `${count(frequencies.modes, "mode")} at ${count(times.length, "point")}${reduced ? " (thinned, extremes kept)" : ""} from ` +
          `${local(frequencies.times[0])} to ${local(frequencies.times.at(-1))}; ${count(missing, "value")} not identified, ` +
          `${count(gaps.length, "long pause")}. Use the arrow keys to read the values.`,
      );
      frame.record(() => ({
        columns: ["time", ...modes.map((_, m) => `mode ${m + 1} (Hz)`), ...covariates.map(([name]) => covariateLabel(name, units[name]).label)],
        rows: frequencies.times.flatMap((time, i) =>
          isPause[i] ? [] : [[time, ...modes.map((v) => v[i]), ...covariates.map(([, v]) => v[i])]],
        ),
      }));
      frame.tabulate(() => ({
        columns: ["Time", ...modes.map((_, m) => `Mode ${m + 1} (Hz)`), ...covariates.map(([name]) => covariateLabel(name, units[name]).label)],
        rows: frequencies.times.flatMap((time, i) =>
          isPause[i]
            ? []
            : [
                [
                  timeElement(time),
                  ...modes.map((v) => (v[i] === null ? "not identified" : number(v[i], 6))),
                  ...covariates.map(([, v]) => number(v[i])),
                ],
              ],
        ),
      }));
    },
  };
}

/** An axis range with padding, also if all values are equal. */
export function paddedRange(low, high) {
  if (low === null || high === null) return [0, 1];
  const padding = (high - low) * 0.08 || Math.abs(high) * 0.01 || 1;
  return [low - padding, high + padding];
}

function nominal(u, value) {
  const { min, max } = u.scales.y;
  if (value === undefined || value === null || value < min || value > max) return;
  const y = u.valToPos(value, "y", true);
  draw(u, (pen) => {
    pen.strokeStyle = colour("ink-soft");
    pen.setLineDash([4 * devicePixelRatio, 4 * devicePixelRatio]);
    pen.beginPath();
    pen.moveTo(u.bbox.left, y);
    pen.lineTo(u.bbox.left + u.bbox.width, y);
    pen.stroke();
  });
}

function marks(u, times) {
  draw(u, (pen) => {
    pen.strokeStyle = colour("bad");
    pen.lineWidth = 1.5 * devicePixelRatio;
    const y = u.bbox.top + u.bbox.height - 5 * devicePixelRatio;
    for (const time of times) {
      const x = u.valToPos(time, "x", true);
      if (x >= u.bbox.left && x <= u.bbox.left + u.bbox.width) mark(pen, "cross", x, y, 6);
    }
  });
}
