// Training of the model of a structure by the service: settings, progress, outcome and the next step.

import { at, read, send } from "../api.js";
import { ask, fill, h, icon, notify, problem, refill } from "../dom.js";
import { age, number } from "../format.js";
import { controls, isOpen, progress } from "../jobs.js";
import { jobChip } from "../states.js";

/** Trainings that are shown; the others are in the list of jobs. */
const SHOWN = 5;

const OUTCOMES = {
  passed: ["check", "good"],
  cautious: ["note", ""],
  overconfident: ["alarm", "bad"],
};

const recipeWords = ({ recipe: r }) =>
  `${r.samples.toLocaleString("en")} simulations, ${r.epochs} epochs, ${r.units} units, at most ${r.rounds} ${r.rounds === 1 ? "round" : "rounds"}, noise from ${number(r.noise_range.lowest)} to ${number(r.noise_range.highest)} times that of the structure, seed ${r.seed}`;

/** A whole number of the dialog. */
function whole(text, name, lowest, highest) {
  const value = Number(text.trim().replaceAll(/[\s_]/g, ""));
  if (Number.isInteger(value) && value >= lowest && value <= highest) return value;
  throw new Error(`${name}: “${text}” is not a whole number from ${lowest} to ${highest.toLocaleString("en")}.`);
}

function decimal(text, name) {
  const value = Number(text.trim().replace(",", "."));
  if (text.trim() !== "" && Number.isFinite(value) && value > 0) return value;
  throw new Error(`${name}: “${text}” is not a number above 0.`);
}

export function training(structure, changed) {
  const content = h("div", null);
  const begin = h("button", { type: "button", onclick: () => train() }, "Train a model");
  const element = h(
    "div",
    { dataset: { part: "training" } },
    h("h3", null, "Training"),
    content,
    h("p", { class: "buttons start" }, begin),
  );
  let defaults = null;

  const load = async () => {
    try {
      const list = await read(at(structure, "/trainings"));
      defaults = list.defaults;
      begin.disabled = list.items.some(isOpen);
      const items = list.items.slice(0, SHOWN);
      refill(
        content,
        items.length === 0
          ? h("p", { class: "soft" }, "No model has been trained here yet. The service simulates measurements of the structure, and the model learns from them which stiffnesses belong to which frequencies. It takes minutes and runs in the background.")
          : h("ul", { class: "alarms" }, items.map(line)),
      );
    } catch (error) {
      fill(content, problem(error, load));
    }
  };

  const line = (item) => {
    const [sign, kind] = OUTCOMES[item.result?.outcome] ?? [];
    return h(
      "li",
      { dataset: { key: item.training } },
      item.result?.in_use === false ? h("span", { class: "chip bad" }, icon("cross"), "Not used") : jobChip(item.state),
      h(
        "span",
        { class: "grow" },
        isOpen(item) && progress(item, `training of ${structure}`),
        item.result && h("span", { class: kind === "bad" ? "bad-text" : "" }, icon(sign), ` ${item.result.summary}`),
        item.failure && h("span", { class: "bad-text" }, item.failure),
        h("span", { class: "fine" }, `${recipeWords(item)}, started `, age(item.created_at)),
      ),
      isOpen(item) && controls(item.training, item, `training of ${structure}`, load),
    );
  };

  const train = async () => {
    if (!defaults) await load();
    if (!defaults || begin.disabled) return;
    const done = await ask({
      title: `Train a model of ${structure}`,
      body: h(
        "p",
        null,
        "The fields show the default for this structure, which suits most. A model that passes its calibration, or is only cautious, is put into use at once, and all stored batches are assessed.",
      ),
      fields: [
        {
          name: "samples",
          label: "Simulated measurements",
          value: String(defaults.samples),
          hint: "More give narrower and better calibrated intervals and take longer in proportion.",
        },
        {
          name: "epochs",
          label: "Epochs",
          value: String(defaults.epochs),
          hint: "How often the first round goes through all simulated measurements.",
        },
        {
          name: "rounds",
          label: "Most rounds",
          value: String(defaults.rounds),
          hint: "While the calibration does not pass, a further round of half the epochs follows.",
        },
        {
          name: "units",
          label: "Units of the network",
          value: String(defaults.units),
          hint: "More represent more complicated dependences and take longer.",
        },
        {
          name: "lowest",
          label: "Lowest noise, as a multiple of the noise of the structure",
          value: String(defaults.noise_range.lowest),
        },
        {
          name: "highest",
          label: "Highest noise, as a multiple of the noise of the structure",
          value: String(defaults.noise_range.highest),
          hint: "The model covers measurements between the two. A narrow range is easier to learn.",
        },
        {
          name: "seed",
          label: "Seed of the random numbers",
          value: String(defaults.seed),
          hint: "The same seed and settings give the same model, here and by modalwatch train.",
        },
        {
          name: "accept",
          type: "checkbox",
          label: "Use the model even if it is overconfident",
          hint: "Every assessment then has a finding about it.",
        },
      ],
      confirm: "Train",
      submit: (values) =>
        send(at(structure, "/trainings"), {
          samples: whole(values.samples, "Simulated measurements", 100, 2000000),
          epochs: whole(values.epochs, "Epochs", 1, 2000),
          rounds: whole(values.rounds, "Most rounds", 1, 16),
          units: whole(values.units, "Units of the network", 1, 64),
          noise_range: { lowest: decimal(values.lowest, "Lowest noise"), highest: decimal(values.highest, "Highest noise") },
          seed: whole(values.seed, "Seed", 0, Number.MAX_SAFE_INTEGER),
          accept_uncalibrated: "accept" in values,
        }),
    });
    if (done) {
      notify("The training has begun. Its progress is shown here and under “Jobs”; you can leave this page.");
      await load();
    }
  };

  return {
    element,
    load,
    /** Opens the dialog that begins a training. */
    train,
    /** Shows a change of a job of this structure. */
    job(data) {
      load();
      if (data.state === "done") changed();
    },
    /** Whether the structure has a model decides how prominent the button is. */
    update(info) {
      begin.className = info.model ? "" : "primary";
      begin.textContent = info.model ? "Train another model" : "Train a model";
      load();
    },
  };
}
