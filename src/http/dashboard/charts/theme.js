// Colours of the charts, taken from the style sheets and read again when the theme changes.

let cache = new Map();

/** A hidden element that resolves colours: the canvas supports neither custom properties nor `light-dark()`. */
const probe = document.createElement("span");
probe.hidden = true;
document.body.append(probe);

/** The value of a colour by its name in the style sheet. */
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

/** Clears the cached colours and raises the event `theme`, on which charts are redrawn. */
export function themeChanged() {
  cache = new Map();
  window.dispatchEvent(new Event("theme"));
}

/** A stripe pattern, so that periods without measurements can be recognised without colour. */
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
