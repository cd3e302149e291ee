// One batch in detail: probability densities, measured and predicted frequencies, trust and findings.

import { at, read } from "../api.js";
import { signed } from "../charts/parameters.js";
import { densities } from "../charts/density.js";
import { modes } from "../charts/modes.js";
import { cell, fill, h, icon, problem } from "../dom.js";
import { count, digest, inWords, local, number, percentWithin, quantity, timeElement, words, worth } from "../format.js";
import { help } from "../help.js";
import { trustChip } from "../states.js";
import { shapes } from "./shapes.js";

const EFFECTS = {
  reject: ["cross", "bad", "batch rejected"],
  hold_alarm: ["note", "warn", "damage charts not updated"],
  note: ["note", "idle", "information"],
};

/** `onChoice(id)` is called with the batch that the user has chosen, or `null` while the newest one is shown. */
export function batch(structure, onChoice) {
  const picker = h("select", { id: "batch-picker", onchange: () => choose(picker.value) });
  const earlier = h("button", { type: "button", "aria-label": "Earlier batch", onclick: () => step(1) }, icon("left"));
  const later = h("button", { type: "button", "aria-label": "Later batch", onclick: () => step(-1) }, icon("right"));
  const description = h("div", null);
  const density = densities();
  const mode = modes();
  const shape = shapes(structure);
  const drawn = h("div", { class: "stack" }, density.element, mode.element, shape.element);
  const element = h(
    "section",
    { id: "batch", class: "panel", "aria-labelledby": "batch-title" },
    h("h2", { id: "batch-title", tabindex: -1 }, "Batch"),
    h("p", { class: "row" }, h("label", { for: "batch-picker" }, "Batch measured until"), earlier, picker, later),
    description,
    drawn,
  );
  let list = [];
  let chosen = null;
  /** Whether the newest batch is shown as it arrives; ends when the user chooses another batch. */
  let following = true;

  const step = (by) => {
    const index = list.findIndex((item) => item.batch === chosen) + by;
    if (index >= 0 && index < list.length) choose(list[index].batch);
  };
  const choose = (id) => {
    following = id === list[0]?.batch;
    chosen = id;
    onChoice(following ? null : id);
    return show();
  };

  const show = async () => {
    const id = chosen;
    const index = list.findIndex((item) => item.batch === id);
    picker.value = id ?? "";
    earlier.disabled = index < 0 || index >= list.length - 1;
    later.disabled = index <= 0;
    element.classList.add("busy");
    try {
      const path = at(structure, `/batches/${encodeURIComponent(id)}`);
      const info = await read(path);
      // A batch that waits for its assessment or could not be assessed has no detail; its other data are shown nevertheless.
      const isAssessed = info.state === "assessed";
      const detail = isAssessed ? await read(`${path}/detail`).catch((error) => ({ error })) : null;
      if (id !== chosen) return;
      // After a change of the version, the model or the reference, a batch that was assessed a moment ago waits: its detail is 409.
      const waits = info.assessment && (info.state === "received" || detail?.error?.status === 409);
      fill(
        description,
        describe(info),
        waits && h("p", { class: "callout" }, icon("note"), "The batch waits to be assessed again; its distributions are shown after that."),
        detail?.error && info.assessment && !waits && problem(detail.error, show),
      );
      drawn.hidden = !isAssessed || Boolean(detail.error);
      if (!drawn.hidden) {
        density.update(detail);
        mode.update(detail);
        await shape.update(id, detail.mode_shapes);
      }
    } catch (error) {
      if (id === chosen) fill(description, problem(error, show));
    } finally {
      element.classList.remove("busy");
    }
  };

  return {
    element,
    /** Takes the batches of the time span in view. */
    async update(series) {
      const newest = [...series.trust].reverse();
      const changed = newest.length !== list.length || newest[0]?.batch !== list[0]?.batch;
      list = newest;
      if (list.length === 0) {
        drawn.hidden = true;
        picker.disabled = true;
        chosen = null;
        return fill(description, h("p", { class: "soft" }, "No assessed batch in this time span."));
      }
      picker.disabled = false;
      if (following || !chosen) chosen = list[0].batch;
      if (changed) {
        const known = list.some((item) => item.batch === chosen);
        fill(
          picker,
          !known && h("option", { value: chosen }, chosen),
          list.map((item) =>
            h(
              "option",
              { value: item.batch },
              `${local(item.time)}${item.verdict === "rejected" ? " – rejected" : ""}`,
            ),
          ),
        );
      }
      if (changed || drawn.hidden) await show();
    },
    /** Shows a batch, such as one that was selected in a chart. */
    select: choose,
    again: () => chosen && show(),
  };
}

