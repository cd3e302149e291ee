// The trained model with its calibration, and the undamaged reference that batches are compared with.

import { at, read, send } from "../api.js";
import { ask, cell, fieldTime, fill, h, icon, notify, throttled } from "../dom.js";
import { count, digest, inWords, local, number, percent, quantity, sentence, worth, zone } from "../format.js";
import { training } from "./training.js";
import { help } from "../help.js";

export function model(structure, changed) {
  const content = h("div", null);
  const trainings = training(structure, changed);
  const element = h(
    "section",
    { id: "model", class: "panel", "aria-labelledby": "model-title" },
    h("h2", { id: "model-title" }, "Trained model and undamaged reference"),
    content,
    trainings.element,
  );
  let shown = null;
  return {
    element,
    /** Shows the progress of a training. */
    job: throttledJob(trainings),
    train: () => trainings.train(),
    update(info, batches) {
      // Redraw only after a change, so that details opened by the user stay open when a batch arrives.
      const key = JSON.stringify([info, batches > 0]);
      if (key === shown) return;
      shown = key;
      trainings.update(info);
      fill(
        content,
        h(
          "div",
          { class: "columns" },
          h("div", null, h("div", { class: "figure-title" }, h("h3", null, "Trained model"), help("calibration")), info.model ? inUse(info) : missing(info)),
          h(
            "div",
            null,
            h("div", { class: "figure-title" }, h("h3", null, "Undamaged reference"), help("undamaged reference")),
            info.undamaged_unreadable
              ? h("p", { class: "callout" }, icon("note"), sentence(info.undamaged_unreadable), ".")
              : info.undamaged
                ? undamaged(info.undamaged, unitsOf(info), covariateUnitsOf(info))
                : firstStep(info, batches),
            info.model &&
              batches > 0 &&
              h(
                "p",
                null,
                h(
                  "button",
                  {
                    type: "button",
                    class: info.undamaged ? "" : "primary",
                    onclick: () => declare(structure, changed),
                  },
                  info.undamaged ? "Declare another undamaged reference" : "Declare the undamaged reference",
                ),
                info.undamaged && " ",
                info.undamaged &&
                  h("button", { type: "button", onclick: () => declare(structure, changed, { extend: true }) }, "Extend this reference"),
              ),
          ),
        ),
      );
    },
  };
}

/** Events of a job, at most one a second; the last one is never lost. */
function throttledJob(trainings) {
  let newest = null;
  const show = throttled(() => trainings.job(newest), 1000);
  return (data) => {
    newest = data;
    show();
  };
}

/** Help at the facts that a newcomer may not know. */
const FACT_HELP = {
  "Digest of the model": () => help("digest"),
  "Trained noise range": () => help("noise range"),
  Validation: () => help("validation"),
  Emulator: () => help("emulator"),
  "Damage threshold δ": () => help("damage threshold"),
  "Movement in time": () => help("common factor"),
  "Losses found with 90 % probability": () => help("detectable loss"),
};

const facts = (list) =>
  h(
    "dl",
    { class: "facts" },
    list.filter(Boolean).map(([name, value]) => h("div", null, h("dt", null, name, " ", FACT_HELP[name]?.()), h("dd", null, value))),
  );

function missing(info) {
  return [
    h("p", { class: "callout" }, icon("note"), sentence(info.model_missing ?? "there is no trained model for this structure"), "."),
    h("p", null, "Batches are stored and wait until there is one. “Train a model” below makes one."),
    h(
      "details",
      null,
      h("summary", null, "Or train on another computer"),
      h("p", { class: "fine" }, "Train for exactly this definition there, copy the folder to the models folder, and restart the service:"),
      h("pre", { tabindex: 0 }, h("code", null, `modalwatch train --structure structure.toml --out models/${info.id}`)),
    ),
  ];
}

