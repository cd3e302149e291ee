// Background jobs (diagnoses, trainings and model extensions) with live progress, their order and their end.

import { read, send } from "./api.js";
import { ask, cell, fill, h, notify, refill, throttled } from "./dom.js";
import { age, timeElement, words } from "./format.js";
import { jobChip } from "./states.js";

const KINDS = { diagnosis: "Diagnosis", extension: "Model extension", training: "Training" };

/** An estimated time in words, such as "about 3 min left"; empty where there is no estimate. */
export function timeLeft(seconds) {
  if (seconds === null || seconds === undefined) return "";
  if (seconds < 60) return "less than a minute left";
  const minutes = Math.round(seconds / 60);
  if (minutes < 90) return `about ${minutes} min left`;
  return `about ${(seconds / 3600).toFixed(1)} h left`;
}

/** What a job is doing in words, with a bar where the share is known, the time left, and its place in the queue. */
export function progress(job, label) {
  const share = job.share ?? shareOf(job.progress ?? "");
  const place = job.place && (job.place === 1 ? "next in the queue" : `place ${job.place} in the queue`);
  const text = [words(job.progress ?? "waiting"), place, timeLeft(job.time_left_s)].filter(Boolean).join(", ");
  const bar = share !== null && !job.place && h("progress", { max: "1", value: share, "aria-label": `Progress of ${label}` });
  return h("span", { class: "progress" }, bar, h("span", null, text));
}

function shareOf(text) {
  const counted = text.match(/(\d+) of (\d+)/);
  return counted && Number(counted[2]) > 0 ? Number(counted[1]) / Number(counted[2]) : null;
}

export const isOpen = (job) => job.state === "running" || job.state === "waiting";

/** Buttons to end a job and, while others wait before it, to move it to the front. `changed` is called afterwards. */
export function controls(id, job, label, changed) {
  const end = async () => {
    const done = await ask({
      title: `End the ${label}?`,
      body: h("p", null, "What it has computed is lost; nothing else changes. A job that runs ends at its next step."),
      confirm: "End it",
      cancel: "Keep it",
      danger: true,
      submit: () => send(`v1/jobs/${encodeURIComponent(id)}`, undefined, "DELETE"),
    });
    if (done) {
      notify(`The end of the ${label} was requested.`);
      changed();
    }
  };
  const first = async () => {
    try {
      await send(`v1/jobs/${encodeURIComponent(id)}/first`);
    } catch (error) {
      notify(error.message, "error");
    }
    changed();
  };
  return h(
    "span",
    { class: "row" },
    job.place > 1 && h("button", { type: "button", "aria-label": `Run the ${label} next`, onclick: first }, "Run next"),
    h("button", { type: "button", "aria-label": `Cancel the ${label}`, onclick: end }, "Cancel"),
  );
}

function rows(items, changed) {
  return items.map((job) => {
    const name = KINDS[job.kind] ?? words(job.kind);
    const label = `${name.toLowerCase()} of ${job.structure}`;
    const page = job.kind === "diagnosis" && job.state === "done";
    return h(
      "tr",
      { dataset: { job: job.job, key: `${job.kind} ${job.job}` } },
      cell("State", jobChip(job.state)),
      cell("Job", page ? h("a", { href: `#/diagnoses/${encodeURIComponent(job.job)}` }, `${name}: report`) : name),
      cell("Structure", h("a", { href: `#/structures/${encodeURIComponent(job.structure)}` }, job.structure)),
      cell(
        "Started",
        age(job.created_at),
        job.trigger && job.trigger !== "requested" && h("span", { class: "fine" }, "by the service"),
      ),
      cell(
        isOpen(job) ? "Progress" : "Ended",
        isOpen(job) ? progress(job, label) : timeElement(job.finished_at),
        isOpen(job) && controls(job.job, job, label, changed),
      ),
      h(
        "td",
        { "data-label": "Outcome", class: "wide" },
        job.verdict && job.kind === "diagnosis" && h("strong", null, words(job.verdict), ". "),
        job.summary ?? job.failure ?? (isOpen(job) ? "" : "–"),
      ),
    );
  });
}

export function jobs() {
  const body = h("tbody", null);
  const table = h(
    "table",
    { class: "cards" },
    h("caption", { class: "hidden-text" }, "Jobs, newest first"),
    h(
      "thead",
      null,
      h(
        "tr",
        null,
        ["State", "Job", "Structure", "Started", "Progress or end", "Outcome"].map((c) => h("th", { scope: "col" }, c)),
      ),
    ),
    body,
  );
  const none = h(
    "div",
    { class: "blank" },
    h("h2", null, "No jobs yet"),
    h(
      "p",
      null,
      "A training makes the model of a structure; a diagnosis finds where the simulation disagrees with the measurements. To start one, open a structure: “Train a model” stands under “Model”, “Diagnose” under “Diagnosis”.",
    ),
  );
  const lanes = h(
    "p",
    { class: "fine" },
    "One diagnosis and, beside it, one training or extension run at a time, or as many as there are workers; the others wait in the order in which they were started.",
  );
  const element = h("div", { class: "view", dataset: { page: "jobs" } }, h("h1", null, "Jobs"), lanes, none, table);
  const load = async () => {
    const { items } = await read("v1/jobs");
    refill(body, rows(items, () => again()));
    none.hidden = items.length > 0;
    table.hidden = items.length === 0;
  };
  const again = throttled(() => load().catch(() => {}), 1000);
  return {
    title: "Jobs",
    element,
    load,
    event: (name) => name === "job" && again(),
    missed: again,
  };
}

/** Updates the number of unfinished jobs in the header. */
export const showRunning = throttled(async () => {
  const mark = document.getElementById("jobs-running");
  const { items } = await read("v1/jobs", false).catch(() => ({ items: [] }));
  const open = items.filter(isOpen).length;
  mark.hidden = open === 0;
  fill(mark, open > 0 ? h("span", null, String(open), h("span", { class: "hidden-text" }, " running")) : "");
}, 2000);
