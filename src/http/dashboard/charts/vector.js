// A drawing context that writes SVG: the part of `CanvasRenderingContext2D` that uPlot and the charts of this page use. A chart that
// is drawn on it becomes a picture of the same curves, marks and axes, without a second program that draws charts.

/** Parses colours: browsers do not agree in how they write `color-mix()`. */
const probe = document.createElement("canvas").getContext("2d");

/** A colour of the canvas as a colour of SVG 1.1 with its opacity. */
function paint(value) {
  if (typeof value !== "string") return { colour: value.url, opacity: 1 };
  probe.fillStyle = "#000000";
  probe.fillStyle = value;
  const text = probe.fillStyle;
  if (text.startsWith("#")) return { colour: text.slice(0, 7), opacity: 1 };
  const numbers = text.match(/-?[\d.]+(e-?\d+)?/g).map(Number);
  const [r, g, b] = numbers.slice(0, 3).map((v) => Math.round(text.startsWith("color(") ? 255 * v : v));
  return { colour: `rgb(${r},${g},${b})`, opacity: numbers[3] ?? 1 };
}

const short = (value) => String(Number(value.toFixed(2)));

/** Text for an attribute or the content of an element. */
export const escaped = (text) =>
  String(text).replace(/[&<>"]/g, (c) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" })[c]);

/** Writes the commands of a path as the attribute `d`. */
const WRITE = {
  moveTo: (x, y) => `M${short(x)} ${short(y)}`,
  lineTo: (x, y) => `L${short(x)} ${short(y)}`,
  bezierCurveTo: (...v) => `C${v.map(short).join(" ")}`,
  quadraticCurveTo: (...v) => `Q${v.map(short).join(" ")}`,
  rect: (x, y, w, h) => `M${short(x)} ${short(y)}h${short(w)}v${short(h)}h${short(-w)}z`,
  closePath: () => "z",
  arc: (x, y, r, from, to) => {
    const at = (angle) => `${short(x + r * Math.cos(angle))} ${short(y + r * Math.sin(angle))}`;
    const half = (from + to) / 2;
    return `M${at(from)}A${short(r)} ${short(r)} 0 0 1 ${at(half)}A${short(r)} ${short(r)} 0 0 1 ${at(to)}`;
  },
};

const Native = window.Path2D;

/** A command of a path; as on a canvas, a line without a beginning begins at its end. */
const continued = (before, name, values) => WRITE[before === "" && name === "lineTo" ? "moveTo" : name](...values);

/** A path that can also be drawn on a canvas, because charts of the page may be redrawn while a copy is recorded. */
class Path extends Native {
  constructor(other) {
    super(other);
    this.d = other?.d ?? "";
  }
}
for (const name of Object.keys(WRITE)) {
  Path.prototype[name] = function (...values) {
    Native.prototype[name].apply(this, values);
    this.d += continued(this.d, name, values);
  };
}

const FIRST = {
  fillStyle: "#000000",
  strokeStyle: "#000000",
  lineWidth: 1,
  lineJoin: "miter",
  lineCap: "butt",
  font: "10px sans-serif",
  textAlign: "start",
  textBaseline: "alphabetic",
  globalAlpha: 1,
};
const ANCHORS = { left: "start", start: "start", center: "middle", right: "end", end: "end" };
/** Shift of the base line in units of the font size: not every program reads `dominant-baseline`. */
const SHIFTS = { top: 0.8, hanging: 0.8, middle: 0.33, alphabetic: 0, bottom: -0.2, ideographic: -0.2 };

let numbering = 0;

/** The context. Settings are plain properties; `svg()` returns what was drawn. */
export class SvgContext {
  #parts = [];
  #definitions = [];
  #stack = [];
  #path = "";
  #open = [];
  #dash = [];
  #matrix = [1, 0, 0, 1, 0, 0];
  #clips = [];

  constructor(canvas) {
    this.canvas = canvas;
    Object.assign(this, FIRST);
  }

