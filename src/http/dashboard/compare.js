// Two parameters, of one structure or of two, in one figure: change from the undamaged reference in per cent over a common time axis.

import { at, read } from "./api.js";
import { TimeGroup, band, chart, curve, edge, fewPoints, merged, rule, seconds, shade, timeAxis, valueAxis, withGaps } from "./charts/base.js";
import { figure } from "./charts/figure.js";
import { alarmSpans, signed } from "./charts/parameters.js";
import { fill, h, keepInAddress } from "./dom.js";
import { changePercent, count, local, timeElement, zone } from "./format.js";

const POINTS = 1000;
/** The two sides and the colours of their curves. */
const SIDES = [
  ["a", "curve-1", "First"],
  ["b", "curve-2", "Second"],
];

/** `structure/parameter` of an address; the id of a structure contains no slash. */
function choiceOf(text) {
  const cut = text?.indexOf("/") ?? -1;
  return cut < 0 ? null : { structure: text.slice(0, cut), parameter: text.slice(cut + 1) };
}

/** The change of a parameter and its 90 % interval in per cent; `null` without an undamaged reference. */
function changes(series, parameter) {
  const p = series.parameters.find((one) => one.name === parameter);
  if (!p || !Number.isFinite(p.undamaged_mean)) return null;
  const change = (v) => (v === null || v === undefined ? null : changePercent(v, p.undamaged_mean, p.unit));
  return { times: p.times, batches: p.batches, mean: p.mean.map(change), low: p.low.map(change), high: p.high.map(change) };
}

