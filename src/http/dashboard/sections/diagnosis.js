// Diagnoses of the simulation, their reports, and the extension of the model by the causes found.

import { at, read, send } from "../api.js";
import { ask, fill, h, icon, notify, problem, refill } from "../dom.js";
import { age, words } from "../format.js";
import { help } from "../help.js";
import { controls, progress } from "../jobs.js";
import { jobChip } from "../states.js";
import { gainWords, isConstant, isExtendable, latest, triggerWords } from "./latest.js";

/** The day after a day such as `2025-08-07`, so that a period contains its last day. */
function dayAfter(day) {
  const next = new Date(`${day}T00:00:00Z`);
  next.setUTCDate(next.getUTCDate() + 1);
  return next.toISOString().slice(0, 10);
}

/** The request of the dialog: fields that are empty are left out. */
function requestOf({ from, to, share, since }) {
  const request = {};
  if (from) request.from = from;
  if (to) request.to = dayAfter(to);
  const percent = Number(share.trim().replace(",", "."));
  if (since) request.holdout = `since:${since}`;
  else if (!(percent >= 0 && percent < 100))
    throw new Error(`“${share}” is not a share to hold out: give per cent from 0 to below 100, such as 25.`);
  else request.holdout = `last:${percent / 100}`;
  return request;
}

/** The request of an extension: empty fields are left out. */
function extensionOf(values) {
  const request = { from_scratch: "from_scratch" in values, accept_uncalibrated: "accept_uncalibrated" in values };
  for (const name of ["samples", "epochs"]) {
    const text = values[name].trim();
    if (text === "") continue;
    if (!/^[0-9]+$/.test(text)) throw new Error(`“${text}” is not a whole number of ${name}.`);
    request[name] = Number(text);
  }
  return request;
}

