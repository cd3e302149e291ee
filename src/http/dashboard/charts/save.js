// Figures as files: SVG, PNG and CSV.

import { colour } from "./theme.js";
import { escaped, record } from "./vector.js";

const WIDE_PX = 16;
const TITLE_PX = 30;
const LINE_PX = 20;
/** Pixels of a PNG for each pixel on the screen, so that it is sharp in print. */
const PNG_SCALE = 2;
const FAMILY = "system-ui, sans-serif";

/** A mark of the legend, `x` and `y` at its left and middle. */
function markSvg(name, x, y) {
  const [kind, which] = name.split(/-(?=[^-]*$)/);
  const curve = { 1: "curve-1", 2: "curve-2", 3: "curve-3" }[name.match(/-(\d)/)?.[1]];
  const line = (stroke, dash) =>
    `<path d="M${x} ${y}h20" stroke="${stroke}" stroke-width="2"${dash ? ` stroke-dasharray="${dash}"` : ""}/>`;
  const box = (fill, stroke = "none") =>
    `<rect x="${x}" y="${y - 5}" width="20" height="10" fill="${fill}" stroke="${stroke}"/>`;
  const dot = (fill, stroke = "none") => `<circle cx="${x + 10}" cy="${y}" r="4" fill="${fill}" stroke="${stroke}" stroke-width="2"/>`;
  const tone = (name, opacity) => `${colour(name)}" fill-opacity="${opacity}`;
  if (name.startsWith("heat-")) return box(colour(name), colour("line"));
  if (name === "time-scale") return ["time-0", "time-1", "time-2"].map((t, i) => `<rect x="${x + 7 * i}" y="${y - 5}" width="7" height="10" fill="${colour(t)}"/>`).join("");
  if (name.startsWith("line-3-dash")) return line(colour("curve-3"), "6 3");
  if (kind === "line") return line(colour(curve ?? "ink-soft"));
  if (name === "dash-bad") return line(colour("bad"), "2 3");
  if (name.startsWith("dash")) return line(colour(curve ?? "ink-soft"), "5 4");
  if (kind === "band") return box(tone(curve, 0.25), colour(curve));
  if (kind === "alarm" && which === "frame") return box("none", colour("bad"));
  if (kind === "alarm") return box(tone("bad", 0.25));
  if (kind === "maintenance") return box(tone("maintenance", 0.28));
  if (kind === "span") return box(tone(curve, 0.2));
  if (name === "ring-bad") return dot("none", colour("bad"));
  if (name === "ring") return dot("none", colour("curve-1"));
  if (kind === "dot") return dot(colour(which === "good" ? "good" : curve));
  if (name.startsWith("triangle"))
    return `<path d="M${x + 10} ${y - 5}l5 10h-10z" fill="${colour(name === "triangle-warn" ? "warn" : "bad")}"/>`;
  if (name === "cross") return `<path d="M${x + 6} ${y - 4}l8 8m-8 0l8 -8" stroke="${colour("bad")}" stroke-width="2"/>`;
  if (name === "striped") return `<path d="M${x} ${y + 5}l10 -10m-5 10l10 -10m-5 10l10 -10" stroke="${colour("ink-soft")}"/>`;
  return "";
}

const ruler = document.createElement("canvas").getContext("2d");
function lengthOf(text, font) {
  ruler.font = font;
  return ruler.measureText(text).width;
}

/** The legend in lines of at most `width`; its elements and height. */
function legendSvg(keys, width, top) {
  let [x, y] = [WIDE_PX, top + LINE_PX / 2];
  const parts = [];
  for (const { mark, text } of keys) {
    const long = 26 + lengthOf(text, `12px ${FAMILY}`) + 16;
    if (x > WIDE_PX && x + long > width) [x, y] = [WIDE_PX, y + LINE_PX];
    parts.push(markSvg(mark, x, y));
    parts.push(`<text x="${x + 26}" y="${y + 4}" font-size="12" fill="${colour("ink-soft")}">${escaped(text)}</text>`);
    x += long;
  }
  return { svg: parts.join(""), height: keys.length > 0 ? y + LINE_PX / 2 - top : 0 };
}

/** A figure as an SVG document: title, legend, and its charts below each other. `charts` have `copy()`, `width`, `height`. */
export async function figureSvg({ title, keys, charts }) {
  const needed = lengthOf(title, `600 15px ${FAMILY}`);
  const width = Math.ceil(Math.max(needed, ...charts.map((c) => c.width))) + 2 * WIDE_PX;
  const legend = legendSvg(keys, width - WIDE_PX, TITLE_PX);
  let y = TITLE_PX + legend.height + 4;
  const parts = [];
  // One after the other: while a chart is recorded, the classes of the canvas are replaced.
  for (const chart of charts) {
    const drawn = await record(chart.copy);
    parts.push(`<g transform="translate(${WIDE_PX} ${y}) scale(${1 / devicePixelRatio})">${drawn}</g>`);
    y += chart.height;
  }
  const height = y + 10;
  return (
    `<svg xmlns="http://www.w3.org/2000/svg" width="${width}" height="${height}" viewBox="0 0 ${width} ${height}" font-family="${FAMILY}">` +
    `<title>${escaped(title)}</title><rect width="100%" height="100%" fill="${colour("panel")}"/>` +
    `<text x="${WIDE_PX}" y="20" font-size="15" font-weight="600" fill="${colour("ink")}">${escaped(title)}</text>` +
    `${legend.svg}${parts.join("")}</svg>`
  );
}

/** An SVG document as a PNG. */
export async function png(svg) {
  const image = new Image();
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(svg)}`;
  await image.decode();
  const canvas = document.createElement("canvas");
  canvas.width = PNG_SCALE * image.naturalWidth;
  canvas.height = PNG_SCALE * image.naturalHeight;
  canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
  return new Promise((resolve, reject) =>
    canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("The picture is too large."))), "image/png"),
  );
}

/** Where a spreadsheet may begin a cell with a formula: as in `csv_text.rs`, at the beginning of a text, and behind a separator in it. */
const FORMULA = /(^|[;\t\r\n])(?=(?:['\p{Cf}]|[^\S\t\r\n])*[=+\-@＝＋－＠])/gu;

/** A cell of RFC 4180: numbers with all their digits, missing values empty, what looks like a formula in a text with an apostrophe before it. */
function csvCell(value) {
  if (value === null || value === undefined || (typeof value === "number" && !Number.isFinite(value))) return "";
  const text = typeof value === "string" ? value.replace(FORMULA, "$1'") : String(value);
  return /[",;\t\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
}

/** A table as CSV. */
export function csv({ columns, rows }) {
  return [columns, ...rows].map((row) => `${row.map(csvCell).join(",")}\r\n`).join("");
}

/** Offers a file for download. */
export function download(name, type, content) {
  const url = URL.createObjectURL(content instanceof Blob ? content : new Blob([content], { type }));
  const link = document.createElement("a");
  link.href = url;
  link.download = name;
  link.click();
  // The browser reads the address after the click.
  setTimeout(() => URL.revokeObjectURL(url), 60000);
}

/** A name of a file from words. */
export const fileName = (words) => words.replace(/[^\p{L}\p{N}._-]+/gu, "-").replace(/^-|-$/g, "");