function inUse({ digest: structureDigest, definition, model: m, emulator }) {
  const { calibration, validation } = m;
  const outcome = m.calibration_outcome;
  const reasons = [...calibration.failures, ...(calibration.cautions ?? [])];
  const listed = `${reasons.slice(0, 3).join("; ")}${reasons.length > 3 ? `; and ${reasons.length - 3} more` : ""}`;
  const noise = m.conditions.noise_range;
  return [
    facts([
      definition.description && ["Structure", definition.description],
      ["Digest of the model", digest(m.digest)],
      ["Digest of the structure", digest(structureDigest)],
      ["Trained with", `modalwatch ${m.program_version}, ${m.training_samples.toLocaleString()} simulations`],
      noise && [
        "Trained noise range",
        `${number(noise.lowest)} to ${number(noise.highest)} times the noise of the structure`,
      ],
      [
        "Validation",
        `score ${number(validation.negative_log_likelihood, 3)} ± ${number(validation.negative_log_likelihood_error, 2)} on simulations it was not trained on; lower is better`,
      ],
      emulator && [
        "Emulator",
        `${count(emulator.runs, "run")}, error ${emulator.error_percent.map((e) => number(e, 2)).join(", ")} % (one value per mode)`,
      ],
    ]),
    h(
      "p",
      { class: `callout ${{ passed: "good", cautious: "", not_measured: "" }[outcome] ?? "bad"}` },
      icon({ passed: "check", cautious: "note", not_measured: "note" }[outcome] ?? "alarm"),
      {
        not_measured:
          "Made in a second, so that batches are assessed at once. Its calibration was not measured: the simulation weighs each of its samples, and its intervals may be too narrow. A trained model replaces it once it has passed its calibration.",
        passed: `Calibration passed: ${count(calibration.cells.length, "case")}, ${calibration.simulations} simulated measurements each.`,
        cautious: `Calibration: the model can be used, and some of its intervals are wider than they need to be, so that a small change may be noticed later than possible. ${listed}.`,
      }[outcome] ??
        `Calibration: some intervals are too narrow, so that the model claims to know more than it does. It is used only because this was accepted. ${listed}.`,
    ),
    calibrationTable(calibration.cells),
  ];
}

/** Help at the columns of the calibration. */
const CALIBRATION_HELP = {
  "Coverage of 50 % intervals": () => [" ", help("coverage")],
  "Joint test (p-value)": () => [" ", help("joint test")],
};

/** One row per noise level and missing mode: how often the posterior intervals contain the true value. */
function calibrationTable(cells) {
  if (cells.length === 0) return null;
  const range = (values) => {
    const [low, high] = [Math.min(...values), Math.max(...values)].map(percent);
    return low === high ? low : `${low} to ${high}`;
  };
  const line = (condition) =>
    h(
      "tr",
      null,
      h(
        "th",
        { scope: "row" },
        `${number(condition.noise_multiple, 2)} times the noise of the structure, ${condition.missing_mode ? `mode ${condition.missing_mode} missing` : "all modes"}`,
      ),
      cell("Coverage of 50 % intervals", range(condition.parameters.map((p) => p.coverage_50))),
      cell("Coverage of 90 % intervals", range(condition.parameters.map((p) => p.coverage_90))),
      cell("Joint test (p-value)", number(condition.tarp_p_value, 2)),
    );
  return h(
    "details",
    null,
    h("summary", null, "Calibration by noise level and missing mode: how often the intervals contain the true value"),
    h(
      "table",
      { class: "cards" },
      h("caption", { class: "hidden-text" }, "Calibration by noise level and missing mode"),
      h(
        "thead",
        null,
        h(
          "tr",
          null,
          ["Noise and modes", "Coverage of 50 % intervals", "Coverage of 90 % intervals", "Joint test (p-value)"].map((c) =>
            h("th", { scope: "col" }, c, CALIBRATION_HELP[c]?.()),
          ),
        ),
      ),
      h("tbody", null, cells.map(line)),
    ),
  );
}

/** Gives the unit of a quantity of the reference by its name. */
function unitsOf({ definition }) {
  const springs = new Map((definition.spring ?? []).map((spring) => [spring.name, spring]));
  const ofSpring = (name) => (springs.get(name)?.n_m_per_rad === undefined ? "N/m" : "N·m/rad");
  return (quantity) => {
    if (quantity.startsWith("spring:")) return ofSpring(quantity.slice(7));
    const parameter = (definition.parameter ?? []).find((p) => p.name === quantity);
    if (!parameter) return "";
    if (parameter.scale) return "% of nominal";
    if (parameter.unit) return parameter.unit;
    const [set] = [parameter.sets ?? []].flat();
    if (!set || set.law) return "";
    return set.beam ? "N·m²" : ofSpring(set.spring);
  };
}

/** Gives the unit of a covariate by its name, with a space before it; empty if the structure states none. */
function covariateUnitsOf({ definition }) {
  const stated = new Map((definition.covariate ?? []).map((covariate) => [covariate.name, covariate.unit]));
  return (name) => (stated.get(name) ? ` ${stated.get(name)}` : "");
}

