// Charts with uPlot: responsive size, colours of the theme, keyboard control, and a common time axis.

import uPlot from "../vendor/uPlot.esm.js";
import { colour, faint, stripes } from "./theme.js";

const FONT = "12px system-ui, sans-serif";
const DAY_S = 86400;
/** Width in pixels of the left axis of every chart, so that the time axes of stacked charts are aligned. */
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

/** The time axis; without labels if a chart below shows them. */
export function timeAxis(labels = true) {
  const size = (u, words) => (words?.some((word) => word.includes("\n")) ? 40 : 26);
  return axis({ values: labels ? timeLabels : () => [], size: labels ? size : 8, space: 74 });
}

/** An axis of numbers with its unit. */
export function valueAxis(label, more = {}) {
  return axis({ label, labelSize: 16, labelGap: 0, size: LEFT - 16, space: 28, ...more });
}

/** A horizontal axis of numbers. */
export function acrossAxis(label, more = {}) {
  return axis({ label, labelSize: 18, size: 28, space: 50, ...more });
}

/** A curve, interrupted at gaps in the data. */
export function curve(name, more = {}) {
  return { stroke: () => colour(name), width: 1.5, spanGaps: false, points: { show: false }, ...more };
}

/** Shows the points of a curve if there are few enough to distinguish them. */
export function fewPoints(count) {
  return { show: count < 90, size: 5 };
}

/** A bound of an interval; it is invisible and only delimits a band. */
export const edge = () => ({ stroke: "transparent", width: 0, points: { show: false }, spanGaps: false });

/** The band between two series. */
export function band(upper, lower, name, opacity = 0.2) {
  return { series: [upper, lower], fill: () => faint(name, opacity) };
}

/** A line at a constant value; call it in the `draw` hook. */
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

/** Shades time intervals `[from_s, to_s]`, optionally with stripes. */
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

/** Draws on the canvas of a chart and restores the settings of its context afterwards. */
export function draw(u, work) {
  u.ctx.save();
  work(u.ctx);
  u.ctx.restore();
}

/** A mark at a position on the canvas: `cross`, `triangle`, `ring` or `dot`. */
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
 * Creates a chart in `parent`. Options are those of uPlot without the width, plus `select`. The keys ←, →, Home and End move
 * the cursor; Enter and a click call `options.select(index)`.
 */
export function chart(parent, options, data, keyboard = parent) {
  const place = document.createElement("div");
  parent.append(place);
  const { select, ...rest } = options;
  const common = { legend: { show: false }, padding: [8, 10, 0, 0], ...rest };
  const u = new uPlot(
    {
      ...common,
      width: Math.max(120, parent.clientWidth || 300),
      cursor: { y: false, points: { size: 7 }, drag: { x: false, y: false }, ...rest.cursor },
    },
    data,
    place,
  );
  /** The same chart once more, without cursor and outside the page, for a file. */
  const copy = () => {
    const { drawClear, draw } = rest.hooks ?? {};
    const hooks = Object.fromEntries(Object.entries({ drawClear, draw }).filter(([, list]) => list));
    const size = { width: u.width, height: u.height };
    return new uPlot({ ...common, ...size, hooks, cursor: { show: false } }, data, document.createElement("div"));
  };
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
      // The end of a drag also raises a click event, which must not select a point.
      if (Math.abs(event.clientX - pressedAt) < 4 && Number.isInteger(u.cursor.idx)) select(u.cursor.idx);
    });
  }
  const end = () => {
    if (!liveCharts.delete(end)) return;
    place.remove();
    drawn.delete(place);
    resize.disconnect();
    window.removeEventListener("theme", recolour);
    keyboard?.removeEventListener("keydown", move);
    u.destroy();
  };
  drawn.set(place, { copy, u });
  liveCharts.add(end);
  return { u, end };
}

/** The charts by their elements. */
const drawn = new Map();

/** The charts of a plot from top to bottom, for a file: `{copy, width, height}`. */
export function chartsIn(plot) {
  const charts = [...plot.children].map((place) => drawn.get(place)).filter(Boolean);
  return charts.map(({ copy, u }) => ({ copy, width: u.width, height: u.height }));
}

/** `end` functions of all charts on the page. */
const liveCharts = new Set();

/** Removes all charts. Otherwise a page that stays open for weeks would keep the charts of earlier views in memory. */
export function endCharts() {
  [...liveCharts].forEach((end) => end());
}

