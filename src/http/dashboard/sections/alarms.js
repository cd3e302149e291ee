// Open and past alarms of a structure, with their acknowledgements.

import { at, read, send } from "../api.js";
import { ask, fill, h, icon, notify, problem, refill } from "../dom.js";
import { count, number, timeElement, words } from "../format.js";

const STATE = {
  open: ["alarm", "bad", "Open"],
  ended: ["check", "good", "Ended"],
  withdrawn: ["cross", "idle", "Withdrawn"],
  superseded: ["note", "idle", "Superseded"],
};

/** Number of past alarms shown without unfolding the list of older ones. */
const PAST_SHOWN = 2;

/** A description of an alarm. */
export function alarmWords(alarm) {
  if (alarm.kind === "damage" && alarm.sentence) return alarm.sentence;
  if (alarm.kind === "damage" && !alarm.parameter) return "the parameters together have shifted towards damage";
  if (alarm.kind === "damage")
    return `${alarm.parameter} has shifted towards damage${Number.isFinite(alarm.peak_shift_standard_errors) ? ` by up to ${number(alarm.peak_shift_standard_errors, 3)} standard errors` : ""}`;
  if (alarm.kind === "simulation_does_not_fit") return "the simulation does not fit the measurements";
  if (alarm.kind === "silence") return "no measurement within the configured time";
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

export function alarms(structure) {
  const content = h("div", null);
  const element = h(
    "section",
    { id: "alarms", class: "panel", "aria-labelledby": "alarms-title" },
    h("h2", { id: "alarms-title" }, "Alarms"),
    content,
  );
  const load = async () => {
    try {
      const [{ items }, all] = await Promise.all([
        read(at(structure, "/alarms?limit=50")),
        read(at(structure, "/alarms?limit=50&superseded=true")),
      ]);
      const superseded = all.items.filter((alarm) => alarm.state === "superseded");
      // Open alarms and the latest past ones are shown; older ones are folded.
      const past = items.filter((alarm) => alarm.state !== "open");
      const older = past.slice(PAST_SHOWN);
      const shown = items.filter((alarm) => !older.includes(alarm));
      refill(
        content,
        items.length === 0 ? h("p", { class: "soft" }, "No alarms so far.") : [
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
    } catch (error) {
      fill(content, problem(error, load));
    }
  };
  const line = (alarm) => {
    const [sign, kind, word] = STATE[alarm.state] ?? ["note", "idle", alarm.state];
    const open = alarm.state === "open";
    const superseded = alarm.state === "superseded";
    return h(
      "li",
      { class: open && !alarm.acknowledgement ? "unseen" : "seen", dataset: { key: alarm.alarm } },
      h("span", { class: `chip ${kind}` }, icon(sign), word),
      h(
        "span",
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
        diagnosisLine(alarm.diagnosis),
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
  return { element, load };
}
