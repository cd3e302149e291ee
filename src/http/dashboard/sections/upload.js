// Upload of a table of measurements: choose or drag a file, check what the service understood of it, then store its batches.

import { at, read, request } from "../api.js";
import { cell, fill, h, icon, notify, problem } from "../dom.js";
import { count, utc } from "../format.js";

/** Time between two looks at how many batches have been stored, ms. */
const LOOK_MS = 1000;

const SPLITS = [
  ["", "One batch, of at most 48 hours"],
  ["1d", "A batch for each day"],
  ["6h", "A batch for every 6 hours"],
  ["1h", "A batch for each hour"],
  ["gap:2h", "A new batch after a pause of 2 hours"],
  ["7d", "A batch for every 7 days"],
  ["none", "All in one batch, however long"],
];
const ORDERS = [
  ["", "As the table shows"],
  ["dmy", "Day first: 31/12/2026"],
  ["mdy", "Month first: 12/31/2026"],
];
const DECIMALS = [
  ["", "As the table shows"],
  ["point", "Point: 1.25"],
  ["comma", "Comma: 1,25"],
];
const UNITS = [
  ["", "As the header says, otherwise Hz"],
  ["Hz", "Hz"],
  ["mHz", "mHz"],
  ["kHz", "kHz"],
  ["rad/s", "rad/s"],
];
const TIME_UNITS = [
  ["", "Times are dates"],
  ["seconds", "Unix seconds"],
  ["milliseconds", "Unix milliseconds"],
  ["serial-days", "Serial days of a spreadsheet"],
  ["decimal-year", "Decimal years"],
];

/** What is needed, in words, and the field that answers it. */
const NEEDS = {
  zone: ["zone", "The times do not say their time zone: choose it."],
  date_order: ["date_order", "Dates such as 03/04/2026 have two readings: say whether the day or the month comes first."],
  time_unit: ["time_unit", "The times are numbers: choose their unit."],
  decimal: ["decimal", "Some numbers have a comma and others a point: choose the decimal sign."],
  columns: [null, "A column is not recognised or missing: say below what each column is."],
  split: ["split", "The measurements span more than 48 hours: choose how they become batches."],
};

/** The section of the page; `changed` is called after batches have been stored. */
export function upload(structure, changed) {
  const input = h("input", {
    id: "upload-file",
    type: "file",
    accept: ".csv,.tsv,.txt,text/csv",
    onchange: () => {
      const [file] = input.files;
      input.value = "";
      if (file) check(structure, file, changed);
    },
  });
  const drop = h(
    "div",
    { class: "drop" },
    h("label", { for: "upload-file" }, icon("table"), "Choose a table (CSV), or drag it here"),
    input,
  );
  const over = (inside) => (event) => {
    event.preventDefault();
    drop.classList.toggle("over", inside);
  };
  drop.addEventListener("dragover", over(true));
  drop.addEventListener("dragleave", over(false));
  drop.addEventListener("drop", (event) => {
    over(false)(event);
    const [file] = event.dataTransfer.files;
    if (file) check(structure, file, changed);
  });
  const element = h(
    "section",
    { id: "upload", class: "panel", "aria-labelledby": "upload-title" },
    h("h2", { id: "upload-title", tabindex: -1 }, "Upload measurements"),
    h(
      "p",
      { class: "fine" },
      "A table with a column of times, one column for each mode, and the covariates of the structure. Nothing is stored before you have seen how it is read.",
    ),
    drop,
  );
  return { element };
}

/** The text of a file, and a note if it is not UTF-8. */
async function decoded(file) {
  const bytes = new Uint8Array(await file.arrayBuffer());
  const [first, second] = bytes;
  if (first === 0xff && second === 0xfe) {
    return { text: new TextDecoder("utf-16le").decode(bytes), note: "The file is UTF-16." };
  }
  // A workbook is sent as it is: the service says what to do.
  if (first === 0x50 && second === 0x4b) return { text: bytes, note: null };
  try {
    return { text: new TextDecoder("utf-8", { fatal: true }).decode(bytes), note: null };
  } catch {
    const note =
      "The file is not UTF-8: its letters are read as Windows-1252, in which spreadsheets save Western European text. Check the names of the columns.";
    return { text: new TextDecoder("windows-1252").decode(bytes), note };
  }
}

function select(name, options, changed) {
  const choice = ([value, word]) => h("option", { value }, word);
  return h("select", { id: `upload-${name}`, name, onchange: changed }, options.map(choice));
}

function field(label, input, hint) {
  const note = hint && h("span", { class: "fine", id: `${input.id}-hint` }, hint);
  if (hint) input.setAttribute("aria-describedby", `${input.id}-hint`);
  return h("p", { class: "field" }, h("label", { for: input.id }, label), input, note);
}