/** The selection of a chart in which nothing is selected. */
const NOTHING = { left: 0, top: 0, width: 0, height: 0 };

/** Charts with a common time span, cursor and zoom. */
export class TimeGroup {
  constructor(onZoom) {
    this.sync = uPlot.sync(`group-${Math.random()}`);
    this.onZoom = onZoom;
    /** Takes the time span of a drag instead of `onZoom`, while a period is marked; `null` otherwise. */
    this.onMark = null;
    /** Time span that is marked and not decided upon, in seconds. */
    this.marked = null;
    /** Resolves when the button or finger that is down on a chart is lifted; `null` while none is down. */
    this.held = null;
    /** Time span shown, in seconds; `null` shows the whole record `all`. */
    this.range = null;
    this.all = [0, 1];
  }

  /** Takes what is marked off all charts. */
  clearSelection() {
    this.marked = null;
    for (const u of this.sync.plots) u.setSelect(NOTHING, false);
  }

  /** Shows what is marked on a chart that was drawn anew, because of further batches for example. */
  showMarked(u) {
    if (!this.marked) return;
    const [left, right] = this.marked.map((time) => u.valToPos(time, "x"));
    u.setSelect({ left, width: right - left, top: 0, height: u.over.clientHeight }, false);
  }

  /** Waits until nothing is down on a chart: one that is drawn anew during a drag would lose it. */
  async released() {
    while (this.held) await this.held;
  }

  /** Notes from when to when a button or a finger is down on a chart. */
  watchHold(u) {
    u.over.addEventListener("pointerdown", () => {
      this.held ??= new Promise((resolve) => {
        const over = new AbortController();
        const release = () => {
          over.abort();
          // The events of the mouse, by which the chart ends the drag, follow those of the pointer.
          setTimeout(() => {
            this.held = null;
            resolve();
          });
        };
        for (const end of ["pointerup", "pointercancel", "blur"]) window.addEventListener(end, release, { signal: over.signal });
      });
    });
  }

  /** Lets a finger mark a period on a chart, which otherwise hears a mouse only. */
  markByTouch(u) {
    let from = null;
    const span = (event) => {
      const box = u.over.getBoundingClientRect();
      const now = Math.min(box.width, Math.max(0, event.clientX - box.left));
      return { left: Math.min(from ?? now, now), width: Math.abs((from ?? now) - now), now };
    };
    const show = (event, ended) => {
      const { left, width } = span(event);
      u.setSelect({ left, width, top: 0, height: u.over.clientHeight }, ended);
    };
    u.over.addEventListener("pointerdown", (event) => {
      if (!this.onMark || event.pointerType !== "touch" || !event.isPrimary) return;
      from = span(event).now;
      u.over.setPointerCapture(event.pointerId);
    });
    u.over.addEventListener("pointermove", (event) => from !== null && event.isPrimary && show(event, false));
    u.over.addEventListener("pointerup", (event) => {
      if (from === null || !event.isPrimary) return;
      show(event, true);
      from = null;
    });
    u.over.addEventListener("pointercancel", () => (from = null));
  }

  /** uPlot options common to all charts of the group. */
  options() {
    const zoom = (u) => {
      const { left, width } = u.select;
      const range = [u.posToVal(left, "x"), u.posToVal(left + width, "x")];
      // What is marked stays visible until it is decided upon.
      if (this.onMark && width >= 8) {
        this.marked ??= range;
        this.onMark(range);
        return;
      }
      u.setSelect(NOTHING, false);
      if (width < 8) return;
      // All charts with the common cursor report the same selection; only the first report counts.
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
      hooks: { ready: [(u) => this.watchHold(u), (u) => this.markByTouch(u)], draw: [(u) => this.showMarked(u)], setSelect: [zoom] },
    };
  }
}

/** Seconds since 1970 of an RFC 3339 time. */
export const seconds = (iso) => Date.parse(iso) / 1000;

/** A pause is a gap if it is longer than `GAP` median steps and than the share `GAP_SHARE` of the whole time span. */
const GAP = 6;
export const GAP_SHARE = 0.02;

function median(values) {
  return values.sort((a, b) => a - b)[Math.floor(values.length / 2)];
}

/**
 * Inserts a row of nulls into every gap, so that no line is drawn across it. Returns `{times, columns, origin, gaps}`, where
 * `origin[i]` is the index of row `i` in the input, or -1 for an inserted row.
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

/** Merges uPlot options: hooks are concatenated, other objects are merged one level deep, all else is replaced. */
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
