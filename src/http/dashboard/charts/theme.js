// Colours of the charts: those of the style sheets, read again when the theme changes.

let cache = new Map();

/** Resolves a colour for the canvas, which knows no custom properties and no `light-dark()`. */
const probe = document.createElement("span");
probe.hidden = true;
document.body.append(probe);

/** A colour of the style sheet by its name there. */
export function colour(name) {
  if (!cache.has(name)) {
    probe.style.color = `var(--${name})`;
    cache.set(name, getComputedStyle(probe).color);
  }
  return cache.get(name);
}

/** The colour with an opacity from 0 to 1. */
export function faint(name, opacity) {
  return `color-mix(in srgb, ${colour(name)} ${Math.round(100 * opacity)}%, transparent)`;
}

/** Forgets the colours; charts draw again on the event `theme`. */
export function themeChanged() {
  cache = new Map();
  window.dispatchEvent(new Event("theme"));
}

/** Stripes for "nothing was measured here" and "maintenance": told apart without colour. */
export function stripes(context, name) {
  const tile = document.createElement("canvas");
  const size = Math.round(8 * devicePixelRatio);
  tile.width = tile.height = size;
  const pen = tile.getContext("2d");
  pen.strokeStyle = faint(name, 0.4);
  pen.lineWidth = devicePixelRatio;
  for (const shift of [-size, 0, size]) {
    pen.moveTo(shift, size);
    pen.lineTo(shift + size, 0);
  }
  pen.stroke();
  return context.createPattern(tile, "repeat");
}
