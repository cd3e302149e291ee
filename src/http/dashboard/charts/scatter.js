// A frequency against a covariate such as the temperature: points coloured by time, those in an alarm outlined.

import { h } from "../dom.js";
import { count, local, number, quantity, timeElement } from "../format.js";
import { acrossAxis, chart, draw, mark, seconds, valueAxis } from "./base.js";
import { figure } from "./figure.js";
import { colour } from "./theme.js";
import { covariateLabel, paddedRange } from "./tracks.js";

/** Colours from the first to the last measurement. */
const TIMES = ["time-0", "time-1", "time-2"];
const POINT_PX = 5;
const RING_PX = 9;

const options = (select, values, words) => {
  const before = select.value;
  select.replaceChildren(...values.map((value, i) => h("option", { value }, words[i])));
  select.value = values.map(String).includes(before) ? before : String(values[0] ?? "");
};

/** Time spans of the alarms about the structure, in seconds; an open alarm has no end. */
const alarmed = (alarms) =>
  alarms
    .filter((a) => !["silence", "not_assessed"].includes(a.kind) && a.state !== "withdrawn")
    .map((a) => [seconds(a.opened_at), a.ended_at ? seconds(a.ended_at) : Infinity]);

export function scatter() {
  let newest = null;
  const mode = h("select", { id: "scatter-mode", onchange: () => show() });
  const covariate = h("select", { id: "scatter-covariate", onchange: () => show() });
  const tools = h(
    "p",
    { class: "row" },
    h("label", { for: "scatter-mode" }, "Frequency of"),
    mode,
    h("label", { for: "scatter-covariate" }, "against"),
    covariate,
  );
  const frame = figure({
    name: "scatter",
    title: "Frequency against temperature or another covariate",
    term: "covariate",
    tools,
    keys: [
      { mark: "time-scale", text: "one measurement, from the first to the last of the time span" },
      { mark: "ring-bad", text: "measured during an alarm" },
    ],
  });
  const none = h(
    "p",
    { class: "fine", hidden: true },
    "No covariates recorded: name a temperature or another influence in the structure file ([[covariate]]) and send it with the frequencies, so that a frequency can be shown against it.",
  );
  let one = null;

  const show = () => {
    one?.end();
    one = null;
    const { frequencies, alarms } = newest;
    const names = Object.keys(frequencies?.covariates ?? {}).filter((name) =>
      frequencies.covariates[name].some((value) => Number.isFinite(value)),
    );
    none.hidden = names.length > 0;
    frame.element.hidden = names.length === 0;
    if (names.length === 0) return;
    options(mode, Array.from({ length: frequencies.modes }, (_, m) => m), Array.from({ length: frequencies.modes }, (_, m) => `mode ${m + 1}`));
    options(covariate, names, names.map((name) => covariateLabel(name, frequencies.covariate_units?.[name]).label));
    const m = Number(mode.value);
    const name = covariate.value;
    const { label } = covariateLabel(name, frequencies.covariate_units?.[name]);
    const spans = alarmed(alarms);
    const points = frequencies.times
      .map((time, i) => ({ time, at: seconds(time), x: frequencies.covariates[name][i], y: frequencies.values_hz[i]?.[m] }))
      .filter(({ x, y }) => Number.isFinite(x) && Number.isFinite(y))
      .map((point) => ({ ...point, alarm: spans.some(([from, to]) => point.at >= from && point.at <= to) }))
      .sort((a, b) => a.x - b.x);
    if (points.length === 0) return frame.empty(`No measurement of mode ${m + 1} with ${label} in this time span.`);
    frame.empty(null);
    const ends = points.reduce(([a, b], { at }) => [Math.min(a, at), Math.max(b, at)], [Infinity, -Infinity]);
    const tone = ({ at }) => {
      const place = ends[1] > ends[0] ? (at - ends[0]) / (ends[1] - ends[0]) : 0;
      const [part, rest] = place < 0.5 ? [0, 2 * place] : [1, 2 * place - 1];
      return `color-mix(in oklab, ${colour(TIMES[part + 1])} ${Math.round(100 * rest)}%, ${colour(TIMES[part])})`;
    };
    const paint = (u) =>
      draw(u, (pen) => {
        pen.lineWidth = 1.5 * devicePixelRatio;
        for (const point of points.toSorted((a, b) => a.at - b.at)) {
          const [x, y] = [u.valToPos(point.x, "x", true), u.valToPos(point.y, "y", true)];
          pen.fillStyle = tone(point);
          mark(pen, "dot", x, y, POINT_PX);
          if (!point.alarm) continue;
          pen.strokeStyle = colour("bad");
          mark(pen, "ring", x, y, RING_PX);
        }
      });
    const padded = (u, low, high) => paddedRange(low, high);
    one = chart(
      frame.plot,
      {
        height: 320,
        series: [{}, { stroke: "transparent", points: { show: false } }],
        axes: [acrossAxis(label), valueAxis(`mode ${m + 1} (Hz)`)],
        scales: { x: { time: false, range: padded }, y: { range: padded } },
        hooks: { draw: [paint], setCursor: [(u) => frame.read(readout(u))] },
      },
      [points.map((p) => p.x), points.map((p) => p.y)],
    );
    function readout(u) {
      const point = points[u.cursor.idx ?? -1];
      return point
        ? [timeElement(point.time), ` · ${label} ${number(point.x)} · mode ${m + 1} ${quantity(point.y, "Hz", 5)}${point.alarm ? " · alarm" : ""}`]
        : "";
    }
    const inAlarm = points.filter((point) => point.alarm).length;
    frame.summarise(
      `${count(points.length, "measurement")} of mode ${m + 1} against ${label}, from ${local(1000 * ends[0])} to ${local(1000 * ends[1])}; ` +
        `${inAlarm} measured during an alarm. Use the arrow keys to read the values.`,
    );
    frame.record(() => ({
      columns: ["time", label, `mode ${m + 1} (Hz)`, "during an alarm"],
      rows: points.map((p) => [p.time, p.x, p.y, p.alarm]),
    }));
    frame.tabulate(() => ({
      columns: ["Time", label, `Mode ${m + 1} (Hz)`, "During an alarm"],
      rows: points.toSorted((a, b) => a.at - b.at).map((p) => [timeElement(p.time), number(p.x), number(p.y, 6), p.alarm ? "yes" : "no"]),
    }));
  };

  return {
    element: h("div", null, none, frame.element),
    update(series) {
      newest = series;
      show();
    },
  };
}
