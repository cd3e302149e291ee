// The drawing of the structure: colours are changes, outlines are open alarms, a click on a part shows its charts.

import { at, request } from "../api.js";
import { motion } from "../charts/motion.js";
import { fill, h } from "../dom.js";

/** `choose(name)` is called with the name of a part that the user selects. */
export function drawing(structure, choose) {
  const place = h("div", { class: "drawing" });
  const picker = h("select", { id: "drawing-mode", onchange: () => load() });
  const moving = motion();
  const element = h(
    "div",
    { class: "figure", dataset: { drawing: structure }, hidden: true },
    h("h3", null, "Structure"),
    h("p", { class: "row" }, h("label", { for: "drawing-mode" }, "Mode shape"), picker, moving.button),
    place,
    h(
      "p",
      { class: "fine" },
      "Orange: softer than in the undamaged reference, strongest from −10 %; blue: stiffer; grey: no change or no comparison; outlined: open alarm. As of the latest assessed batch. Select a part, by mouse or by Tab and Enter, to see its control chart.",
    ),
  );
  const load = async () => {
    const mode = picker.value === "" ? "" : `?mode=${picker.value}`;
    const answer = await request(at(structure, `/drawing.svg${mode}`));
    const svg = new DOMParser().parseFromString(await answer.text(), "image/svg+xml").documentElement;
    const drawn = document.importNode(svg, true);
    const focused = place.contains(document.activeElement) ? document.activeElement.dataset.name : null;
    fill(place, drawn);
    moving.watch(drawn);
    // A picture has no buttons in it; this drawing has.
    drawn.setAttribute("role", "group");
    for (const part of place.querySelectorAll("[data-name]")) {
      // The name of the button is its text: without a space, name and value would be one word.
      for (const text of part.querySelectorAll("text")) text.before(" ");
      part.setAttribute("role", "button");
      part.setAttribute("tabindex", "0");
      part.addEventListener("click", () => choose(part.dataset.name));
      part.addEventListener("keydown", (event) => {
        if (event.key !== "Enter" && event.key !== " ") return;
        event.preventDefault();
        choose(part.dataset.name);
      });
      if (part.dataset.name === focused) part.focus();
    }
    element.hidden = false;
  };

  return {
    element,
    async load(info) {
      // A table of finite-element runs has no geometry.
      if (info.definition.simulation === "table") return;
      const modes = info.nominal_frequencies_hz.length;
      if (picker.options.length === 0) {
        fill(
          picker,
          h("option", { value: "" }, "none"),
          Array.from({ length: modes }, (_, i) => h("option", { value: i + 1 }, `mode ${i + 1}`)),
        );
      }
      await load();
    },
  };
}