function undamaged(state, units, covariateUnits) {
  const seenWords = (name, seen) =>
    seen.range ? `${number(seen.range[0])} to ${number(seen.range[1])}${covariateUnits(name)}` : (seen.categories ?? []).join(", ");
  const conditions = Object.entries(state.conditions).map(([name, seen]) => `${name} ${seenWords(name, seen)}`);
  return [
    facts([
      ["Version", `${state.version}, declared ${local(state.created_at)}${state.extends ? `, extends version ${state.extends}` : ""}`],
      state.reason && ["Reason", state.reason],
      ["From", `${count(state.batches.length, "batch", "batches")}, ${count(state.measurement_count, "measurement")}${worth(state.effective_measurements, state.measurement_count)}`],
      ["Damage threshold δ", `below it are ${percent(state.threshold_probability)} of the healthy values`],
      conditions.length > 0 && ["Covariate ranges", conditions.join("; ")],
      state.process?.coverage && ["Months seen", state.process.coverage.months.map(monthName).join(", ")],
      ["Movement in time", seasonWords(state)],
      state.process?.detectable?.length > 0 && ["Losses found with 90 % probability", detectableWords(state.process.detectable)],
    ]),
    state.doubts.length > 0 &&
      h(
        "ul",
        { class: "findings" },
        state.doubts.map((doubt) =>
          h("li", null, h("span", { class: "chip warn" }, icon("note"), "Doubt"), h("span", { class: "grow" }, doubt)),
        ),
      ),
    h(
      "table",
      { class: "cards" },
      h("caption", { class: "hidden-text" }, "Parameters of the undamaged reference"),
      h(
        "thead",
        null,
        h(
          "tr",
          null,
          ["Parameter", "Mean", "Standard deviation", "Damage threshold δ"].map((c) => h("th", { scope: "col" }, c)),
        ),
      ),
      h(
        "tbody",
        null,
        state.parameters.map((p) =>
          h(
            "tr",
            null,
            h("th", { scope: "row" }, inWords(p.name)),
            cell("Mean", quantity(p.mean, units(p.name))),
            cell("Standard deviation", quantity(p.std, units(p.name), 3)),
            cell("Damage threshold δ", p.threshold === null ? "–" : quantity(p.threshold, units(p.name))),
          ),
        ),
      ),
    ),
  ];
}

const monthName = (month) =>
  new Intl.DateTimeFormat("en", { month: "long", timeZone: "UTC" }).format(new Date(Date.UTC(2026, month - 1, 15)));

/** The smallest lasting loss of each parameter that the charts find with the first batch, and in the long run. */
function detectableWords(list) {
  const names = [...new Set(list.map((d) => d.name))];
  return names
    .map((name) => {
      const own = list.filter((d) => d.name === name);
      const [first, last] = [own[0], own.at(-1)];
      return `${inWords(name)} −${number(first.loss_percent, 2)} % with the first batch, −${number(last.loss_percent, 2)} % within ${count(last.batches, "batch", "batches")}`;
    })
    .join("; ");
}

/** What the reference shows of the movement of the parameters in time. */
function seasonWords(state) {
  const process = state.process;
  if (!process) return `batches are taken as independent${state.without_process ? `: ${state.without_process}` : ""}`;
  const factors = process.factor_correlations.map((c) => number(c, 2)).join(", ");
  const common =
    process.factor_correlations.length > 0
      ? `${count(process.factor_correlations.length, "common factor")} without a measured cause (correlation of successive batches ${factors})`
      : "no common factor";
  const covariates = process.covariates.length > 0 ? `; influence of ${process.covariates.join(", ")}` : "";
  return `${common}${covariates}`;
}

function firstStep(info, batches) {
  if (!info.model) return h("p", { class: "soft" }, "Available as soon as there is a trained model.");
  if (batches === 0) return h("p", { class: "soft" }, "Available as soon as there are measurements.");
  return h(
    "p",
    { class: "callout" },
    icon("note"),
    "There is no undamaged reference yet: parameters are estimated, but there is no probability of damage and no damage alarm. Choose batches measured while the structure was known to be undamaged.",
  );
}

/** A shell command that posts one measurement of this structure. */
export function postLine(info) {
  const measurement = {
    measured_at: new Date().toISOString().slice(0, 19) + "Z",
    frequencies_hz: info.nominal_frequencies_hz.map((f) => Number(f.toPrecision(4))),
  };
  return `curl ${location.origin}/v1/structures/${info.id}/batches \\\n  -H 'content-type: application/json' \\\n  -d '${JSON.stringify({ measurements: [measurement] })}'`;
}

/** Maximum number of batches that the dialog lists; a period has no such limit. */
const MOST_LISTED = 200;

/** Dialog to choose the batches of a new undamaged reference, or, with `extend`, of an extension. `period`: begin and end of a proposed
 * period in seconds. */
