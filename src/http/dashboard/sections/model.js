// The model in use with its calibration, and the undamaged state it compares with.

import { at, read, send } from "../api.js";
import { ask, cell, fill, h, icon, notify } from "../dom.js";
import { count, digest, local, number, percent } from "../format.js";

export function model(structure, changed) {
  const content = h("div", null);
  const element = h(
    "section",
    { id: "model", class: "panel", "aria-labelledby": "model-title" },
    h("h2", { id: "model-title" }, "Model and undamaged state"),
    content,
  );
  let shown = null;
  return {
    element,
    update(told, batches) {
      // Each batch brings the same again: what somebody has opened here stays open.
      const key = JSON.stringify([told, batches > 0]);
      if (key === shown) return;
      shown = key;
      fill(
        content,
        h(
          "div",
          { class: "columns" },
          h("div", null, h("h3", null, "Model in use"), told.model ? inUse(told) : missing(told)),
          h(
            "div",
            null,
            h("h3", null, "Undamaged state"),
            told.undamaged ? undamaged(told.undamaged) : firstStep(told, batches),
            told.model &&
              batches > 0 &&
              h(
                "p",
                null,
                h(
                  "button",
                  {
                    type: "button",
                    class: told.undamaged ? "" : "primary",
                    onclick: () => declare(structure, changed),
                  },
                  told.undamaged ? "Declare another undamaged state" : "Declare the undamaged state",
                ),
              ),
          ),
        ),
      );
    },
  };
}

const facts = (list) =>
  h(
    "dl",
    { class: "facts" },
    list.filter(Boolean).map(([name, value]) => h("div", null, h("dt", null, name), h("dd", null, value))),
  );

function missing(told) {
  return [
    h("p", { class: "callout" }, icon("note"), told.model_missing ?? "No trained baseline serves this structure."),
    h(
      "p",
      null,
      "Batches are stored and wait. Train a baseline for exactly this definition, put it into the models folder and start the service again:",
    ),
    h("pre", { tabindex: 0 }, h("code", null, `modalwatch train --structure structure.toml --out models/${told.id}`)),
  ];
}

function inUse({ digest: structureDigest, definition, model: m, emulator }) {
  const { calibration, validation } = m;
  const passed = calibration.failures.length === 0;
  const noise = m.conditions.noise_range;
  return [
    facts([
      definition.description && ["Structure", definition.description],
      ["Model", digest(m.digest)],
      ["Definition", digest(structureDigest)],
      ["Trained by", `modalwatch ${m.program_version}, ${m.training_samples.toLocaleString()} simulations`],
      noise && ["Noise trained for", `${number(noise.lowest)} to ${number(noise.highest)} times that of the structure`],
      [
        "Validation",
        `−log likelihood ${number(validation.negative_log_likelihood, 3)} ± ${number(validation.negative_log_likelihood_error, 2)} nats`,
      ],
      emulator && [
        "Emulator",
        `${count(emulator.runs, "run")}, error ${emulator.error_percent.map((e) => number(e, 2)).join(", ")} % by mode`,
      ],
    ]),
    h(
      "p",
      { class: `callout ${passed ? "good" : "bad"}` },
      icon(passed ? "check" : "alarm"),
      passed
        ? `Calibration passed: ${count(calibration.cells.length, "condition")}, ${calibration.simulations} simulated measurements each.`
        : `Calibration failed: ${calibration.failures.slice(0, 3).join("; ")}${calibration.failures.length > 3 ? `; and ${calibration.failures.length - 3} more` : ""}.`,
    ),
    calibrationTable(calibration.cells),
  ];
}

