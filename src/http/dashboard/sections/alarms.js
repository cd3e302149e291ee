// Open and past alarms of a structure, with their severity and what people did with them.

import { at, read, send } from "../api.js";
import { ask, fill, h, icon, notify, problem, refill } from "../dom.js";
import { count, inWords, number, timeElement, words } from "../format.js";
import { help } from "../help.js";
import { authorBody, authorField, plain } from "./notes.js";

const STATE = {
  open: ["alarm", "bad", "Open"],
  ended: ["check", "good", "Ended"],
  withdrawn: ["cross", "idle", "Withdrawn"],
  superseded: ["note", "idle", "Superseded"],
};

/** Class of the chip of a severity, and its word. */
const SEVERITY = {
  slight: ["idle", "Slight"],
  moderate: ["warn", "Moderate"],
  severe: ["bad", "Severe"],
  critical: ["bad", "Critical"],
};

const REASONS = [
  ["damage_confirmed", "Damage confirmed"],
  ["repaired", "Repaired"],
  ["sensor_fault", "Sensor fault"],
  ["environmental_cause", "Environmental cause"],
  ["false_alarm", "False alarm"],
  ["other", "Other (needs a text)"],
];

/** Filters of the list: by whether a person has closed the alarm. An alarm that the measurements keep open is never hidden as closed. */
const FILTERS = [
  ["all", "All", () => true],
  ["open", "Open", (alarm) => alarm.state === "open" || (!alarm.closing && alarm.state !== "withdrawn")],
  ["closed", "Closed", (alarm) => Boolean(alarm.closing)],
];

/** Number of past alarms shown without unfolding the list of older ones. */
const PAST_SHOWN = 2;

/** A description of an alarm. */
export function alarmWords(alarm) {
  if (alarm.kind === "damage" && alarm.sentence) return alarm.sentence;
  if (alarm.kind === "damage" && !alarm.parameter) return "the parameters together have shifted towards damage";
  if (alarm.kind === "damage")
    return `${inWords(alarm.parameter)} has shifted towards damage${Number.isFinite(alarm.peak_shift_standard_errors) ? ` by up to ${number(alarm.peak_shift_standard_errors, 3)} standard errors` : ""}`;
  if (alarm.kind === "simulation_does_not_fit") return "the simulation does not fit the measurements";
  if (alarm.kind === "not_assessed") return "the newest batches could not be judged; the reason is stated with each of them";
  if (alarm.kind === "silence") return "no measurement for longer than is usual or configured";
  return words(alarm.kind).toLowerCase();
}

/** What a diagnosis that was started because of an alarm says, with a link to its report once it is done. */
function diagnosisLine(diagnosis) {
  if (!diagnosis) return null;
  const { state, verdict } = diagnosis;
  const done = state === "done";
  return h(
    "span",
    { class: "fine" },
    done
      ? h("a", { href: `#/diagnoses/${encodeURIComponent(diagnosis.diagnosis)}` }, "Diagnosis")
      : "Diagnosis",
    done ? `: ${words(verdict).toLowerCase()}` : `: ${state}`,
  );
}

/** Dialog to acknowledge an alarm; resolves to the acknowledged alarm. */
export function acknowledgeDialog(structure, alarm) {
  return ask({
    title: "Acknowledge the alarm",
    body: h(
      "p",
      null,
      `${structure}: ${alarmWords(alarm)}. The alarm stays open until the measurements end it. Your acknowledgement is visible to all users.`,
    ),
    fields: [
      {
        name: "by",
        label: "Your name",
        required: true,
        maxlength: 500,
        autocomplete: "name",
        value: localStorage.getItem("modalwatch.name") ?? "",
      },
      { name: "note", label: "Note (optional)", type: "textarea", maxlength: 500 },
    ],
    confirm: "Acknowledge",
    submit: async ({ by, note }) => {
      const body = { by: by.trim() };
      // The service accepts printable characters only, so line breaks are replaced by spaces.
      const line = note.trim().replace(/\s+/g, " ");
      if (line) body.note = line;
      const seen = await send(at(structure, `/alarms/${alarm.alarm}/acknowledgement`), body);
      localStorage.setItem("modalwatch.name", body.by);
      notify(`Alarm ${alarm.alarm} of ${structure} has been acknowledged.`);
      return seen;
    },
  });
}