export async function declare(structure, changed, { extend = false, period: proposed = null } = {}) {
  let items;
  try {
    ({ items } = await read(at(structure, `/history?limit=${MOST_LISTED}`)));
  } catch (error) {
    return notify(error.message, "error");
  }
  const usable = items.filter((item) => item.assessment);
  const rejected = (item) => item.assessment.trust === "rejected";
  const boxes = usable.map((item) => {
    const box = h("input", {
      type: "checkbox",
      name: "batch",
      value: item.batch,
      id: `batch-${item.batch}`,
      disabled: rejected(item),
    });
    return h(
      "li",
      null,
      h(
        "label",
        { for: box.id },
        box,
        ` ${local(item.measured_from)}, ${count(item.measurement_count, "measurement")}${rejected(item) ? ", rejected" : ""}`,
      ),
    );
  });
  const list = h("ul", { class: "choices", tabindex: 0, "aria-label": "Batches" }, boxes);
  const listed = h(
    "details",
    { open: !proposed },
    h("summary", null, proposed ? "Choose single batches instead of the period" : "Single batches"),
    items.length === MOST_LISTED &&
      h("p", { class: "fine" }, `The first ${MOST_LISTED} batches of the record are listed; a period below takes any of them.`),
    list,
  );
  const done = await ask({
    title: extend ? "Extend the undamaged reference" : "Declare the undamaged reference",
    body: [
      h(
        "p",
        null,
        extend
          ? "The reference keeps its batches and gains others that you accept as healthy, so that it has seen more of the year. Batches of a damage alarm are not accepted, and nothing is changed if the first version of the reference shows a lasting loss in what was added since."
          : "Later batches are compared with these. Choose batches measured while the structure was known to be undamaged, over as wide a range of temperature and other covariates as available, or the period in which it was. All batches are compared again with the new reference, and its alarms replace those of the old one where it covers their time.",
      ),
      listed,
    ],
    fields: [
      {
        name: "from",
        label: `${proposed ? "Period" : "Instead of batches, a period"}: from (${zone()})`,
        type: "datetime-local",
        value: proposed ? fieldTime(proposed[0]) : "",
        hint: "All batches of the period are used. Doubtful ones are left out and named.",
      },
      {
        name: "to",
        label: `to (${zone()})`,
        type: "datetime-local",
        // The minute of the last batch belongs to the period.
        value: proposed ? fieldTime(proposed[1] + 60) : "",
      },
      !extend && { name: "p", label: "Share of healthy values below the damage threshold δ (%)", type: "text", required: true, value: "5" },
      {
        name: "reason",
        label: "Reason (optional)",
        type: "text",
        hint: "For example a repair, after which an earlier reference no longer applies. It is kept with the version.",
      },
    ].filter(Boolean),
    confirm: extend ? "Extend" : "Declare",
    submit: ({ from, to, p, reason }) => {
      const batches = [...list.querySelectorAll("input:checked")].map((box) => box.value);
      const refuse = (title, message) => {
        throw Object.assign(new Error(message), { title });
      };
      if ((from === "") !== (to === "")) refuse("Incomplete period", "Give both the begin and the end of the period.");
      const period = from === "" ? null : { from: new Date(from).toISOString(), to: new Date(to).toISOString() };
      if (period && batches.length > 0) refuse("Batches and period", "Choose either batches or a period.");
      if (!period && batches.length === 0) refuse("No batch chosen", "Choose at least one batch, or a period.");
      const body = { ...(period ?? { batches }), ...(reason.trim() === "" ? {} : { reason: reason.trim() }) };
      if (extend) return send(at(structure, "/reference/extend"), body);
      return send(at(structure, "/reference"), { ...body, threshold_probability: Number(p.replace(",", ".")) / 100 });
    },
  });
  if (done) {
    notify(
      `Version ${done.version} of the undamaged reference of ${structure} has been declared from ${count(done.batches.length, "batch", "batches")}.`,
    );
    changed();
    if (done.left_out.length > 0) await showLeftOut(done, new Map(items.map((item) => [item.batch, item.measured_from])));
  }
}

/** Which batches are not part of a reference that was declared, and why. */
function showLeftOut(declared, measured) {
  const { batches, left_out: left } = declared;
  return ask({
    title: `${count(left.length, "batch", "batches")} of ${batches.length + left.length} left out`,
    body: [
      h(
        "p",
        null,
        `Version ${declared.version} of the undamaged reference has been declared from ${count(batches.length, "batch", "batches")}. These were left out:`,
      ),
      h(
        "ul",
        { class: "choices", tabindex: 0, "aria-label": "Batches left out" },
        left.map(({ batch, reason }) =>
          h("li", null, measured.has(batch) ? local(measured.get(batch)) : h("code", null, batch), `: ${reason}`),
        ),
      ),
    ],
    confirm: "Close",
    cancel: null,
    submit: async () => true,
  });
}
