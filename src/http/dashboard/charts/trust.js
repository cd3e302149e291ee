// Trust of every batch over time: accepted, accepted with findings, or rejected.

import { count, local, number, timeElement, words } from "../format.js";
import { LEFT, chart, draw, mark, merged, seconds, shade, timeAxis, valueAxis } from "./base.js";
import { figure } from "./figure.js";
import { drawNotes } from "./notes.js";
import { colour } from "./theme.js";

const ROWS = ["rejected", "findings", "accepted"];
const SHAPES = [
  ["cross", "bad"],
  ["triangle", "warn"],
  ["dot", "good"],
];

const rowOf = (item) => (item.verdict === "rejected" ? 0 : item.findings.length > 0 ? 1 : 2);

export function trust(group, selectBatch) {
  const frame = figure({
    name: "trust",
    title: "Trust and data quality",
    term: "trust",
    keys: [
      { mark: "dot-good", text: "accepted" },
      { mark: "triangle-warn", text: "accepted, with findings" },
      { mark: "cross", text: "rejected: probability of damage withheld" },
    ],
  });
  let one = null;

  return {
    element: frame.element,
    update({ trust: items, maintenance, notes }) {
      one?.end();
      one = null;
      if (items.length === 0) return frame.empty("No assessed batch in this time span.");
      frame.empty(null);
      const times = items.map((item) => seconds(item.time));
      const windows = maintenance.map((w) => [seconds(w.from), seconds(w.to)]);
      const paint = (u) =>
        draw(u, (pen) => {
          items.forEach((item, i) => {
            const x = u.valToPos(times[i], "x", true);
            if (x < u.bbox.left || x > u.bbox.left + u.bbox.width) return;
            const row = rowOf(item);
            const [shape, name] = SHAPES[row];
            pen.fillStyle = pen.strokeStyle = colour(name);
            pen.lineWidth = 2 * devicePixelRatio;
            mark(pen, shape, x, u.valToPos(row + 0.5, "y", true), shape === "dot" ? 5 : 8);
          });
        });
      const options = merged(group.options(), {
        height: 118,
        select: (index) => selectBatch(items[index].batch),
        series: [{}, { stroke: "transparent", points: { show: false } }],
        axes: [timeAxis(), valueAxis(null, { splits: () => [0.5, 1.5, 2.5], values: () => ROWS, size: LEFT })],
        scales: { y: { range: [0, 3] } },
        hooks: {
          drawClear: [(u) => shade(u, windows, "maintenance"), (u) => drawNotes(u, notes)],
          draw: [paint],
          setCursor: [(u) => frame.read(readout(u))],
        },
      });
      one = chart(frame.plot, options, [times, times.map(() => 0)]);

      const findingText = (item) => (item.findings.length > 0 ? item.findings.map(words).join(", ") : "no findings");
      function readout(u) {
        const item = items[u.cursor.idx ?? -1];
        return item
          ? [
              timeElement(item.time),
              ` · ${item.verdict} · ${findingText(item)} · p-value of the fit ${number(item.p_value, 2)}`,
            ]
          : "";
      }
      const tally = [0, 1, 2].map((row) => items.filter((item) => rowOf(item) === row).length);
      frame.summarise(
        `${count(items.length, "batch", "batches")} to ${local(items.at(-1).time)}: ${tally[2]} accepted, ${tally[1]} accepted with findings, ` +
          `${tally[0]} rejected. Use the arrow keys to read the values and Enter to open the batch.`,
      );
      frame.record(() => ({
        columns: ["time", "verdict", "findings", "p-value of the fit (1)", "batch"],
        rows: items.map((item) => [item.time, item.verdict, item.findings.join(" "), item.p_value, item.batch]),
      }));
      frame.tabulate(() => ({
        columns: ["Time", "Verdict", "Findings", "p-value of the fit"],
        rows: items.map((item) => [timeElement(item.time), item.verdict, findingText(item), number(item.p_value, 2)]),
      }));
    },
  };
}