/** The dialog in which a table is checked and uploaded. */
async function check(structure, file, changed) {
  let body;
  try {
    body = await decoded(file);
  } catch {
    notify(`${file.name} cannot be read: choose it again.`, "error");
    return;
  }
  /** What the user said about columns, by their number. */
  const said = new Map();
  const fields = {
    split: select("split", SPLITS, preview),
    zone: h("input", { id: "upload-zone", name: "zone", list: "upload-zones", autocomplete: "off", onchange: preview }),
    date_order: select("date_order", ORDERS, preview),
    decimal: select("decimal", DECIMALS, preview),
    unit: select("unit", UNITS, preview),
    time_unit: select("time_unit", TIME_UNITS, preview),
    source: h("input", { id: "upload-source", name: "source", maxlength: 64, autocomplete: "off", onchange: preview }),
  };
  const here = Intl.DateTimeFormat().resolvedOptions().timeZone;
  const zones = Intl.supportedValuesOf?.("timeZone") ?? [];
  const useHere = h(
    "button",
    {
      type: "button",
      class: "quiet",
      onclick: () => {
        fields.zone.value = here;
        preview();
      },
    },
    `Use ${here}, the zone of this computer`,
  );
  const status = h("div", { role: "status", class: "upload-status" });
  const columns = h("tbody", null);
  const batches = h("div", null);
  const send = h("button", { type: "submit", class: "primary", disabled: true }, "Upload");
  const close = h("button", { type: "button", onclick: () => dialog.close() }, "Cancel");
  const form = h(
    "form",
    { method: "dialog" },
    h("h2", { id: "upload-dialog-title" }, `Upload ${file.name}`),
    body.note && h("p", { class: "fine" }, body.note),
    h(
      "div",
      { class: "upload-fields" },
      field("Batches", fields.split, "A batch shows one state of the structure."),
      h("div", null, field("Time zone", fields.zone, "Of times that do not state one, such as Europe/Berlin or UTC."), useHere),
      h("datalist", { id: "upload-zones" }, ["UTC", ...zones].map((value) => h("option", { value }))),
      field("Order of dates", fields.date_order),
      field("Decimal sign", fields.decimal),
      field("Unit of frequencies", fields.unit),
      field("Unit of times", fields.time_unit),
      field("Source", fields.source, "Instrument or campaign; empty for “default”."),
    ),
    status,
    h(
      "div",
      { class: "upload-columns", tabindex: 0, role: "region", "aria-label": "Columns of the table" },
      h(
        "table",
        { class: "cards" },
        h("thead", null, h("tr", null, ["Column", "Read as", "Why", "First cells"].map((word) => h("th", { scope: "col" }, word)))),
        columns,
      ),
    ),
    batches,
    h("p", { class: "buttons" }, close, send),
  );
  const dialog = h("dialog", { class: "upload-dialog", "aria-labelledby": "upload-dialog-title" }, form);

  /** The options as a query; `split` replaces an empty choice. */
  function query(split) {
    const query = new URLSearchParams();
    for (const [name, { value }] of Object.entries(fields)) if (value.trim() !== "") query.set(name, value.trim());
    if (split && !query.has("split")) query.set("split", split);
    const assigned = [...said].filter(([, target]) => target !== "ignore").map(([number, target]) => `${target}=#${number}`);
    const ignored = [...said].filter(([, target]) => target === "ignore").map(([number]) => `#${number}`);
    if (assigned.length > 0) query.set("columns", assigned.join(","));
    if (ignored.length > 0) query.set("ignore", ignored.join(","));
    return query;
  }

  const post = async (path, query) =>
    (
      await request(at(structure, `${path}?${query}`), {
        method: "POST",
        headers: { "content-type": "text/csv" },
        body: body.text,
      })
    ).json();

  let asked = 0;
  async function preview() {
    asked += 1;
    const turn = asked;
    send.disabled = true;
    try {
      const answer = await post("/tables/preview", query());
      if (turn === asked) show(answer);
    } catch (error) {
      if (turn === asked) fill(status, problem(error, preview));
    }
  }

  function show({ understood, problems, needs, batches: planned, targets }) {
    showNeeds(needs);
    const { rows, accepted, refused } = understood;
    const sentence =
      problems.length > 0
        ? `${count(rows, "row")}. The table cannot be stored yet:`
        : `${count(rows, "row")}: ${accepted} taken${refused > 0 ? `, ${refused} refused` : ""}, in ${count(understood.batches, "batch", "batches")}.`;
    const signs = { ",": "commas", ";": "semicolons", "\t": "tabs" };
    const facts = [
      `separated by ${signs[understood.separator] ?? understood.separator}`,
      `decimal ${understood.decimal_sign === "," ? "comma" : "point"}`,
      understood.zone && `times in ${understood.zone}`,
      understood.date_order && `dates ${understood.date_order}`,
    ];
    fill(
      status,
      h("p", { class: problems.length > 0 ? "bad-text" : null }, h("strong", null, sentence)),
      h("p", { class: "fine" }, `Read as: ${facts.filter(Boolean).join(", ")}.`),
      needs.length > 0 && h("ul", null, needs.map((need) => h("li", null, NEEDS[need]?.[1] ?? need))),
      problems.length > 0 &&
        h(
          "details",
          { open: needs.length === 0 },
          h("summary", null, "What the service says"),
          h("ul", null, problems.map((p) => h("li", null, h("code", null, p.pointer), ` ${p.message}`))),
        ),
    );
    showColumns(understood.columns, targets);
    fill(batches, planned.length > 0 && batchList(understood, planned), refusedRows(understood));
    send.disabled = problems.length > 0;
    send.textContent = problems.length > 0 ? "Upload" : `Upload ${count(understood.batches, "batch", "batches")}`;
  }

  function showNeeds(needs) {
    for (const [name, input] of Object.entries(fields)) {
      const needed = needs.some((need) => NEEDS[need]?.[0] === name);
      if (needed) input.setAttribute("aria-invalid", "true");
      else input.removeAttribute("aria-invalid");
    }
  }

  /** The rows are made once, so that a field that was just changed keeps the focus. */
  function showColumns(found, targets) {
    if (columns.children.length !== found.length) fill(columns, found.map((column) => row(column, targets)));
    for (const [index, column] of found.entries()) {
      const line = columns.children[index];
      line.querySelector("select").value = column.target ?? (column.role === "ignored" ? "ignore" : "");
      line.querySelector("[data-why]").textContent = column.reason;
      line.classList.toggle("unknown", column.role === "unknown");
    }
  }

  function row({ number, name, examples }, targets) {
    const choices = [["", "Choose …"], ["ignore", "Not read"], ...targets.map((target) => [target, target])];
    const chosen = h(
      "select",
      {
        "aria-label": `Column ${number}, ${name || "without a name"}, is read as`,
        onchange: () => {
          if (chosen.value === "") said.delete(number);
          else said.set(number, chosen.value);
          preview();
        },
      },
      choices.map(([value, word]) => h("option", { value }, word)),
    );
    const why = h("span", { "data-why": "" });
    return h(
      "tr",
      null,
      cell("Column", h("strong", null, name || `(column ${number})`)),
      cell("Read as", chosen),
      cell("Why", why),
      cell("First cells", h("span", { class: "fine" }, examples.join(" · "))),
    );
  }

  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    send.disabled = true;
    close.disabled = true;
    const bar = h("progress", { "aria-label": "Batches stored" });
    const text = h("p", null, "Sending the table …");
    fill(status, text, bar);
    const watch = await watched(structure, bar, text, Number(send.textContent.match(/\d+/)?.[0] ?? 1));
    try {
      done(await post("/batches", query("none")));
    } catch (error) {
      fill(status, problem(error));
      send.disabled = false;
    } finally {
      watch.end();
      close.disabled = false;
      changed();
    }
  });

  function done({ stored, replayed, refused, items, table }) {
    const failures = items.filter((item) => item.problem);
    const sentence = [
      `${count(stored, "batch", "batches")} stored`,
      replayed > 0 && `${replayed} already there`,
      refused > 0 && `${refused} refused`,
    ];
    fill(
      status,
      h("p", { "data-upload": "done" }, icon("check"), h("strong", null, `${sentence.filter(Boolean).join(", ")}.`)),
      failures.length > 0 &&
        h("ul", null, failures.slice(0, 20).map((item) => h("li", null, `Line ${item.line}: ${item.problem.detail}`))),
    );
    fill(batches, refusedRows(table));
    close.textContent = "Close";
    send.hidden = true;
    close.focus();
  }

  const before = document.activeElement;
  dialog.addEventListener("close", () => {
    dialog.remove();
    if (before?.isConnected) before.focus();
  });
  document.body.append(dialog);
  dialog.showModal();
  await preview();
}

