// Maintenance windows: batches measured in them do not update the control charts.

import { at, read, send } from "../api.js";
import { ask, fill, h, icon, problem } from "../dom.js";
import { timeElement, zone } from "../format.js";

/** A time in the viewer's zone, in the format of a `datetime-local` field. */
function field(date) {
  const shifted = new Date(date.getTime() - 60000 * date.getTimezoneOffset());
  return shifted.toISOString().slice(0, 16);
}

export function maintenance(structure, changed) {
  const content = h("div", null);
  const add = h("button", { type: "button", onclick: () => addWindow() }, icon("wrench"), "Add a maintenance window");
  const element = h(
    "section",
    { id: "maintenance", class: "panel", "aria-labelledby": "maintenance-title" },
    h("h2", { id: "maintenance-title" }, "Maintenance"),
    content,
    h("p", null, add),
  );
  const load = async () => {
    try {
      const { items } = await read(at(structure, "/maintenance"));
      const line = (w) =>
        h(
          "li",
          null,
          icon("wrench"),
          h(
            "span",
            { class: "grow" },
            w.reason,
            h("span", { class: "fine" }, timeElement(w.from), " to ", timeElement(w.to)),
          ),
        );
      fill(
        content,
        items.length === 0
          ? h(
              "p",
              { class: "soft" },
              "No maintenance windows. Batches measured during work on the structure can raise alarms unless a window is added before they arrive.",
            )
          : h("ul", { class: "alarms" }, items.map(line)),
      );
    } catch (error) {
      fill(content, problem(error, load));
    }
  };
  const addWindow = async () => {
    const now = new Date();
    const done = await ask({
      title: "Add a maintenance window",
      body: h(
        "p",
        null,
        "Batches measured in the window are stored and assessed, but do not update the control charts and raise no alarm.",
      ),
      fields: [
        { name: "from", label: `From (${zone()})`, type: "datetime-local", required: true, value: field(now) },
        {
          name: "to",
          label: `To (${zone()})`,
          type: "datetime-local",
          required: true,
          value: field(new Date(now.getTime() + 4 * 3600e3)),
        },
        { name: "reason", label: "Reason", required: true, maxlength: 500 },
      ],
      confirm: "Add",
      submit: ({ from, to, reason }) =>
        send(at(structure, "/maintenance"), {
          from: new Date(from).toISOString(),
          to: new Date(to).toISOString(),
          reason: reason.trim(),
        }),
    });
    if (done) {
      await load();
      changed();
    }
  };
  return { element, load };
}
