// The motion of a mode shape in a drawing of a structure. The drawing states each point at rest and its displacement.

import { h } from "../dom.js";

/** Duration of one oscillation, ms: slow enough to be followed, whatever the frequency of the mode. */
const PERIOD_MS = 2400;

const pairs = (text) => text.split(" ").map((pair) => pair.split(",").map(Number));

/**
 * A button that starts and stops the motion, and `watch(svg)` for each new drawing. The shape moves at once, unless the reader prefers
 * reduced motion: then it stands at its largest displacement until the button is pressed.
 */
export function motion() {
  const reduced = matchMedia("(prefers-reduced-motion: reduce)");
  let playing = !reduced.matches;
  let parts = [];
  let svg = null;
  let frame = 0;
  const button = h("button", { type: "button", hidden: true, onclick: () => set(!playing) });

  const place = (share) => {
    for (const { element, rest, moved } of parts) {
      const points = rest.map(([x, y], i) => [x + share * moved[i][0], y + share * moved[i][1]]);
      if (element.tagName === "circle") {
        element.setAttribute("cx", points[0][0].toFixed(1));
        element.setAttribute("cy", points[0][1].toFixed(1));
      } else {
        element.setAttribute("points", points.map(([x, y]) => `${x.toFixed(1)},${y.toFixed(1)}`).join(" "));
      }
    }
  };
  const step = (time) => {
    // A drawing that was replaced moves no longer.
    if (!playing || !svg?.isConnected) {
      frame = 0;
      return;
    }
    place(Math.cos((2 * Math.PI * time) / PERIOD_MS));
    frame = requestAnimationFrame(step);
  };
  const set = (on) => {
    playing = on;
    button.textContent = on ? "Pause motion" : "Play motion";
    if (!on) place(1);
    else if (frame === 0 && parts.length > 0) frame = requestAnimationFrame(step);
  };
  set(playing);

  return {
    button,
    watch(drawn) {
      svg = drawn;
      parts = [...drawn.querySelectorAll("[data-moved]")].map((element) => ({
        element,
        rest: pairs(element.dataset.rest),
        moved: pairs(element.dataset.moved),
      }));
      button.hidden = parts.length === 0;
      set(playing);
    },
  };
}
