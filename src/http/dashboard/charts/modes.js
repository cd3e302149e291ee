// Deviation of the measured frequencies of one batch from the prediction of the updated simulation, in per cent.

import { number } from "../format.js";
import { acrossAxis, chart, draw, mark, rule, valueAxis } from "./base.js";
import { figure } from "./figure.js";
import { colour, faint } from "./theme.js";

const mean = (values) => (values.length > 0 ? values.reduce((sum, v) => sum + v, 0) / values.length : null);

export function modes() {
  const frame = figure({
    name: "modes",
    title: "Measured and predicted frequencies",
    hint: "Deviation of each measured frequency from the mean that the updated simulation predicts, in per cent.",
    keys: [
      { mark: "dot-1", text: "measured" },
      { mark: "band-2", text: "predicted: 90 % interval without measurement noise" },
    ],
    level: "h3",
  });
  let one = null;
  return {
    element: frame.element,
    update(detail) {
      one?.end();
      one = null;
      const list = (detail?.modes ?? []).filter((m) => Number.isFinite(m.predicted_mean_hz));
      if (list.length === 0) return frame.empty("No predicted frequencies for this batch.");
      frame.empty(null);
      const deviation = (mode, hz) => 100 * (hz / mode.predicted_mean_hz - 1);
      const rows = list.map((mode) => ({
        ...mode,
        low: deviation(mode, mode.predicted_low_hz),
        high: deviation(mode, mode.predicted_high_hz),
        measured: mode.measured_hz.filter((v) => v !== null).map((hz) => deviation(mode, hz)),
      }));
      const extent = Math.max(...rows.flatMap((r) => [r.low, r.high, ...r.measured].map(Math.abs)), 0.01) * 1.15;
      const paint = (u) =>
        draw(u, (pen) => {
          const half = Math.min(u.bbox.width / rows.length / 3, 42 * devicePixelRatio);
          rows.forEach((row, i) => {
            const x = u.valToPos(i + 1, "x", true);
            const [top, bottom] = [u.valToPos(row.high, "y", true), u.valToPos(row.low, "y", true)];
            pen.fillStyle = faint("curve-2", 0.22);
            pen.strokeStyle = colour("curve-2");
            pen.fillRect(x - half, top, 2 * half, Math.max(bottom - top, 2));
            pen.strokeRect(x - half, top, 2 * half, Math.max(bottom - top, 2));
            row.measured.forEach((value, n) => {
              // Measurements are spread horizontally in their order, so that their marks do not overlap.
              const place = x + half * 0.85 * (row.measured.length === 1 ? 0 : (2 * n) / (row.measured.length - 1) - 1);
              pen.fillStyle = colour("curve-1");
              mark(pen, "dot", place, u.valToPos(value, "y", true), 4);
            });
          });
        });
      const label = (row) => `mode ${row.mode}`;
      one = chart(
        frame.plot,
        {
          height: 260,
          series: [{}, { stroke: "transparent", points: { show: false } }],
          axes: [
            acrossAxis(null, {
              splits: () => rows.map((_, i) => i + 1),
              values: () => rows.map(label),
              grid: { show: false },
            }),
            valueAxis("deviation (%)"),
          ],
          scales: { x: { time: false, range: [0.4, rows.length + 0.6] }, y: { range: [-extent, extent] } },
          hooks: { draw: [(u) => rule(u, 0, "ink-soft"), paint], setCursor: [(u) => frame.read(readout(u))] },
        },
        [rows.map((_, i) => i + 1), rows.map(() => 0)],
      );
      const describe = (row) =>
        `predicted ${number(row.predicted_mean_hz, 5)} Hz (${number(row.predicted_low_hz, 5)} to ${number(row.predicted_high_hz, 5)}), ` +
        `${row.measured.length} measured, mean deviation from the prediction ${number(mean(row.measured), 2)} %`;
      function readout(u) {
        const row = rows[u.cursor.idx ?? -1];
        return row ? `${label(row)}: ${describe(row)}` : "";
      }
      frame.summarise(`${rows.map((row) => `${label(row)}: ${describe(row)}`).join("; ")}.`);
      frame.record(() => ({
        columns: [
          "mode",
          "measurement",
          "deviation from the prediction (%)",
          "lower end of the predicted 90 % interval (%)",
          "upper end of the predicted 90 % interval (%)",
        ],
        rows: rows.flatMap((row) => row.measured.map((value, n) => [row.mode, n + 1, value, row.low, row.high])),
      }));
      frame.tabulate(() => ({
        columns: [
          "Mode",
          "Predicted mean (Hz)",
          "90 % interval (Hz)",
          "Measured, lowest to highest (Hz)",
          "Mean deviation (%)",
        ],
        rows: rows.map((row) => {
          const hz = row.measured_hz.filter((v) => v !== null);
          return [
            String(row.mode),
            number(row.predicted_mean_hz, 6),
            `${number(row.predicted_low_hz, 6)} to ${number(row.predicted_high_hz, 6)}`,
            hz.length > 0 ? `${number(Math.min(...hz), 6)} to ${number(Math.max(...hz), 6)}` : "none identified",
            number(mean(row.measured), 2),
          ];
        }),
        newestLast: false,
      }));
    },
  };
}