  save() {
    const settings = Object.fromEntries(Object.keys(FIRST).map((name) => [name, this[name]]));
    this.#stack.push({ settings, dash: this.#dash, matrix: this.#matrix, clips: this.#clips });
  }
  restore() {
    const before = this.#stack.pop();
    if (!before) return;
    Object.assign(this, before.settings);
    this.#dash = before.dash;
    this.#matrix = before.matrix;
    this.#clips = before.clips;
  }
  translate(x, y) {
    const [a, b, c, d, e, f] = this.#matrix;
    this.#matrix = [a, b, c, d, a * x + c * y + e, b * x + d * y + f];
  }
  rotate(angle) {
    const [a, b, c, d, e, f] = this.#matrix;
    const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
    this.#matrix = [a * cos + c * sin, b * cos + d * sin, c * cos - a * sin, d * cos - b * sin, e, f];
  }
  setLineDash(dash) {
    this.#dash = dash;
  }
  beginPath() {
    this.#path = "";
  }
  moveTo(...values) {
    this.#path += WRITE.moveTo(...values);
  }
  lineTo(...values) {
    this.#path += continued(this.#path, "lineTo", values);
  }
  rect(...values) {
    this.#path += WRITE.rect(...values);
  }
  arc(...values) {
    this.#path += WRITE.arc(...values);
  }
  closePath() {
    this.#path += WRITE.closePath();
  }
  clearRect() {}
  clip(path) {
    numbering += 1;
    const id = `clip-${numbering}`;
    this.#definitions.push(`<clipPath id="${id}"><path d="${path?.d ?? this.#path}"${this.#transform()}/></clipPath>`);
    this.#clips = [...this.#clips, id];
  }
  createPattern(tile) {
    numbering += 1;
    const size = `width="${tile.width}" height="${tile.height}"`;
    const image = `<image href="${tile.toDataURL()}" ${size}/>`;
    this.#definitions.push(`<pattern id="pattern-${numbering}" ${size} patternUnits="userSpaceOnUse">${image}</pattern>`);
    return { url: `url(#pattern-${numbering})` };
  }
  fill(path) {
    this.#shape(path?.d ?? this.#path, "fill");
  }
  stroke(path) {
    this.#shape(path?.d ?? this.#path, "stroke");
  }
  fillRect(x, y, w, h) {
    this.#shape(WRITE.rect(x, y, w, h), "fill");
  }
  strokeRect(x, y, w, h) {
    this.#shape(WRITE.rect(x, y, w, h), "stroke");
  }
  fillText(text, x, y) {
    const { colour, opacity } = paint(this.fillStyle);
    const [, weight, size, family] = this.font.match(/(bold |[1-9]00 )?([\d.]+)px (.*)$/);
    const shift = (SHIFTS[this.textBaseline] ?? 0) * Number(size);
    this.#add(
      `<text x="${short(x)}" y="${short(y + shift)}" fill="${colour}" fill-opacity="${opacity * this.globalAlpha}" font-size="${size}" ` +
        `font-family="${escaped(family)}"${weight ? ` font-weight="${weight.trim()}"` : ""} text-anchor="${ANCHORS[this.textAlign]}"${this.#transform()}>${escaped(text)}</text>`,
    );
  }

  #shape(d, kind) {
    const { colour, opacity } = paint(this[`${kind}Style`]);
    const alpha = opacity * this.globalAlpha;
    if (d === "" || alpha === 0 || (kind === "stroke" && this.lineWidth === 0)) return;
    const dash = this.#dash.length > 0 ? ` stroke-dasharray="${this.#dash.map(short).join(" ")}"` : "";
    const line = `fill="none" stroke="${colour}" stroke-opacity="${short(alpha)}" stroke-width="${short(this.lineWidth)}" stroke-linejoin="${this.lineJoin}" stroke-linecap="${this.lineCap}"${dash}`;
    const area = `fill="${colour}" fill-opacity="${short(alpha)}"`;
    this.#add(`<path d="${d}" ${kind === "fill" ? area : line}${this.#transform()}/>`);
  }
  #transform() {
    const isUnit = this.#matrix.every((v, i) => v === [1, 0, 0, 1, 0, 0][i]);
    return isUnit ? "" : ` transform="matrix(${this.#matrix.map((v) => Number(v.toFixed(5))).join(" ")})"`;
  }
  /** Adds an element inside the groups of its clip paths; groups stay open as long as they are the same. */
  #add(element) {
    if (this.#open.join() !== this.#clips.join()) {
      this.#parts.push("</g>".repeat(this.#open.length), ...this.#clips.map((id) => `<g clip-path="url(#${id})">`));
      this.#open = this.#clips;
    }
    this.#parts.push(element);
  }
  /** The definitions and elements drawn so far. */
  svg() {
    return `<defs>${this.#definitions.join("")}</defs>${this.#parts.join("")}${"</g>".repeat(this.#open.length)}`;
  }
}
/**
 * Runs `make`, which creates and returns a uPlot chart, so that the chart draws on an `SvgContext`. Resolves to its elements.
 * uPlot takes its context when it is created and draws in the microtasks after it.
 */
export async function record(make) {
  const { getContext } = HTMLCanvasElement.prototype;
  let context = null;
  let u = null;
  window.Path2D = Path;
  try {
    HTMLCanvasElement.prototype.getContext = function () {
      context ??= new SvgContext(this);
      return context;
    };
    try {
      u = make();
    } finally {
      HTMLCanvasElement.prototype.getContext = getContext;
    }
    await Promise.resolve();
    await Promise.resolve();
  } finally {
    window.Path2D = Native;
  }
  u.destroy();
  return context.svg();
}
