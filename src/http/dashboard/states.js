// States as icon, word and colour, in one order: what needs somebody comes first.

import { h, icon } from "./dom.js";

const STATES = {
  alarming: { word: "Alarm", icon: "alarm", kind: "bad", text: "the charts are beyond their limits" },
  silent: { word: "Silent", icon: "silent", kind: "bad", text: "no measurement has come for longer than agreed" },
  pending: { word: "Pending", icon: "pending", kind: "warn", text: "one batch beyond the limit, waiting for the next" },
  recovering: { word: "Recovering", icon: "recovering", kind: "warn", text: "back inside, the alarm is not over yet" },
  no_model: { word: "No model", icon: "unassessed", kind: "idle", text: "no trained baseline serves this structure" },
  unassessed: { word: "No judgement yet", icon: "unassessed", kind: "idle", text: "nothing to compare with yet" },
  normal: { word: "Normal", icon: "check", kind: "good", text: "inside all limits" },
};

/** Place in the order; unknown states are shown last. */
export function urgency(state) {
  const place = Object.keys(STATES).indexOf(state);
  return place < 0 ? Object.keys(STATES).length : place;
}

export function stateText(state) {
  return STATES[state]?.text ?? "";
}

export function stateWord(state) {
  return STATES[state]?.word ?? state;
}

/** A state as a chip. */
export function stateChip(state) {
  const known = STATES[state] ?? { word: state, icon: "unassessed", kind: "idle" };
  return h("span", { class: `chip ${known.kind}`, title: known.text }, icon(known.icon), known.word);
}

export const EVERY_STATE = Object.keys(STATES);

/** A verdict of trust as a chip. */
export function trustChip(verdict, findings = 0) {
  if (verdict === "rejected") return h("span", { class: "chip bad" }, icon("cross"), "Rejected");
  if (findings > 0) return h("span", { class: "chip warn" }, icon("note"), `Accepted, ${findings} to note`);
  return h("span", { class: "chip good" }, icon("check"), "Accepted");
}

const JOB_STATES = {
  running: ["pending", "warn", "Running"],
  waiting: ["pending", "idle", "Waiting"],
  done: ["check", "good", "Done"],
  failed: ["cross", "bad", "Failed"],
};

/** The state of a job as a chip. */
export function jobChip(state) {
  const [name, kind, word] = JOB_STATES[state] ?? ["unassessed", "idle", state];
  return h("span", { class: `chip ${kind}` }, icon(name), word);
}
