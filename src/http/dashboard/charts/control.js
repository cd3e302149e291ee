// The control chart: shift of each batch and its moving average, with limits and alarms.

import { h } from "../dom.js";
import { count, inWords, local, number, timeElement, words } from "../format.js";
import { help } from "../help.js";
import { stateChip, urgency } from "../states.js";
import { chart, curve, draw, mark, merged, rule, seconds, shade, timeAxis, valueAxis, withGaps } from "./base.js";
import { figure } from "./figure.js";
import { drawNotes } from "./notes.js";
import { FIT_CHART, JOINT_CHART, alarmSpans } from "./parameters.js";
import { colour } from "./theme.js";

const KEYS = [
  { mark: "dot-1", text: "single batch (shift or fast chart)" },
  { mark: "dash-bad", text: "limit for a single batch" },
  { mark: "line-2", text: "several batches (moving average or slow chart)" },
  { mark: "dash-2", text: "limit for several batches" },
  { mark: "dash", text: "a new undamaged reference begins" },
  { mark: "triangle", text: "alarm or pending" },
  { mark: "ring", text: "chart not updated (rejected batch or maintenance)" },
  { mark: "alarm-span", text: "alarm" },
  { mark: "maintenance-span", text: "maintenance" },
  { mark: "note-flag", text: "note" },
];

const label = (chart) =>
  chart === FIT_CHART ? "simulation fit" : chart === JOINT_CHART ? "all parameters together" : inWords(chart);

/** Names of the two values of a chart. */
const names = (c) =>
  c.chart === FIT_CHART
    ? { one: "rejected", several: "average", unit: "1: rejected, 0: accepted" }
    : c.is_process
    ? { one: "fast chart", several: "slow chart", unit: "standard deviations" }
    : { one: "shift", several: "moving average", unit: "standard errors" };

const hint = (c) =>
  c.chart === FIT_CHART
    ? "Whether the simulation can explain each batch: 1 is a rejected batch, 0 an accepted one. Several rejected batches raise an alarm about the simulation or the data, not about the structure."
    : c.is_process
    ? "Evidence for a lasting loss that weather and seasons do not explain, in standard deviations. The fast chart finds steps in up to three batches, the slow one small losses over up to 60. The process was learned from the undamaged reference."
    : "Shift towards damage relative to the undamaged reference, in standard errors. Several batches together show small losses by their moving average.";

/** States of a chart in words: they say nothing about the structure as a whole. */
const CHART_STATES = {
  normal: "inside the limits",
  pending: "above a limit, not yet an alarm",
  alarming: "alarm",
  recovering: "inside the limits again, the alarm has not ended yet",
};

const isBeyond = (state) => state === "alarming" || state === "pending";

