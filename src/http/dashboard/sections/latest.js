// The latest diagnosis as a card: verdict, causes with probabilities, gain, when and why it ran, and what can be done.

import { h, icon, refill } from "../dom.js";
import { age, number, percent, timeElement, words } from "../format.js";
import { help } from "../help.js";
import { progress } from "../jobs.js";
import { jobChip } from "../states.js";

/** A posterior probability that rounds to 1 is not a certainty. */
const ALMOST_SURE = 1 - 1e-9;

/** Verdicts that name causes by which the model can be extended. */
const NAMES = ["cause", "several", "ambiguous"];

/** Whether the model is extended by a constant discrepancy of each mode: the simulation is, most probably, off in no single place. */
export const isConstant = ({ verdict, result }) =>
  verdict === "distributed" || (verdict === "ambiguous" && result?.causes[0].target.kind === "everywhere");

/** Verdicts in words: kind of the callout, icon, and what the verdict means for a person who has to decide what to do. */
const VERDICTS = {
  cause: ["good", "check", "The cause is found: the simulation lacks one effect."],
  several: ["good", "check", "The causes are found: the simulation lacks several effects."],
  ambiguous: ["", "note", "The simulation lacks one effect, and these data cannot tell which of the following it is."],
  distributed: [
    "",
    "note",
    "The simulation is off by a little everywhere, and no single place explains it: look at what concerns the whole structure.",
  ],
  unexplained_scatter: [
    "bad",
    "note",
    "Some modes scatter more than stated, and nothing that was recorded explains it: check sensors and stated noise.",
  ],
  none_of_these: ["bad", "alarm", "The measurements deviate from the simulation, and no known cause explains it."],
  nothing_found: ["", "check", "No cause was found: the simulation explains the measurements that were searched."],
};

/** Why a diagnosis was started, in words. */
export function triggerWords({ trigger, alarm }) {
  if (trigger === "rejected_episode") return `by the service, because of alarm ${alarm}`;
  if (trigger === "schedule") return "by the service, on schedule";
  return "on request";
}

/** Whether the model can be extended by a diagnosis that is done; `present` is the digest of the present version. */
export function isExtendable(item, present) {
  const free = item.extension === null || ["failed", "cancelled"].includes(item.extension);
  return item.state === "done" && (NAMES.includes(item.verdict) || isConstant(item)) && free && (!present || present === item.version);
}

/** Error of each mode and batches beyond an alarm limit before and after the causes are modelled; `null` if no gain was measured. */
export function gainWords(gain) {
  if (!gain) return null;
  const { before, after } = gain.rms_error_percent;
  const modes = before
    .map((value, mode) => [mode + 1, value, after[mode]])
    .filter(([, from, to]) => Number.isFinite(from) && Number.isFinite(to))
    .map(([mode, from, to]) => `mode ${mode} ${number(from, 2)} → ${number(to, 2)} %`);
  const better = gain.rms_difference_interval90.filter(([, high]) => high < 0).length;
  const worse = gain.rms_difference_interval90.filter(([low]) => low > 0).length;
  const alarms = gain.false_alarms_per_1000;
  const rows =
    gain.method === "cross_validation"
      ? `in cross-validation over ${gain.holdout_rows} measurements`
      : `on ${gain.holdout_rows} held-out measurements`;
  return [
    `error of the predicted frequencies ${rows}: ${modes.join(", ")}; ${better} clearly better, ${worse} clearly worse`,
    alarms &&
      `of 1000 batches of these rows beyond an alarm limit ${number(alarms.before, 2)} → ${number(alarms.after, 2)}${
        gain.undamaged_rows === gain.holdout_rows
          ? ", all in the undamaged reference"
          : " (whether the structure was undamaged there is not known)"
      }`,
  ]
    .filter(Boolean)
    .join("; ");
}

/** The card; `extend(item)` opens the dialog that extends the model. */
export function latest(extend) {
  const element = h("section", {
    id: "latest-diagnosis",
    class: "panel",
    "aria-labelledby": "latest-diagnosis-title",
    dataset: { key: "latest" },
  });
  element.hidden = true;
  const fact = (name, ...value) => h("div", null, h("dt", null, name), h("dd", null, value));

  const causes = (found) =>
    h(
      "ul",
      { class: "findings" },
      found.map((cause) =>
        h(
          "li",
          null,
          h("span", { class: "chip idle" }, percent(Math.min(cause.probability, ALMOST_SURE))),
          h(
            "span",
            { class: "grow" },
            cause.sentence,
            cause.class === "possible_damage" &&
              h(
                "span",
                { class: "fine bad-text" },
                "This may be damage: inspect the structure. No extension compensates it.",
              ),
            cause.class === "rise" &&
              h(
                "span",
                { class: "fine bad-text" },
                "It has risen, and is no loss: find out what has changed. No extension compensates it.",
              ),
          ),
        ),
      ),
    );

  const body = (item) => {
    if (item.state === "running")
      return h("p", { class: "callout" }, progress(item, "the diagnosis"));
    if (item.state === "cancelled") return h("p", { class: "callout" }, icon("note"), "It was cancelled.");
    if (item.state === "failed")
      return h("p", { class: "callout bad" }, icon("cross"), `It could not be made: ${item.failure ?? "unknown reason"}`);
    const [kind, sign, text] = VERDICTS[item.verdict] ?? ["", "note", `${words(item.verdict)}.`];
    const found = NAMES.includes(item.verdict) ? (item.result?.causes ?? []) : [];
    const change = item.result?.lasting_change;
    return [
      change && h("p", { class: "callout bad", dataset: { finding: "lasting-change" } }, icon("alarm"), change.sentence),
      h("p", { class: `callout ${kind}` }, icon(sign), h("strong", null, text)),
      found.length > 0 ? causes(found) : item.summary && h("p", null, item.summary),
    ];
  };

  const next = (item, present) => {
    if (item.state !== "done") return null;
    if (item.extension === "running") return "The model is being extended by this diagnosis.";
    if (item.extension === "done") return "The model has been extended by this diagnosis.";
    if (present && present !== item.version) return "The structure has changed since: this diagnosis is of an earlier version.";
    if (isExtendable(item, present))
      return "Nothing changes until somebody extends the model. Then it accounts for what was found, and all batches are assessed again.";
    if (item.verdict === "nothing_found")
      return "While batches are still rejected, a later diagnosis with more of them may find the cause.";
    return null;
  };

  return {
    element,
    /** Shows the newest diagnosis, `undefined` if there is none; `present` is the digest of the present version. */
    update(item, present) {
      element.hidden = !item;
      if (!item) return;
      const gain = gainWords(item.result?.gain);
      const advice = next(item, present);
      refill(
        element,
        h(
          "div",
          { class: "row" },
          h("h2", { id: "latest-diagnosis-title" }, "Latest diagnosis"),
          jobChip(item.extension === "running" ? "running" : item.state),
        ),
        body(item),
        h(
          "dl",
          { class: "facts" },
          fact("Started", age(item.created_at), `, ${triggerWords(item)}`),
          item.finished_at && fact("Finished", timeElement(item.finished_at)),
          gain && fact(["Gain ", help("gain")], gain),
        ),
        advice && h("p", { class: "fine" }, advice),
        item.state === "done" &&
          h(
            "p",
            { class: "buttons start" },
            isExtendable(item, present) &&
              h("button", { type: "button", class: "primary", onclick: () => extend(item) }, "Extend the model"),
            h("a", { class: "button", href: `#/diagnoses/${encodeURIComponent(item.diagnosis)}` }, "Report"),
          ),
      );
    },
  };
}
