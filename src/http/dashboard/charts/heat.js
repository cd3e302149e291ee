// Heat map of the probability of damage: one row per parameter, one column per batch. Its colours are neutral, because a healthy
// structure shows high probabilities at times; a red frame marks the alarms of a parameter.

import { count, inWords, local, percent, timeElement } from "../format.js";
import { LEFT, chart, draw, mark, merged, seconds, timeAxis, valueAxis } from "./base.js";
import { figure } from "./figure.js";
import { alarmSpans, rejectedBatches } from "./parameters.js";
import { colour } from "./theme.js";

/** Upper ends of the colour steps; the first step covers what an undamaged structure shows. */
const STEPS = [0.05, 0.2, 0.4, 0.6, 0.8, 1.0];

const stepOf = (probability) => STEPS.findIndex((end) => probability <= end + 1e-12);

export function heat(group, selectBatch) {
  const ends = STEPS.map((end) => Math.round(100 * end));
  const frame = figure({
    name: "heat",
    title: "Probability of damage over time, all parameters",
    term: "probability of damage",
    keys: [
      ...ends.map((end, i) => ({ mark: `heat-${i}`, text: i === 0 ? `up to ${end} %` : `${ends[i - 1]} to ${end} %` })),
      { mark: "cross", text: "withheld: batch rejected" },
      { mark: "alarm-frame", text: "alarm" },
    ],
  });
  let one = null;

  return {
    element: frame.element,
    update(series) {
      const { parameters } = series;
      const rejected = rejectedBatches(series);
      one?.end();
      one = null;
      const rows = parameters.filter((p) => p.probability_of_damage.some((v) => v !== null && v !== undefined));
      if (rows.length === 0)
        return frame.empty("Begins with an undamaged reference: “Mark the healthy period” above.");
      frame.empty(null);
      // A thinned series may keep different batches for each parameter; the map shows all of them.
      const cells = new Map();
      rows.forEach((p, r) =>
        p.times.forEach((time, i) => {
          const key = p.batches[i];
          if (!cells.has(key)) cells.set(key, { time, values: [] });
          cells.get(key).values[r] = p.probability_of_damage[i] ?? null;
        }),
      );
      const columns = [...cells.entries()]
        .map(([batch, cell]) => ({ batch, ...cell, at: seconds(cell.time) }))
        .sort((a, b) => a.at - b.at);
      const times = columns.map((c) => c.at);
      const edges = edgesOf(times);
      const paint = (u) =>
        draw(u, (pen) => {
          const { left, top, width, height } = u.bbox;
          pen.beginPath();
          pen.rect(left, top, width, height);
          pen.clip();
          columns.forEach((column, i) => {
            const a = u.valToPos(edges[i][0], "x", true);
            const b = u.valToPos(edges[i][1], "x", true);
            if (b < left || a > left + width) return;
            const [from, wide] = [Math.floor(a), Math.max(Math.ceil(b) - Math.floor(a), 2 * devicePixelRatio)];
            rows.forEach((_, r) => {
              const value = column.values[r];
              // Undefined: the batch is not in the thinned series. Null: withheld, or not compared (batches of the reference).
              if (value === undefined || (value === null && !rejected.has(column.batch))) return;
              const y = Math.round(u.valToPos(r, "y", true));
              const tall = Math.round(u.valToPos(r + 1, "y", true)) - y - 2 * devicePixelRatio;
              if (value === null) {
                pen.strokeStyle = colour("bad");
                pen.lineWidth = 1.5 * devicePixelRatio;
                mark(pen, "cross", (a + b) / 2, y + tall / 2, 7);
              } else {
                pen.fillStyle = colour(`heat-${stepOf(value)}`);
                pen.fillRect(from, y, wide, tall);
              }
            });
          });
          pen.strokeStyle = colour("bad");
          pen.lineWidth = 2 * devicePixelRatio;
          rows.forEach((p, r) => {
            for (const [from, to] of alarmSpans(series.alarms, p.name)) {
              const [a, b] = [u.valToPos(from, "x", true), Math.min(u.valToPos(to, "x", true), left + width + 4)];
              const [y, next] = [u.valToPos(r, "y", true), u.valToPos(r + 1, "y", true)];
              pen.strokeRect(a, y, b - a, next - y - 2 * devicePixelRatio);
            }
          });
        });
      const options = merged(group.options(), {
        height: 52 + Math.max(30 * rows.length, 60),
        select: (index) => selectBatch(columns[index].batch),
        series: [{}, { stroke: "transparent", points: { show: false } }],
        axes: [
          timeAxis(),
          valueAxis(null, {
            splits: () => rows.map((_, r) => r + 0.5),
            values: () => rows.map((p) => short(p.name)),
            grid: { show: false },
            ticks: { show: false },
            size: LEFT,
          }),
        ],
        scales: { y: { range: [0, rows.length], dir: -1 } },
        hooks: { draw: [paint], setCursor: [(u) => frame.read(readout(u))] },
      });
      one = chart(frame.plot, options, [times, times.map(() => 0)]);

      const describe = ({ batch, values }, r) => {
        if (values[r] === undefined) return "omitted from the thinned series";
        if (values[r] === null) return rejected.has(batch) ? "withheld" : "not compared";
        return percent(values[r]);
      };
      function readout(u) {
        const column = columns[u.cursor.idx ?? -1];
        return column
          ? [timeElement(column.time), ` · ${rows.map((p, r) => `${inWords(p.name)} ${describe(column, r)}`).join(" · ")}`]
          : "";
      }
      const latest = columns.at(-1);
      const most = rows.map((_, r) => r).sort((a, b) => (latest.values[b] ?? -1) - (latest.values[a] ?? -1))[0];
      frame.summarise(
        `${count(rows.length, "parameter")} over ${count(columns.length, "batch", "batches")} to ${local(latest.time)}. ` +
          `Highest in the latest batch: ${inWords(rows[most].name)} ${describe(latest, most)}. Use the arrow keys to read the values and Enter to open the batch.`,
      );
      frame.record(() => ({
        columns: ["time", ...rows.map((p) => `probability of damage of ${inWords(p.name)} (1)`), "batch"],
        rows: columns.map((c) => [c.time, ...rows.map((_, r) => c.values[r]), c.batch]),
      }));
      frame.tabulate(() => ({
        columns: ["Time", ...rows.map((p) => inWords(p.name))],
        rows: columns.map((c) => [timeElement(c.time), ...rows.map((_, r) => describe(c, r))]),
      }));
    },
  };
}

/** Left and right edge of each column: half-way to its neighbours, but not across a long pause. */
function edgesOf(times) {
  const steps = times
    .slice(1)
    .map((t, i) => t - times[i])
    .sort((a, b) => a - b);
  const usual = steps[Math.floor(steps.length / 2)] ?? 3600;
  return times.map((time, i) => {
    const before = Math.min((time - (times[i - 1] ?? time - usual)) / 2, usual);
    const after = Math.min(((times[i + 1] ?? time + usual) - time) / 2, usual);
    return [time - before, time + after];
  });
}

/** A name that fits beside its row. */
const short = (name) => {
  const bare = name.replace(/^(spring|group):/, "");
  return bare.length > 9 ? `${bare.slice(0, 8)}…` : bare;
};
