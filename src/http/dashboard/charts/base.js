// uPlot as this page uses it: its size follows the page, its colours the theme, its cursor the keyboard.

import uPlot from "../vendor/uPlot.esm.js";
import { colour, faint, stripes } from "./theme.js";

const FONT = "12px system-ui, sans-serif";
const DAY_S = 86400;
/** Room for numbers left of every chart, so that charts below one another share their time axis. */
export const LEFT = 68;

const date = new Intl.DateTimeFormat(undefined, { day: "numeric", month: "short" });
const month = new Intl.DateTimeFormat(undefined, { month: "short", year: "numeric" });
const clock = new Intl.DateTimeFormat(undefined, { hour: "2-digit", minute: "2-digit", hour12: false });

/** Labels of a time axis in the viewer's zone. */
function timeLabels(u, splits, axis, space, step) {
  if (step >= 28 * DAY_S) return splits.map((t) => month.format(1000 * t));
  if (step >= DAY_S) return splits.map((t) => date.format(1000 * t));
  let previous = "";
  return splits.map((t) => {
    const day = date.format(1000 * t);
    const label = day === previous ? clock.format(1000 * t) : `${clock.format(1000 * t)}\n${day}`;
    previous = day;
    return label;
  });
}

const axis = (more) => ({
  stroke: () => colour("ink-soft"),
  font: FONT,
  labelFont: FONT,
  grid: { stroke: () => colour("grid"), width: 1 },
  ticks: { stroke: () => colour("grid"), width: 1, size: 4 },
  ...more,
});

/** The time axis; without labels where another chart below has them. */
export function timeAxis(labels = true) {
  return axis({ values: labels ? timeLabels : () => [], size: labels ? 40 : 8, space: 74 });
}

/** An axis of numbers with its unit. */
export function valueAxis(label, more = {}) {
  return axis({ label, labelSize: 16, labelGap: 0, size: LEFT - 16, space: 28, ...more });
}

/** A horizontal axis of numbers. */
export function acrossAxis(label, more = {}) {
  return axis({ label, labelSize: 18, size: 28, space: 50, ...more });
}

/** A curve; gaps stay gaps. */
export function curve(name, more = {}) {
  return { stroke: () => colour(name), width: 1.5, spanGaps: false, points: { show: false }, ...more };
}

/** Points of a curve, shown when they are few enough to be seen one by one. */
export function fewPoints(count) {
  return { show: count < 90, size: 5 };
}

/** An edge of an interval: drawn as the band only. */
export const edge = () => ({ stroke: "transparent", width: 0, points: { show: false }, spanGaps: false });

/** The band between two series. */
export function band(upper, lower, name, opacity = 0.2) {
  return { series: [upper, lower], fill: () => faint(name, opacity) };
}

/** A constant line across a chart, to be called in `draw`. */
export function rule(u, value, name, dash = [6, 4], scale = "y") {
  if (value === null || value === undefined) return;
  const across = scale === "y";
  const place = Math.round(u.valToPos(value, scale, true));
  const { left, top, width, height } = u.bbox;
  const inside = across ? place >= top && place <= top + height : place >= left && place <= left + width;
  if (!inside) return;
  draw(u, (pen) => {
    pen.strokeStyle = colour(name);
    pen.lineWidth = 1.5 * devicePixelRatio;
    pen.setLineDash(dash.map((d) => d * devicePixelRatio));
    pen.beginPath();
    pen.moveTo(across ? left : place, across ? place : top);
    pen.lineTo(across ? left + width : place, across ? place : top + height);
    pen.stroke();
  });
}

/** Shades intervals of time `[from_s, to_s]`, with stripes if wanted. */
export function shade(u, intervals, name, { opacity = 0.14, striped = false } = {}) {
  const { left, top, width, height } = u.bbox;
  draw(u, (pen) => {
    pen.fillStyle = striped ? stripes(pen, name) : faint(name, opacity);
    for (const [from, to] of intervals) {
      const a = Math.max(left, u.valToPos(from, "x", true));
      const b = Math.min(left + width, u.valToPos(to, "x", true));
      if (b > left && a < left + width) pen.fillRect(a, top, Math.max(b - a, 2 * devicePixelRatio), height);
    }
  });
}

/** Draws with the pen's settings put back afterwards. */
export function draw(u, work) {
  u.ctx.save();
  work(u.ctx);
  u.ctx.restore();
}

/** A mark at a place of the canvas: `cross`, `triangle`, `ring`, `dot`. */
export function mark(pen, shape, x, y, size_px) {
  const r = (size_px / 2) * devicePixelRatio;
  pen.beginPath();
  if (shape === "cross") {
    pen.moveTo(x - r, y - r);
    pen.lineTo(x + r, y + r);
    pen.moveTo(x - r, y + r);
    pen.lineTo(x + r, y - r);
    pen.stroke();
  } else if (shape === "triangle") {
    pen.moveTo(x, y - r);
    pen.lineTo(x + r, y + r);
    pen.lineTo(x - r, y + r);
    pen.closePath();
    pen.fill();
  } else {
    pen.arc(x, y, r, 0, 2 * Math.PI);
    if (shape === "ring") pen.stroke();
    else pen.fill();
  }
}

/**
 * A chart in `parent` that lives until `parent` leaves the page. Options are uPlot's, less the width. The keys ← → Home End
 * move the cursor, Enter selects by `options.select(index)`, as a click does.
 */
