// Notes on the time line: what people write about a moment or a period; they change nothing but the charts.

import { at, read, request, send, token } from "../api.js";
import { ask, fieldTime, fill, h, icon, notify, problem, refill } from "../dom.js";
import { timeElement, zone } from "../format.js";

export function notes(structure, changed) {
  const content = h("div", null);
  const add = h("button", { type: "button", onclick: () => addNote() }, icon("note"), "Add a note");
  const element = h(
    "section",
    { id: "notes", class: "panel", "aria-labelledby": "notes-title" },
    h("h2", { id: "notes-title" }, "Notes"),
    h("p", { class: "fine" }, "Notes are marked by flags on the charts and listed in the condition report."),
    content,
    h("p", null, add),
  );
  const line = (note) =>
    h(
      "li",
      { dataset: { key: note.note } },
      icon("note"),
      h(
        "span",
        { class: "grow" },
        h("span", { class: "written" }, note.text),
        h(
          "span",
          { class: "fine" },
          timeElement(note.from),
          note.to && [" to ", timeElement(note.to)],
          `, written by ${note.author}`,
        ),
      ),
      h(
        "button",
        { type: "button", onclick: () => remove(note) },
        "Delete",
        h("span", { class: "hidden-text" }, ` the note of ${note.author}`),
      ),
    );
  const load = async () => {
    try {
      const { items } = await read(at(structure, "/notes"));
      refill(
        content,
        items.length === 0 ? h("p", { class: "soft" }, "No notes so far.") : h("ul", { class: "alarms" }, items.map(line)),
      );
    } catch (error) {
      fill(content, problem(error, load));
    }
  };
  const again = async () => {
    await load();
    changed();
  };
  const remove = async (note) => {
    const done = await ask({
      title: "Delete the note",
      body: h("p", null, `“${note.text}” disappears from the charts and reports.`),
      confirm: "Delete",
      danger: true,
      submit: async () => {
        await request(at(structure, `/notes/${encodeURIComponent(note.note)}`), { method: "DELETE" });
        return true;
      },
    });
    if (done) await again();
  };
  const addNote = async () => {
    const done = await ask({
      title: "Add a note",
      body: h("p", null, "A note about a moment, or about a period if an end is given."),
      fields: [
        { name: "from", label: `At or from (${zone()})`, type: "datetime-local", required: true, value: fieldTime(Date.now() / 1000) },
        { name: "to", label: `To (${zone()}, optional)`, type: "datetime-local" },
        { name: "text", label: "Note", type: "textarea", required: true, maxlength: 2000 },
        ...authorField(),
      ],
      confirm: "Add",
      submit: async ({ from, to, text, author }) => {
        const iso = (local) => new Date(local).toISOString();
        const times = to ? { from: iso(from), to: iso(to) } : { at: iso(from) };
        const added = await send(at(structure, "/notes"), { ...times, text: plain(text), ...authorBody(author) });
        notify("The note has been added.");
        return added;
      },
    });
    if (done) await again();
  };
  return { element, load };
}

/** Text of a field with the line breaks that the service takes. */
export function plain(text) {
  return text.trim().replace(/\r\n?/g, "\n");
}

/** The field for the name, which is needed only without a token: with one, its name is recorded. */
export function authorField() {
  if (token()) return [];
  const value = localStorage.getItem("modalwatch.name") ?? "";
  return [{ name: "author", label: "Your name", required: true, maxlength: 500, autocomplete: "name", value }];
}

/** The part of a body that names the author. */
export function authorBody(author) {
  if (token()) return {};
  localStorage.setItem("modalwatch.name", author.trim());
  return { author: author.trim() };
}