/** One row a condition: how often the stated intervals hold the true value. */
function calibrationTable(cells) {
  if (cells.length === 0) return null;
  const range = (values) => {
    const [low, high] = [Math.min(...values), Math.max(...values)];
    return low === high ? percent(low) : `${percent(low)} to ${percent(high)}`;
  };
  const line = (condition) =>
    h(
      "tr",
      null,
      h(
        "th",
        { scope: "row" },
        `${number(condition.noise_multiple, 2)} × noise, ${condition.missing_mode ? `without mode ${condition.missing_mode}` : "all modes"}`,
      ),
      cell("50 % intervals hold", range(condition.parameters.map((p) => p.coverage_50))),
      cell("90 % intervals hold", range(condition.parameters.map((p) => p.coverage_90))),
      cell("p (TARP)", number(condition.tarp_p_value, 2)),
    );
  return h(
    "details",
    null,
    h("summary", null, "Calibration by condition"),
    h(
      "table",
      { class: "cards" },
      h("caption", { class: "hidden-text" }, "Calibration by condition"),
      h(
        "thead",
        null,
        h(
          "tr",
          null,
          ["Condition", "50 % intervals hold", "90 % intervals hold", "p (TARP)"].map((c) =>
            h("th", { scope: "col" }, c),
          ),
        ),
      ),
      h("tbody", null, cells.map(line)),
    ),
  );
}

function undamaged(state) {
  const seenWords = (seen) =>
    seen.range ? `${number(seen.range[0])} to ${number(seen.range[1])}` : (seen.categories ?? []).join(", ");
  const conditions = Object.entries(state.conditions).map(([name, seen]) => `${name} ${seenWords(seen)}`);
  return [
    facts([
      ["Version", `${state.version}, declared ${local(state.created_at)}`],
      ["From", `${count(state.batches.length, "batch", "batches")}, ${count(state.measurement_count, "measurement")}`],
      ["Limit", `probability of damage above ${percent(state.threshold_probability)}`],
      conditions.length > 0 && ["Conditions", conditions.join("; ")],
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
      h("caption", { class: "hidden-text" }, "Parameters of the undamaged state"),
      h(
        "thead",
        null,
        h(
          "tr",
          null,
          ["Parameter", "Mean", "Standard deviation", "Threshold δ"].map((c) => h("th", { scope: "col" }, c)),
        ),
      ),
      h(
        "tbody",
        null,
        state.parameters.map((p) =>
          h(
            "tr",
            null,
            h("th", { scope: "row" }, p.name),
            cell("Mean", number(p.mean)),
            cell("Standard deviation", number(p.std, 3)),
            cell("Threshold δ", p.threshold === null ? "–" : number(p.threshold)),
          ),
        ),
      ),
    ),
  ];
}

function firstStep(told, batches) {
  if (!told.model) return h("p", { class: "soft" }, "Comes after the model.");
  if (batches === 0) {
    return [
      h("p", null, "Nothing has been measured yet. Send the first batch:"),
      h("pre", { tabindex: 0 }, h("code", null, postLine(told))),
    ];
  }
  return h(
    "p",
    { class: "callout" },
    icon("note"),
    "There is no undamaged state yet: parameters are estimated, but no probability of damage and no alarm can be given. Choose batches measured while the structure was known to be sound.",
  );
}

/** A command line that posts one measurement of this structure. */
export function postLine(told) {
  const measurement = {
    measured_at: new Date().toISOString().slice(0, 19) + "Z",
    frequencies_hz: told.nominal_frequencies_hz.map((f) => Number(f.toPrecision(4))),
  };
  return `curl ${location.origin}/v1/structures/${told.id}/batches \\\n  -H 'content-type: application/json' \\\n  -d '${JSON.stringify({ measurements: [measurement] })}'`;
}

/** Lets somebody choose batches for a new undamaged state. */
async function declare(structure, changed) {
  let items;
  try {
    ({ items } = await read(at(structure, "/history?limit=200")));
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
  const done = await ask({
    title: "Declare the undamaged state",
    body: [
      h(
        "p",
        null,
        "Later batches are compared with these. Choose batches from the time in which the structure was known to be sound, over as many conditions as there are. All batches are judged again by the new state, and alarms of the old one are withdrawn.",
      ),
      list,
    ],
    fields: [{ name: "p", label: "Limit: probability of damage above, %", type: "text", required: true, value: "5" }],
    confirm: "Declare",
    submit: ({ p }) => {
      const batches = [...list.querySelectorAll("input:checked")].map((box) => box.value);
      if (batches.length === 0)
        throw Object.assign(new Error("Choose at least one batch."), { title: "No batch chosen" });
      return send(at(structure, "/reference"), { batches, threshold_probability: Number(p.replace(",", ".")) / 100 });
    },
  });
  if (done) {
    notify(`Undamaged state ${done.version} of ${structure} is declared.`);
    changed();
  }
}