function describe(info) {
  const a = info.assessment;
  const facts = [
    ["Measured", h("span", null, timeElement(info.measured_from), " to ", timeElement(info.measured_to))],
    ["Received", timeElement(info.received_at)],
    [
      "Measurements",
      a
        ? `${info.measurement_count}, of which ${a.measurements_used} used, ${a.measurements_left_out} left out, ${a.measurements_outside} outside the prior${worth(a.effective_measurements, a.measurements_used)}`
        : String(info.measurement_count),
    ],
    ["Source", info.source],
    info.posted_by && ["Posted with token", h("code", null, info.posted_by)],
    ["State", words(info.state)],
    a && [
      "Trust",
      h(
        "span",
        null,
        trustChip(a.trust, a.findings.length),
        a.fit_p_value !== null ? [` p-value of the fit: ${number(a.fit_p_value, 2)} `, help("p-value of the fit")] : "",
      ),
    ],
    a && ["Trained model", digest(a.model_digest)],
    ["Batch", h("code", null, info.batch)],
  ].filter(Boolean);
  return [
    h(
      "dl",
      { class: "facts" },
      facts.map(([name, value]) => h("div", null, h("dt", null, name), h("dd", null, value))),
    ),
    info.failure && h("p", { class: "callout bad" }, icon("alarm"), `The assessment failed: ${info.failure}`),
    info.next_step && h("p", { class: "callout" }, icon("note"), info.next_step),
    a?.trust === "rejected" &&
      h(
        "p",
        { class: "callout bad" },
        icon("cross"),
        "Rejected: the probability of damage is withheld and no damage alarm is raised. The findings give the reasons.",
      ),
    a?.findings.length > 0 && h("ul", { class: "findings", "aria-label": "Findings" }, a.findings.map(finding)),
    a && parameterTable(a),
  ];
}

function finding(f) {
  const [sign, kind, text] = EFFECTS[f.effect] ?? EFFECTS.note;
  return h(
    "li",
    null,
    h("span", { class: `chip ${kind}` }, icon(sign), words(f.code)),
    h(
      "span",
      { class: "grow" },
      f.message,
      h(
        "span",
        { class: "fine" },
        text,
        f.measurements?.length > 0 && `, ${count(f.measurements.length, "measurement")}`,
      ),
    ),
  );
}

/** Help at the columns that a newcomer may not know. */
const COLUMN_HELP = {
  "90 % interval": () => [" ", help("credible interval")],
  "Damage threshold δ": () => [" ", help("damage threshold")],
  "Probability of damage": () => [" ", help("probability of damage")],
};

function parameterTable(a) {
  const interval = (pair) => (pair ? `${number(pair[0])} to ${number(pair[1])}` : "–");
  const withheld = a.trust === "rejected";
  const line = (p) =>
    h(
      "tr",
      null,
      h("th", { scope: "row" }, inWords(p.name)),
      cell("Mean", quantity(p.mean, p.unit)),
      cell("90 % interval", interval(p.mean_interval)),
      cell("Damage threshold δ", p.threshold === null ? "–" : quantity(p.threshold, p.unit)),
      cell("Change from reference", p.relative_change === null ? "–" : `${signed(100 * p.relative_change)} %`),
      cell(
        "Probability of damage",
        p.probability_of_damage === null
          ? withheld
            ? "withheld"
            : "–"
          : percentWithin(p.probability_of_damage, ...(p.probability_of_damage_interval ?? [null, null])),
      ),
    );
  const columns = [
    "Parameter",
    "Mean",
    "90 % interval",
    "Damage threshold δ",
    "Change from reference",
    "Probability of damage",
  ];
  return h(
    "table",
    { class: "cards" },
    h("caption", { class: "hidden-text" }, "Parameters of the batch"),
    h(
      "thead",
      null,
      h(
        "tr",
        null,
        columns.map((c) => h("th", { scope: "col" }, c, COLUMN_HELP[c]?.())),
      ),
    ),
    h("tbody", null, a.parameters.map(line)),
  );
}