export function chart(parent, options, data, keyboard = parent) {
  const place = document.createElement("div");
  parent.append(place);
  const { select, ...rest } = options;
  const u = new uPlot(
    {
      width: Math.max(120, parent.clientWidth || 300),
      legend: { show: false },
      padding: [8, 10, 0, 0],
      ...rest,
      cursor: { y: false, points: { size: 7 }, drag: { x: false, y: false }, ...rest.cursor },
    },
    data,
    place,
  );
  const resize = new ResizeObserver(() => {
    if (parent.clientWidth > 0 && Math.abs(parent.clientWidth - u.width) > 0.5)
      u.setSize({ width: parent.clientWidth, height: u.height });
  });
  resize.observe(parent);
  const recolour = () => u.redraw(false, true);
  window.addEventListener("theme", recolour);

  const move = (event) => {
    const xs = u.data[0];
    const last = xs.length - 1;
    if (last < 0) return;
    const now = u.cursor.idx;
    const to = { ArrowLeft: (now ?? last + 1) - 1, ArrowRight: (now ?? -1) + 1, Home: 0, End: last }[event.key];
    if (to !== undefined) {
      const index = Math.min(last, Math.max(0, to));
      u.setCursor({ left: u.valToPos(xs[index], "x"), top: u.over.clientHeight / 2 });
    } else if (event.key === "Enter" && select && now !== null && now !== undefined) select(now);
    else return;
    event.preventDefault();
  };
  if (keyboard) keyboard.addEventListener("keydown", move);
  if (select) {
    place.classList.add("selectable");
    let pressedAt = 0;
    u.over.addEventListener("pointerdown", (event) => (pressedAt = event.clientX));
    u.over.addEventListener("click", (event) => {
      // The end of a drag is no click.
      if (Math.abs(event.clientX - pressedAt) < 4 && Number.isInteger(u.cursor.idx)) select(u.cursor.idx);
    });
  }
  const end = () => {
    if (!alive.delete(end)) return;
    resize.disconnect();
    window.removeEventListener("theme", recolour);
    keyboard?.removeEventListener("keydown", move);
    u.destroy();
    place.remove();
  };
  alive.add(end);
  return { u, end };
}

/** Charts on the page. */
const alive = new Set();

/** Ends all charts: a page that stays open for weeks must not keep those of views it has left. */
export function endCharts() {
  [...alive].forEach((end) => end());
}

/** Charts over one span of time: one cursor, one zoom. */
export class TimeGroup {
  constructor(onZoom) {
    this.sync = uPlot.sync(`group-${Math.random()}`);
    this.onZoom = onZoom;
    /** What is shown, seconds; `null` shows all there is. */
    this.range = null;
    this.all = [0, 1];
  }

  /** Settings that every chart of the group needs. */
  options() {
    const zoom = (u) => {
      const { left, width } = u.select;
      u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
      if (width < 8) return;
      const range = [u.posToVal(left, "x"), u.posToVal(left + width, "x")];
      // Charts that share the cursor report the same selection: one of them is enough.
      if (this.range && Math.abs(range[0] - this.range[0]) + Math.abs(range[1] - this.range[1]) < 1) return;
      this.onZoom(range);
    };
    return {
      scales: { x: { time: true, range: () => this.range ?? this.all } },
      cursor: {
        sync: { key: this.sync.key, setSeries: false, scales: ["x", null] },
        drag: { x: true, y: false, setScale: false, dist: 8 },
        bind: { dblclick: () => () => this.onZoom(null) },
      },
      hooks: { setSelect: [zoom] },
    };
  }
}

/** Seconds since 1970 of an RFC 3339 time. */
export const seconds = (iso) => Date.parse(iso) / 1000;

/** A pause this many times the usual step is a gap, if it is to be seen at all: this share of the whole span. */
const GAP = 6;
export const GAP_SHARE = 0.02;

function median(values) {
  return values.sort((a, b) => a - b)[Math.floor(values.length / 2)];
}

/**
 * Columns with a row of nulls in every long pause, so that no line is drawn across it.
 * Gives `{times, columns, origin, gaps}`; `origin[i]` is the row before, or -1.
 */
export function withGaps(times, columns) {
  const steps = times.slice(1).map((t, i) => t - times[i]);
  const limit = steps.length > 1 ? Math.max(GAP * median(steps), GAP_SHARE * (times.at(-1) - times[0])) : Infinity;
  const out = { times: [], columns: columns.map(() => []), origin: [], gaps: [] };
  const push = (time, index) => {
    out.times.push(time);
    out.origin.push(index);
    columns.forEach((column, c) => out.columns[c].push(index < 0 ? null : (column[index] ?? null)));
  };
  times.forEach((time, i) => {
    if (i > 0 && time - times[i - 1] > limit) {
      out.gaps.push([times[i - 1], time]);
      push((times[i - 1] + time) / 2, -1);
    }
    push(time, i);
  });
  return out;
}

/** Merges options of several sources: hooks are chained, the rest is replaced two levels deep. */
export function merged(...sources) {
  const out = {};
  for (const source of sources) {
    for (const [key, value] of Object.entries(source)) {
      if (key === "hooks") {
        out.hooks ??= {};
        for (const [name, list] of Object.entries(value)) out.hooks[name] = [...(out.hooks[name] ?? []), ...list];
      } else if (value && typeof value === "object" && !Array.isArray(value) && out[key])
        out[key] = { ...out[key], ...value };
      else out[key] = value;
    }
  }
  return out;
}
