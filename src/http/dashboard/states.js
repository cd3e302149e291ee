// States of structures, batches and jobs as chips with icon, word and colour.

import { h, icon } from "./dom.js";
import { count } from "./format.js";

/** States of a structure, the most urgent first. */
const STATES = {
  alarming: { word: "Alarm", icon: "alarm", kind: "bad", text: "a control chart is above its limit" },
  silent: { word: "Silent", icon: "silent", kind: "bad", text: "no measurement for longer than is usual or configured" },
  pending: { word: "Pending", icon: "pending", kind: "warn", text: "above the limit; the next batches decide" },
  recovering: {
    word: "Recovering",
    icon: "recovering",
    kind: "warn",
    text: "below the limit again; the alarm has not ended yet",
  },
  judging: { word: "Judging", icon: "pending", kind: "idle", text: "batches wait for their assessment" },
  not_judged: { word: "Not judged", icon: "unassessed", kind: "idle", text: "not compared with an undamaged reference" },
  no_model: { word: "No model", icon: "unassessed", kind: "idle", text: "no trained model for this structure" },
  unassessed: { word: "Not assessed", icon: "unassessed", kind: "idle", text: "no assessed batch yet" },
  normal: { word: "Normal", icon: "check", kind: "good", text: "all charts inside their limits" },
};

/** Rank of a state, 0 for the most urgent; unknown states come last. */
export function urgency(state) {
  const rank = Object.keys(STATES).indexOf(state);
  return rank < 0 ? Object.keys(STATES).length : rank;
}

export function stateWord(state) {
  return STATES[state]?.word ?? state;
}

/** The state of a structure as a chip. */
export function stateChip(state) {
  const known = STATES[state] ?? { word: state, icon: "unassessed", kind: "idle" };
  return h("span", { class: `chip ${known.kind}`, title: known.text }, icon(known.icon), known.word);
}

export const EVERY_STATE = Object.keys(STATES);

/** The trust verdict of a batch as a chip, with the number of its findings. */
export function trustChip(verdict, findings = 0) {
  if (verdict === "rejected") return h("span", { class: "chip bad" }, icon("cross"), "Rejected");
  if (findings > 0) return h("span", { class: "chip warn" }, icon("note"), `Accepted, ${count(findings, "finding")}`);
  return h("span", { class: "chip good" }, icon("check"), "Accepted");
}

const JOB_STATES = {
  running: ["pending", "warn", "Running"],
  waiting: ["pending", "idle", "Waiting"],
  done: ["check", "good", "Done"],
  failed: ["cross", "bad", "Failed"],
  cancelled: ["cross", "idle", "Cancelled"],
};

/** The state of a job as a chip. */
export function jobChip(state) {
  const [name, kind, word] = JOB_STATES[state] ?? ["unassessed", "idle", state];
  return h("span", { class: `chip ${kind}` }, icon(name), word);
}