export function control(group, selectBatch) {
  const picker = h("div", { class: "picker", role: "group", "aria-label": "Control chart for" });
  const frame = figure({
    name: "control",
    title: "Control chart",
    term: "control chart",
    keys: KEYS,
    tools: picker,
  });
  let one = null;
  let chosen = null;
  let newest = null;

  const show = () => {
    one?.end();
    one = null;
    const series = newest;
    const all = series.charts.filter((c) => c.times.length > 0);
    if (all.length === 0) {
      picker.replaceChildren();
      return frame.empty("Control charts begin with the first batch after an undamaged reference has been declared.");
    }
    frame.empty(null);
    // Unless the user has chosen a chart, the one with the most urgent state is shown.
    const worst = all.toSorted(
      (a, b) => urgency(a.state.at(-1)) - urgency(b.state.at(-1)) || (a.chart === FIT_CHART) - (b.chart === FIT_CHART),
    )[0];
    const c = all.find((chart) => chart.chart === chosen) ?? worst;
    const name = names(c);
    frame.explain(c.chart === FIT_CHART ? hint(c) : [hint(c), " ", help("moving average")]);
    const focused = picker.contains(document.activeElement) ? document.activeElement.dataset.chart : null;
    picker.replaceChildren(
      ...all.map((other) =>
        h(
          "button",
          {
            type: "button",
            "aria-pressed": String(other === c),
            dataset: { chart: other.chart },
            onclick: () => ((chosen = other.chart), show()),
          },
          label(other.chart),
          isBeyond(other.state.at(-1)) && " ",
          isBeyond(other.state.at(-1)) && stateChip(other.state.at(-1)),
        ),
      ),
    );
    if (focused) [...picker.children].find((b) => b.dataset.chart === focused)?.focus();

    const filled = withGaps(c.times.map(seconds), [c.shift, c.shift_limit, c.ewma, c.ewma_limit]);
    const [shift, shiftLimit, ewma, ewmaLimit] = filled.columns;
    const alarms = alarmSpans(series.alarms, c.chart);
    const windows = series.maintenance.map((w) => [seconds(w.from), seconds(w.to)]);
    const dots = (u) =>
      draw(u, (pen) => {
        filled.times.forEach((time, i) => {
          const row = filled.origin[i];
          if (row < 0 || shift[i] === null) return;
          const [x, y] = [u.valToPos(time, "x", true), u.valToPos(shift[i], "y", true)];
          if (x < u.bbox.left || x > u.bbox.left + u.bbox.width) return;
          pen.fillStyle = pen.strokeStyle = colour(isBeyond(c.state[row]) ? "bad" : "curve-1");
          pen.lineWidth = 1.5 * devicePixelRatio;
          if (c.held[row]) {
            pen.fillStyle = colour("panel");
            mark(pen, "dot", x, y, 6);
          }
          mark(
            pen,
            c.held[row] ? "ring" : isBeyond(c.state[row]) ? "triangle" : "dot",
            x,
            y,
            isBeyond(c.state[row]) ? 9 : 5,
          );
        });
      });
    const options = merged(group.options(), {
      height: 230,
      select: (index) => filled.origin[index] >= 0 && selectBatch(c.batches[filled.origin[index]]),
      series: [
        {},
        curve("curve-1", { width: 0.5, points: { show: false } }),
        curve("bad", { dash: [2, 3] }),
        curve("curve-2", { width: 2 }),
        curve("curve-2", { dash: [6, 4] }),
      ],
      axes: [timeAxis(), valueAxis(name.unit)],
      scales: { y: { range: (u, low, high) => [Math.min(0, low ?? 0) - 0.5, Math.max(1, high ?? 1) * 1.08 + 0.2] } },
      hooks: {
        drawClear: [
          (u) => {
            shade(u, windows, "maintenance");
            drawNotes(u, series.notes);
            shade(u, alarms, "bad", { opacity: 0.16 });
            shade(u, filled.gaps, "ink-soft", { striped: true });
            for (const r of series.references) rule(u, seconds(r.from), "ink-soft", [2, 4], "x");
          },
        ],
        draw: [dots],
        setCursor: [(u) => frame.read(readout(u))],
      },
    });
    one = chart(frame.plot, options, [filled.times, shift, shiftLimit, ewma, ewmaLimit]);

    const stateOf = (row) => `${CHART_STATES[c.state[row]] ?? c.state[row]}${c.held[row] ? ", chart not updated" : ""}`;
    function readout(u) {
      const row = filled.origin[u.cursor.idx ?? -1] ?? -1;
      if (row < 0) return "";
      return [
        timeElement(c.times[row]),
        ` · ${label(c.chart)}: ${name.one} ${number(c.shift[row], 3)} (limit ${number(c.shift_limit[row], 3)}), ${name.several} ${number(c.ewma[row], 3)} (limit ${number(c.ewma_limit[row], 3)}) · ${stateOf(row)}`,
      ];
    }
    const last = c.times.length - 1;
    frame.summarise(
      `Control chart for ${label(c.chart)}, ${count(c.times.length, "batch", "batches")} to ${local(c.times[last])}. Latest: ${stateOf(last)}, ${name.one} ` +
        `${number(c.shift[last], 3)} ${name.unit} (limit ${number(c.shift_limit[last], 3)}); ${count(alarms.length, "alarm")} in this time span. ` +
        "Use the arrow keys to read the values and Enter to open the batch.",
    );
    frame.record(() => ({
      columns: [
        "time",
        `${name.one} (${name.unit})`,
        `limit of the ${name.one} (${name.unit})`,
        `${name.several} (${name.unit})`,
        `limit of the ${name.several} (${name.unit})`,
        "state",
        "batch",
      ],
      rows: c.times.map((time, i) => [
        time,
        c.shift[i],
        c.shift_limit[i],
        c.ewma[i],
        c.ewma_limit[i],
        stateOf(i),
        c.batches[i],
      ]),
    }));
    frame.tabulate(() => ({
      columns: [
        "Time",
        `${name.one} (${name.unit})`,
        `limit of the ${name.one}`,
        name.several,
        `limit of the ${name.several}`,
        "State",
      ],
      rows: c.times.map((time, i) => [
        timeElement(time),
        number(c.shift[i], 3),
        number(c.shift_limit[i], 3),
        number(c.ewma[i], 3),
        number(c.ewma_limit[i], 3),
        words(stateOf(i)),
      ]),
    }));
  };

  return {
    element: frame.element,
    /** Shows the first chart there is of some names; returns whether there is one. */
    choose(names) {
      const found = names.find((name) => newest?.charts.some((c) => c.chart === name && c.times.length > 0));
      if (found === undefined) return false;
      chosen = found;
      show();
      return true;
    },
    update(series) {
      newest = series;
      show();
    },
  };
}
