// The steps from a new structure to its first verdict: what is done, what comes next, and the button that does it. Where the service trains by
// itself, there are three; the training is a line below "Model" then.

import { h, icon } from "../dom.js";
import { help } from "../help.js";

/** The steps in their order: name, what it is for, and the words of the button. */
const ALL = [
  ["Describe", "Masses, springs or beams, and which stiffnesses are unknown.", "Describe a structure"],
  ["Train", "The service simulates the structure and learns which stiffnesses belong to which frequencies.", "Train a model"],
  ["Upload", "Measured frequencies: drag a table onto the page, or let a program send them.", "Upload measurements"],
  ["Mark the healthy period", "The days on which the structure was known to be undamaged; everything else is compared with them.", "Mark the healthy period"],
];

/** The entry of the glossary for a step, where there is one. */
const TERMS = { Describe: "structure", Train: "calibration", Upload: "batch", "Mark the healthy period": "undamaged reference" };

/** The step that is left out where the service trains by itself. */
const TRAIN = 1;

/**
 * The guide, or `null` once all steps are done. `done` says for each step whether it is, `act` what its button does. A step whose button
 * is missing cannot be done yet. `trains`: whether the service trains by itself.
 */
export function guide({ title, done: all, act: acts, trains, more }) {
  const shown = (_, i) => !trains || i !== TRAIN;
  const [steps, done, act] = [ALL, all, acts].map((list) => list.filter(shown));
  if (done.every(Boolean)) return null;
  const next = done.indexOf(false);
  const step = ([name, purpose, words], i) =>
    h(
      "li",
      { dataset: { step: i + 1, state: done[i] ? "done" : i === next ? "next" : "later" }, "aria-current": i === next ? "step" : null },
      h("span", { class: "step-sign" }, done[i] ? icon("check") : String(i + 1)),
      h(
        "div",
        { class: "grow" },
        h("strong", null, name),
        done[i] && h("span", { class: "hidden-text" }, " (done)"),
        " ",
        help(TERMS[name]),
        !done[i] && h("span", { class: "fine" }, purpose),
        i === next && h("p", { class: "buttons start" }, h("button", { type: "button", class: "primary", onclick: act[i] }, words)),
      ),
    );
  return h("div", { class: "blank guide" }, h("h2", null, title), h("ol", { class: "steps" }, steps.map(step)), more);
}