/** Shows how many batches of the structure have been stored since now. */
async function watched(structure, bar, text, planned) {
  const stored = async () => (await read("v1/overview", false)).items.find((item) => item.id === structure)?.batches ?? 0;
  const before = await stored().catch(() => null);
  const look = async () => {
    const now = await stored().catch(() => null);
    if (before === null || now === null) return;
    const done = Math.min(planned, Math.max(0, now - before));
    bar.max = planned;
    bar.value = done;
    text.textContent = `${done} of ${count(planned, "batch", "batches")} stored …`;
  };
  const timer = setInterval(look, LOOK_MS);
  return { end: () => clearInterval(timer) };
}

function batchList(understood, planned) {
  const line = ({ from, to, measurements }) => h("li", null, `${utc(from)} to ${utc(to)}: ${count(measurements, "measurement")}`);
  const more = understood.batches - planned.length;
  return h(
    "details",
    null,
    h("summary", null, `${count(understood.batches, "batch", "batches")} would be made`),
    h("ol", { class: "upload-list", tabindex: 0 }, planned.map(line)),
    more > 0 && h("p", { class: "fine" }, `and ${more} more`),
  );
}

function refusedRows(understood) {
  if (!understood || understood.refused === 0) return null;
  const line = (row) => h("li", null, `Line ${row.line}${row.column ? `, ${row.column}` : ""}: ${row.reason}`);
  const more = understood.refused - understood.refused_rows.length;
  return h(
    "details",
    { open: true },
    h("summary", null, `${count(understood.refused, "row")} refused`),
    h("ul", { class: "upload-list", tabindex: 0 }, understood.refused_rows.map(line)),
    more > 0 && h("p", { class: "fine" }, `and ${more} more`),
  );
}
