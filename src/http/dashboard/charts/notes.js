// Notes of people on the time line: a dotted line with a flag for a moment, a faint band with two such lines for a period.

import { draw, rule, seconds, shade } from "./base.js";
import { colour } from "./theme.js";

/** Draws notes `{from, to}` behind a chart over time. */
export function drawNotes(u, notes = []) {
  const periods = notes.filter((note) => note.to !== null).map((note) => [seconds(note.from), seconds(note.to)]);
  shade(u, periods, "curve-3", { opacity: 0.08 });
  const moments = notes.flatMap((note) => [note.from, note.to].filter((time) => time !== null).map(seconds));
  for (const time of moments) rule(u, time, "curve-3", [1, 3], "x");
  draw(u, (pen) => {
    pen.fillStyle = colour("curve-3");
    const size = 7 * devicePixelRatio;
    for (const note of notes) {
      const x = u.valToPos(seconds(note.from), "x", true);
      if (x < u.bbox.left || x > u.bbox.left + u.bbox.width) continue;
      pen.beginPath();
      pen.moveTo(x, u.bbox.top);
      pen.lineTo(x + size, u.bbox.top + size / 2);
      pen.lineTo(x, u.bbox.top + size);
      pen.closePath();
      pen.fill();
    }
  });
}