/** A dialog for an action on an alarm; resolves to the alarm afterwards. */
function act(structure, alarm, { path, method = "POST", title, body, fields = [], confirm, of }) {
  const seen = alarm.actions.at(-1)?.action ?? 0;
  return ask({
    title,
    body: [h("p", null, `${structure}: ${alarmWords(alarm)}`), body],
    fields: [...fields, ...authorField()],
    confirm,
    submit: (values) =>
      send(
        at(structure, `/alarms/${alarm.alarm}/${path}`),
        { ...of(values, seen), ...authorBody(values.author) },
        method,
      ),
  });
}

const withText = (text) => (plain(text) ? { text: plain(text) } : {});

function commentDialog(structure, alarm) {
  return act(structure, alarm, {
    path: "comments",
    title: "Comment on the alarm",
    fields: [{ name: "text", label: "Comment", type: "textarea", required: true, maxlength: 2000 }],
    confirm: "Add the comment",
    of: ({ text }) => ({ text: plain(text) }),
  });
}

function assignDialog(structure, alarm) {
  return act(structure, alarm, {
    path: "assignee",
    method: "PUT",
    title: "Assign the alarm",
    fields: [
      {
        name: "assignee",
        label: "Who takes care of it",
        maxlength: 500,
        value: alarm.assignee ?? "",
        hint: "Leave empty for nobody.",
      },
    ],
    confirm: "Assign",
    of: ({ assignee }, seen) => ({ assignee: assignee.trim() || null, seen }),
  });
}

function closeDialog(structure, alarm) {
  const options = REASONS.map(([value, word]) => h("option", { value }, word));
  return act(structure, alarm, {
    path: "closing",
    title: "Close the alarm",
    body: [
      h("p", null, "The measurements still decide whether the charts show an alarm; closing records what people found."),
      h(
        "p",
        { class: "field" },
        h("label", { for: "field-reason" }, "Reason"),
        h("select", { id: "field-reason", name: "reason" }, options),
      ),
    ],
    fields: [{ name: "text", label: "Explanation", type: "textarea", maxlength: 2000 }],
    confirm: "Close the alarm",
    of: ({ reason, text }, seen) => ({ reason, ...withText(text), seen }),
  });
}

function reopenDialog(structure, alarm) {
  return act(structure, alarm, {
    path: "reopening",
    title: "Reopen the alarm",
    fields: [{ name: "text", label: "Explanation (optional)", type: "textarea", maxlength: 2000 }],
    confirm: "Reopen",
    of: ({ text }, seen) => ({ ...withText(text), seen }),
  });
}

/** What a person did, in words. */
function actionWords(action) {
  if (action.kind === "assignment") return action.assignee ? `assigned to ${action.assignee}` : "assigned to nobody";
  if (action.kind === "closing") return `closed: ${words(action.reason).toLowerCase()}`;
  if (action.kind === "reopening") return "reopened";
  return "comment";
}

function actionList(alarm) {
  if (alarm.actions.length === 0) return null;
  const item = (action) =>
    h(
      "li",
      null,
      h(
        "span",
        { class: "fine" },
        timeElement(action.at),
        `, ${action.author}: ${actionWords(action)}`,
        action.alarm !== alarm.alarm && ` (on alarm ${action.alarm})`,
      ),
      action.text && h("span", { class: "written" }, action.text),
    );
  return h(
    "details",
    null,
    h("summary", null, count(alarm.actions.length, "comment or action", "comments and actions")),
    h("ol", { class: "actions" }, alarm.actions.map(item)),
  );
}

function severityChip(severity) {
  const [kind, word] = SEVERITY[severity.grade] ?? ["idle", severity.grade];
  return h("span", { class: `chip ${kind}` }, word);
}

