// Marking the healthy period: while it lasts, dragging over a chart proposes an undamaged reference instead of zooming.

import { h, icon } from "../dom.js";

/** `propose(range)` opens the dialog about a time span in seconds and resolves when it is closed. */
export function marking(group, propose) {
  const button = h("button", { type: "button", "aria-pressed": "false", onclick: () => (group.onMark ? end() : begin()) }, "Mark the healthy period");
  const hint = h(
    "p",
    { class: "callout", role: "status", hidden: true },
    icon("note"),
    "Drag over the healthy period on any chart, with the mouse or a finger. Escape ends this. With the keyboard, choose the time span by “From … to …”, and then “Use this time span as undamaged reference”.",
  );
  /** Whether the dialog is open: all charts report the same drag. */
  let asking = false;

  function show(on) {
    button.setAttribute("aria-pressed", String(on));
    hint.hidden = !on;
    button.closest(".view")?.classList.toggle("marking", on);
  }

  function begin() {
    group.onMark = async (range) => {
      if (asking) return;
      asking = true;
      await propose(range);
      asking = false;
      end();
    };
    show(true);
  }

  function end() {
    if (!group.onMark) return;
    group.onMark = null;
    group.clearSelection();
    show(false);
  }

  const escape = (event) => {
    if (event.key === "Escape" && !asking) end();
  };
  document.addEventListener("keydown", escape);

  return { button, hint, begin, end, leave: () => document.removeEventListener("keydown", escape) };
}