export function diagnosis(structure, changed) {
  const content = h("div", null);
  const begin = h("button", { type: "button", onclick: () => diagnose() }, "Diagnose");
  const whyNot = h("span", { class: "fine" });
  const back = h("button", { type: "button", class: "danger", onclick: () => stepBack() }, "Undo last extension");
  const element = h(
    "section",
    { id: "diagnosis", class: "panel", "aria-labelledby": "diagnosis-title" },
    h("div", { class: "figure-title" }, h("h2", { id: "diagnosis-title" }, "Diagnosis of the model"), help("diagnosis")),
    h(
      "p",
      { class: "fine" },
      "A diagnosis shows where the simulation deviates from the measurements, identifies the cause, and quantifies the gain from modelling it.",
    ),
    content,
    h("p", { class: "buttons start" }, begin, whyNot, back),
  );

  const load = async () => {
    try {
      const [{ items, not_possible: reason }, { digest }] = await Promise.all([read(at(structure, "/diagnoses")), read(at(structure))]);
      // The list lacks progress and gain; they are read for the newest diagnosis and for those that are running.
      const full = await Promise.all(
        items
          .slice(0, 10)
          .map(async (item) => (isBusy(item) || item === items[0] ? { ...item, ...(await details(item)) } : item)),
      );
      card.update(full[0], digest);
      begin.disabled = reason !== null;
      whyNot.textContent = reason === null ? "" : `Not possible yet: ${reason}.`;
      back.hidden = !items.some((item) => item.extension === "done" || item.extension?.state === "done");
      refill(
        content,
        full.length === 0
          ? h("p", { class: "soft" }, "No diagnosis yet.")
          : h("ul", { class: "alarms" }, full.map(line)),
      );
    } catch (error) {
      fill(content, problem(error, load));
    }
  };
  const details = async (item) => {
    const answer = await read(`v1/diagnoses/${encodeURIComponent(item.diagnosis)}`);
    return {
      progress: answer.progress,
      share: answer.share,
      time_left_s: answer.time_left_s,
      place: answer.place,
      failure: answer.failure ?? answer.extension?.failure,
      version: answer.structure_digest,
      finished_at: answer.finished_at,
      result: answer.result,
      gain: answer.result?.gain ?? null,
      extension: answer.extension?.state ?? null,
      added: answer.extension?.result?.added,
    };
  };
  const isBusy = (item) => item.state === "running" || item.extension === "running";

  const line = (item) => {
    const done = item.state === "done";
    return h(
      "li",
      { dataset: { key: item.diagnosis } },
      jobChip(item.extension === "running" ? "running" : item.state),
      h(
        "span",
        { class: "grow" },
        item.verdict && h("strong", null, words(item.verdict), ". "),
        item.summary,
        item.gain && h("span", { class: "fine" }, icon("chart"), `Gain: ${gainWords(item.gain)}.`),
        isBusy(item) && progress(item, "diagnosis"),
        item.extension === "done" &&
          h(
            "span",
            { class: "fine" },
            `The model has been extended${item.added?.length ? `: ${item.added.join("; ")}` : ""}.`,
          ),
        item.failure && h("span", { class: "fine bad-text" }, item.failure),
        h("span", { class: "fine" }, "started ", age(item.created_at), `, ${triggerWords(item)}`),
      ),
      isBusy(item) &&
        controls(item.diagnosis, item, item.extension === "running" ? "extension" : "diagnosis", () => load()),
      done && h("a", { class: "button", href: `#/diagnoses/${encodeURIComponent(item.diagnosis)}` }, "Report"),
      isExtendable(item) && h("button", { type: "button", class: "primary", onclick: () => extend(item) }, "Extend the model"),
    );
  };

  const diagnose = async () => {
    const done = await ask({
      title: "Diagnose the model",
      body: [
        h(
          "p",
          null,
          "The measurements of the period are searched for systematic deviations of the simulation. A part of them is held out: on it the gain is measured. The diagnosis runs in the background for seconds to minutes and changes nothing.",
        ),
        h(
          "p",
          null,
          "All measurements are tested for a lasting change, which may be damage. Those since such a change are used neither to find causes nor to measure the gain.",
        ),
      ],
      fields: [
        { name: "from", label: "Period: first day (UTC)", type: "date", hint: "Empty: from the first measurement." },
        { name: "to", label: "Period: last day (UTC)", type: "date", hint: "Empty: to the last measurement." },
        {
          name: "share",
          label: "Held out: the last part of the period, in per cent",
          value: "25",
          help: help("hold-out"),
          hint: "0 searches all measurements; the gain is then measured by cross-validation.",
        },
        {
          name: "since",
          label: "Or held out: everything since this day (UTC)",
          type: "date",
          hint: "If a day is given, it counts instead of the share.",
        },
      ],
      confirm: "Diagnose",
      submit: (values) => send(at(structure, "/diagnoses"), requestOf(values)),
    });
    if (done) await load();
  };
  const extend = async (item) => {
    const done = await ask({
      title: "Extend the model?",
      body: [
        h("p", null, h("strong", null, item.summary)),
        h(
          "ul",
          null,
          [
            isConstant(item)
              ? "A new version of the structure is created with a constant discrepancy of each mode."
              : "A new version of the structure is created with the causes found as effects.",
            "A new model is trained and calibrated in the background, which takes minutes.",
            "If it passes its calibration, it replaces the present model at once; otherwise nothing changes.",
            "The undamaged reference is renewed from the same batches and all batches are assessed again: charts and alarms change.",
            "“Undo last extension” restores the previous version.",
          ].map((text) => h("li", null, text)),
        ),
      ],
      fields: [
        {
          name: "samples",
          label: "Simulated measurements (optional)",
          hint: "Empty: as many as follow from the training of the present model. With this or the epochs given, there is one round.",
        },
        { name: "epochs", label: "Epochs (optional)", hint: "Empty: a number that follows from the training of the present model." },
        {
          name: "from_scratch",
          type: "checkbox",
          label: "Start from random weights",
          hint: "Takes longer. Otherwise the training starts from the weights of the present model where they can be used.",
        },
        {
          name: "accept_uncalibrated",
          type: "checkbox",
          label: "Use the new model even if it is overconfident",
          hint: "Every assessment then has a finding about it.",
        },
      ],
      confirm: "Extend the model",
      submit: (values) => send(`v1/diagnoses/${encodeURIComponent(item.diagnosis)}/extension`, { ...extensionOf(values), learned: isConstant(item) }),
    });
    if (done) {
      notify("The extension is running. Its progress is shown here and under “Jobs”.");
      await load();
    }
  };
  const stepBack = async () => {
    const done = await ask({
      title: "Undo the last extension?",
      body: h(
        "p",
        null,
        "The version of the structure before the last extension is restored with its trained model, and all batches are assessed again. The extension stays stored with its diagnosis.",
      ),
      confirm: "Undo extension",
      danger: true,
      submit: () => send(at(structure, "/extension"), undefined, "DELETE"),
    });
    if (done) {
      notify("The previous version has been restored; all batches are being assessed again.");
      await load();
      changed();
    }
  };
  const card = latest(extend);
  return { element, card: card.element, load };
}