export function alarms(structure) {
  let filter = "all";
  let loaded = null;
  const picker = h("div", { class: "picker", role: "group", "aria-label": "Alarms that are shown" });
  const content = h("div", null);
  const element = h(
    "section",
    { id: "alarms", class: "panel", "aria-labelledby": "alarms-title" },
    h("div", { class: "figure-title" }, h("h2", { id: "alarms-title" }, "Alarms"), help("severity")),
    picker,
    content,
  );
  const load = async () => {
    try {
      const [{ items }, all] = await Promise.all([
        read(at(structure, "/alarms?limit=50")),
        read(at(structure, "/alarms?limit=50&superseded=true")),
      ]);
      loaded = { items, all };
      show();
    } catch (error) {
      fill(content, problem(error, load));
    }
  };
  const showFilters = (items) => {
    const press = (name) => () => {
      filter = name;
      show();
      [...picker.children].find((button) => button.dataset.filter === name)?.focus();
    };
    fill(
      picker,
      items.length > 0 &&
        FILTERS.map(([name, word, matches]) =>
          h(
            "button",
            { type: "button", "aria-pressed": String(name === filter), dataset: { filter: name }, onclick: press(name) },
            `${word} (${items.filter(matches).length})`,
          ),
        ),
    );
  };
  const show = () => {
    const { all } = loaded;
    showFilters(loaded.items);
    const items = loaded.items.filter(FILTERS.find(([name]) => name === filter)[2]);
    const superseded = all.items.filter((alarm) => alarm.state === "superseded");
    // Open alarms and the latest past ones are shown; older ones are folded.
    const past = items.filter((alarm) => alarm.state !== "open");
    const older = past.slice(PAST_SHOWN);
    const shown = items.filter((alarm) => !older.includes(alarm));
    refill(
      content,
      items.length === 0 ? h("p", { class: "soft" }, loaded.items.length === 0 ? "No alarms so far." : "No alarm of this kind.") : [
            h("ul", { class: "alarms" }, shown.map(line)),
            older.length > 0 &&
              h(
                "details",
                null,
                h("summary", null, `${count(older.length, "older alarm")}`),
                h("ul", { class: "alarms" }, older.map(line)),
              ),
          ],
      superseded.length > 0 &&
        h(
          "details",
          { dataset: { key: "superseded" } },
          h("summary", null, `${count(superseded.length, "alarm")} of earlier undamaged references or models`),
          h(
            "p",
            { class: "fine" },
            "The present charts judge the same time again. What they find is listed above; these are kept as a record.",
          ),
          h("ul", { class: "alarms" }, superseded.map(line)),
        ),
    );
  };
  const line = (alarm) => {
    const [sign, kind, word] = STATE[alarm.state] ?? ["note", "idle", alarm.state];
    const open = alarm.state === "open";
    const superseded = alarm.state === "superseded";
    return h(
      "li",
      { class: open && !alarm.acknowledgement ? "unseen" : "seen", dataset: { key: alarm.alarm } },
      h("span", { class: "chips" }, h("span", { class: `chip ${kind}` }, icon(sign), word), severityChip(alarm.severity)),
      h(
        "div",
        { class: "grow" },
        alarmWords(alarm),
        h(
          "span",
          { class: "fine" },
          "from ",
          timeElement(alarm.opened_at),
          !superseded && alarm.ended_at && [" to ", timeElement(alarm.ended_at)],
          superseded && ` (undamaged reference ${alarm.undamaged_version}, superseded by ${alarm.superseded_by})`,
        ),
        alarm.acknowledgement &&
          h(
            "span",
            { class: "fine" },
            `acknowledged by ${alarm.acknowledgement.by}, `,
            timeElement(alarm.acknowledgement.at),
            alarm.acknowledgement.note && `: ${alarm.acknowledgement.note}`,
          ),
        alarm.continues && h("span", { class: "fine" }, `first raised as alarm ${alarm.continues}, with an earlier reference or model`),
        h("span", { class: "fine" }, alarm.severity.sentence),
        alarm.assignee && h("span", { class: "fine" }, `assigned to ${alarm.assignee}`),
        alarm.closing &&
          h(
            "span",
            { class: "fine" },
            `closed by ${alarm.closing.author}, `,
            timeElement(alarm.closing.at),
            `: ${words(alarm.closing.reason).toLowerCase()}`,
            open && " (the measurements still show it)",
          ),
        diagnosisLine(alarm.diagnosis),
        actionList(alarm),
        !superseded && buttons(alarm),
      ),
      open &&
        !alarm.acknowledgement &&
        h(
          "button",
          {
            type: "button",
            class: "primary",
            onclick: () => acknowledgeDialog(structure, alarm).then((done) => done && load()),
          },
          "Acknowledge",
          h("span", { class: "hidden-text" }, ` alarm ${alarm.alarm}`),
        ),
    );
  };
  const buttons = (alarm) => {
    const button = (word, dialog) =>
      h(
        "button",
        { type: "button", onclick: () => dialog(structure, alarm).then((done) => done && load()) },
        word,
        h("span", { class: "hidden-text" }, ` alarm ${alarm.alarm}`),
      );
    return h(
      "p",
      { class: "row" },
      button("Comment", commentDialog),
      button("Assign", assignDialog),
      alarm.closing ? button("Reopen", reopenDialog) : button("Close", closeDialog),
    );
  };
  return { element, load };
}