/** `query` holds the choice: `a` and `b` as `structure/parameter`, `from`, `to`. */
export function compare(query) {
  const group = new TimeGroup(zoom);
  const asked = [query.get("from"), query.get("to")].map((time) => seconds(time ?? ""));
  if (asked.every(Number.isFinite) && asked[0] < asked[1]) group.range = asked;
  const chosen = Object.fromEntries(SIDES.map(([side]) => [side, choiceOf(query.get(side))]));
  /** Names of the parameters by structure. */
  let parameters = {};
  const pickers = Object.fromEntries(
    SIDES.map(([side, , word]) => [
      side,
      {
        structure: h("select", {
          id: `compare-${side}-structure`,
          "aria-label": `${word} structure`,
          onchange: (event) => choose(side, event.target.value, parameters[event.target.value]?.[0]),
        }),
        parameter: h("select", {
          id: `compare-${side}-parameter`,
          "aria-label": `${word} parameter`,
          onchange: (event) => choose(side, chosen[side].structure, event.target.value),
        }),
      },
    ]),
  );
  const spanText = h("span", { class: "fine" });
  const whole = h("button", { type: "button", onclick: () => zoom(null) }, "Whole record");
  const frame = figure({
    name: "compare",
    title: "Change from the undamaged reference",
    term: "undamaged reference",
    level: "h2",
    keys: [
      { mark: "band-1", text: "first: mean and 90 % interval" },
      { mark: "band-2", text: "second: mean and 90 % interval" },
      { mark: "span-1", text: "alarm of the first" },
      { mark: "span-2", text: "alarm of the second" },
    ],
  });
  const element = h(
    "div",
    { class: "view", dataset: { page: "compare" } },
    h("p", { class: "crumbs" }, h("a", { href: "#/" }, "Fleet"), " / Comparison"),
    h("h1", null, "Comparison"),
    h(
      "div",
      { class: "row" },
      SIDES.map(([side, , word]) =>
        h("span", { class: "row compare-side" }, h("span", { class: `mark line-${side === "a" ? 1 : 2}`, "aria-hidden": "true" }), word, pickers[side].structure, pickers[side].parameter),
      ),
      whole,
    ),
    h("p", null, spanText),
    h("section", { class: "panel" }, frame.element),
  );
  let charts = [];
  let left = false;

  const iso = (time_s) => new Date(1000 * time_s).toISOString();
  function writeAddress() {
    const parts = new URLSearchParams();
    for (const [side] of SIDES) if (chosen[side]) parts.set(side, `${chosen[side].structure}/${chosen[side].parameter}`);
    if (group.range) {
      parts.set("from", iso(group.range[0]));
      parts.set("to", iso(group.range[1]));
    }
    keepInAddress("#/compare", parts);
  }

  function zoom(range) {
    group.range = range;
    writeAddress();
    show();
  }

  function choose(side, structure, parameter) {
    chosen[side] = { structure, parameter };
    // Another structure has another record.
    group.range = null;
    showPickers();
    writeAddress();
    show();
  }

  function showPickers() {
    for (const [side] of SIDES) {
      const { structure, parameter } = pickers[side];
      const choice = chosen[side];
      fill(structure, Object.keys(parameters).map((id) => h("option", { value: id }, id)));
      fill(parameter, (parameters[choice?.structure] ?? []).map((name) => h("option", { value: name }, name)));
      structure.value = choice?.structure ?? "";
      parameter.value = choice?.parameter ?? "";
    }
  }

  const range = () => (group.range ? `&from=${encodeURIComponent(iso(group.range[0]))}&to=${encodeURIComponent(iso(group.range[1]))}` : "");

  async function show() {
    const wanted = group.range;
    const choices = SIDES.map(([side]) => chosen[side]);
    const ids = [...new Set(choices.map((choice) => choice.structure))];
    const loaded = await Promise.all(ids.map((id) => read(at(id, `/series?points=${POINTS}${range()}`))));
    await group.released();
    if (left || wanted !== group.range || choices.some((choice, i) => choice !== chosen[SIDES[i][0]])) return;
    const series = new Map(ids.map((id, i) => [id, loaded[i]]));
    draw(choices.map((choice) => ({ ...choice, series: series.get(choice.structure) })));
  }

  function draw(sides) {
    charts.forEach((c) => c.end());
    charts = [];
    const lines = sides.map((side) => ({ ...side, values: changes(side.series, side.parameter), name: `${side.structure} ${side.parameter}` }));
    const without = lines.find(({ values }) => values === null);
    if (without)
      return frame.empty(
        `${without.structure} has no undamaged reference, so that a change of ${without.parameter} is not known: mark its healthy period on its page.`,
      );
    const times = [...new Set(lines.flatMap(({ values }) => values.times))].sort();
    if (times.length === 0) return frame.empty("No assessed batch in this time span.");
    frame.empty(null);
    const at_s = times.map(seconds);
    const padding = Math.max(0.01 * (at_s.at(-1) - at_s[0]), 60);
    group.all = [at_s[0] - padding, at_s.at(-1) + padding];
    const shownEnds = group.range ?? [at_s[0], at_s.at(-1)];
    fill(spanText, `${local(1000 * shownEnds[0])} to ${local(1000 * shownEnds[1])} (${zone()}). Drag over the chart to zoom, double-click to reset.`);
    const rows = new Map(times.map((time, i) => [time, i]));
    /** A column on the common times, with the rows of the other structure between its own bridged by `undefined`. */
    const onCommon = (values, name) => {
      const own = withGaps(values.times.map(seconds), [values[name]]);
      const column = times.map(() => undefined);
      values.times.forEach((time, i) => (column[rows.get(time)] = values[name][i] ?? null));
      // A long pause interrupts the curve.
      for (const [from, to] of own.gaps) at_s.forEach((time, i) => time > from && time < to && (column[i] = null));
      return column;
    };
    const columns = lines.flatMap(({ values }) => ["mean", "low", "high"].map((name) => onCommon(values, name)));
    const points = fewPoints(times.length);
    const options = merged(group.options(), {
      height: 380,
      series: [{}, curve("curve-1", { points }), edge(), edge(), curve("curve-2", { points }), edge(), edge()],
      bands: [band(3, 2, "curve-1", 0.2), band(6, 5, "curve-2", 0.2)],
      axes: [timeAxis(), valueAxis("change (%)")],
      hooks: {
        drawClear: [
          (u) =>
            lines.forEach(({ series, parameter }, i) =>
              shade(u, alarmSpans(series.alarms, parameter), SIDES[i][1], { opacity: 0.12 }),
            ),
        ],
        draw: [(u) => rule(u, 0, "ink-soft")],
        setCursor: [(u) => frame.read(readout(u))],
      },
    });
    charts = [chart(frame.plot, options, [at_s, ...columns])];

    const changeWords = (line, i) => {
      const [mean, low, high] = columns.slice(3 * i, 3 * i + 3);
      return (row) => (Number.isFinite(mean[row]) ? `${line.name} ${signed(mean[row])} % (${signed(low[row])} to ${signed(high[row])} %)` : null);
    };
    const words = lines.map(changeWords);
    function readout(u) {
      const row = u.cursor.idx ?? -1;
      const parts = words.map((say) => say(row)).filter(Boolean);
      return parts.length > 0 ? [timeElement(times[row]), ` · ${parts.join(" · ")}`] : "";
    }
    const latest = lines.map(({ values }, i) => words[i](rows.get(values.times.at(-1))) ?? `${lines[i].name}: no batch`);
    frame.summarise(
      `${lines.map(({ name, values }) => `${name}: ${count(values.times.length, "batch", "batches")}`).join("; ")}. Latest change from the undamaged reference: ${latest.join("; ")}. Use the arrow keys to read the values.`,
    );
    const header = lines.flatMap(({ name }) => [
      `change of ${name} (%)`,
      `lower end of its 90 % interval (%)`,
      `upper end of its 90 % interval (%)`,
    ]);
    frame.record(() => ({ columns: ["time", ...header], rows: times.map((time, i) => [time, ...columns.map((c) => c[i])]) }));
    frame.tabulate(() => ({
      columns: ["Time", ...lines.map(({ name }) => `${name}: change and 90 % interval`)],
      rows: times.map((time, i) => [timeElement(time), ...words.map((say) => say(i) ?? "–")]),
    }));
  }

  return {
    title: "Comparison",
    element,
    async load() {
      const { items } = await read("v1/overview");
      const infos = await Promise.all(items.map((item) => read(at(item.id))));
      parameters = Object.fromEntries(infos.map((info) => [info.id, info.definition.parameter.map((p) => p.name)]));
      const ids = Object.keys(parameters).filter((id) => parameters[id].length > 0);
      if (ids.length === 0) return frame.empty("No structures yet.");
      const known = (choice) => parameters[choice?.structure]?.includes(choice.parameter);
      const usual = items.find((item) => item.undamaged_version)?.id ?? ids[0];
      if (!known(chosen.a)) chosen.a = { structure: usual, parameter: parameters[usual][0] };
      if (!known(chosen.b)) {
        const own = parameters[chosen.a.structure];
        chosen.b = { structure: chosen.a.structure, parameter: own.find((name) => name !== chosen.a.parameter) ?? own[0] };
      }
      showPickers();
      writeAddress();
      await show();
    },
    event(name, data) {
      if (name === "batch" && SIDES.some(([side]) => chosen[side]?.structure === data.structure)) show().catch(() => {});
    },
    missed: () => show().catch(() => {}),
    end: () => (left = true),
  };
}
