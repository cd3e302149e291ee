// Background jobs (diagnoses and model extensions) with live progress.

import { read } from "./api.js";
import { cell, fill, h, throttled } from "./dom.js";
import { age, timeElement, words } from "./format.js";
import { jobChip } from "./states.js";

const KINDS = { diagnosis: "Diagnosis", extension: "Model extension" };

/** Progress as text, with a bar if it can be expressed as a fraction (a number, or text such as "epoch 3 of 80"). */
export function progress(reported, label) {
  if (reported === null || reported === undefined || reported === "") return "";
  const share = typeof reported === "number" ? reported : shareOf(reported);
  const text = typeof reported === "number" ? `${Math.round(100 * reported)} %` : words(reported);
  const bar = share !== null && h("progress", { max: "1", value: share, "aria-label": `Progress of ${label}` });
  return h("span", { class: "progress" }, bar, h("span", null, text));
}

function shareOf(text) {
  const counted = text.match(/(\d+) of (\d+)/);
  return counted && Number(counted[2]) > 0 ? Number(counted[1]) / Number(counted[2]) : null;
}

const isOpen = (job) => job.state === "running" || job.state === "waiting";

function rows(items) {
  return items.map((job) => {
    const name = KINDS[job.kind] ?? words(job.kind);
    const page = job.kind === "diagnosis" && job.state === "done";
    return h(
      "tr",
      { dataset: { job: job.job } },
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
        isOpen(job) ? progress(job.progress, `${name} of ${job.structure}`) : timeElement(job.finished_at),
      ),
      h(
        "td",
        { "data-label": "Outcome", class: "wide" },
        job.verdict && h("strong", null, words(job.verdict), ". "),
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
      "A diagnosis finds where the simulation disagrees with the measurements. To start one, open a structure and choose “Diagnose”.",
    ),
  );
  const element = h("div", { class: "view", dataset: { page: "jobs" } }, h("h1", null, "Jobs"), none, table);
  const load = async () => {
    const { items } = await read("v1/jobs");
    fill(body, rows(items));
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
