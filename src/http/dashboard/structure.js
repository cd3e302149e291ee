// The page of one structure: its state, charts over a common time span, one batch in detail, model, diagnoses, maintenance.

import { at, read } from "./api.js";
import { TimeGroup, seconds } from "./charts/base.js";
import { control } from "./charts/control.js";
import { heat } from "./charts/heat.js";
import { parameters } from "./charts/parameters.js";
import { tracks } from "./charts/tracks.js";
import { trust } from "./charts/trust.js";
import { fill, h, icon, throttled } from "./dom.js";
import { age, count, local, percent, zone } from "./format.js";
import { alarms } from "./sections/alarms.js";
import { batch } from "./sections/batch.js";
import { diagnosis } from "./sections/diagnosis.js";
import { maintenance } from "./sections/maintenance.js";
import { model, postLine } from "./sections/model.js";
import { upload } from "./sections/upload.js";
import { stateChip, stateText } from "./states.js";

const DAY_S = 86400;
const SPANS = [
  ["1 day", DAY_S],
  ["1 week", 7 * DAY_S],
  ["1 month", 30 * DAY_S],
  ["1 year", 365 * DAY_S],
  ["All", null],
];
/** Maximum number of points requested per series; more could not be distinguished on a screen. */
const POINTS = 1000;
/** Limit of the probability of damage as long as no undamaged reference specifies one. */
const DEFAULT_LIMIT = 0.05;

const JUMPS = [
  ["alarms", "Alarms"],
  ["condition", "Condition"],
  ["tracks", "Frequencies"],
  ["batch", "Batch"],
  ["model", "Model"],
  ["diagnosis", "Diagnosis"],
  ["maintenance", "Maintenance"],
];

export function structure(id) {
  const state = { info: null, item: null, series: null };
  const headline = h("div", { class: "headline" });
  const group = new TimeGroup(zoom);
  const select = (chosen) => detail.select(chosen);
  const figures = {
    parameters: parameters(group, select),
    heat: heat(group, select),
    control: control(group, select),
    trust: trust(group, select),
    tracks: tracks(group),
  };
  const detail = batch(id);
  const alarmList = alarms(id);
  const windows = maintenance(id, () => refresh.series());
  const diagnoses = diagnosis(id, () => refresh.all());
  const used = model(id, () => refresh.all());
  const spans = h("div", { class: "picker", role: "group", "aria-label": "Time span" });
  const spanText = h("span", { class: "fine" });
  const first = h("div", null);
  const charts = h(
    "div",
    null,
    section(
      "condition",
      "Condition",
      figures.parameters.element,
      figures.control.element,
      figures.heat.element,
      figures.trust.element,
    ),
    section("tracks", "Frequencies", figures.tracks.element),
    detail.element,
  );
  const jumps = h(
    "nav",
    { class: "jumps", "aria-label": "Sections" },
    JUMPS.map(([name, word]) => h("a", { href: `#${name}`, onclick: (event) => jump(event, name) }, word)),
  );
  const element = h(
    "div",
    { class: "view", dataset: { page: "structure", structure: id } },
    h("p", { class: "crumbs" }, h("a", { href: "#/" }, "Fleet"), ` / ${id}`),
    headline,
    jumps,
    alarmList.element,
    diagnoses.card,
    first,
    h("div", { class: "row spans" }, spans, spanText),
    charts,
    upload(id, () => refresh.all()).element,
    used.element,
    diagnoses.element,
    windows.element,
  );

  function section(name, title, ...content) {
    return h(
      "section",
      { id: name, class: "panel", "aria-labelledby": `${name}-title` },
      h("h2", { id: `${name}-title`, tabindex: -1 }, title),
      content,
    );
  }

  /** Scrolls to a section and moves the focus there, without changing the address of the page. */
  function jump(event, name) {
    event.preventDefault();
    const target = document.getElementById(name);
    target.scrollIntoView({ block: "start" });
    const heading = target.querySelector("h2");
    heading.tabIndex = -1;
    heading.focus({ preventScroll: true });
  }

  /** True once another view has replaced this one. */
  let left = false;
  /** First and last time of the record in seconds; set by the first request. */
  let whole = null;
  /** Length in seconds of the chosen time span, which ends at the newest batch; `null` shows the whole record, `undefined` a
   * span chosen by zooming. */
  let length = null;

  function zoom(range) {
    length = undefined;
    group.range = range;
    if (range === null) length = null;
    showSpans();
    refresh.series();
  }

  function showSpans() {
    const focused = spans.contains(document.activeElement) ? document.activeElement.textContent : null;
    const press = (span) => () => {
      length = span;
      group.range = span === null || !whole ? null : [whole[1] - span, whole[1]];
      showSpans();
      refresh.series();
    };
    fill(
      spans,
      SPANS.map(([word, span]) =>
        h("button", { type: "button", "aria-pressed": String(length === span), onclick: press(span) }, word),
      ),
    );
    [...spans.children].find((button) => button.textContent === focused)?.focus();
  }

  async function loadSeries() {
    if (length && whole) group.range = [whole[1] - length, whole[1]];
    const range =
      group.range && `&from=${encodeURIComponent(iso(group.range[0]))}&to=${encodeURIComponent(iso(group.range[1]))}`;
    const asked = group.range;
    const series = await read(at(id, `/series?points=${POINTS}${range ?? ""}`));
    // The answer is outdated if the user has zoomed or left the page in the meantime.
    if (asked !== group.range || left) return;
    state.series = series;
    const ends = [series.from, series.to].map((time) => (time ? seconds(time) : null));
    if (!group.range && ends[0] !== null) {
      whole = ends;
      const padding = Math.max((ends[1] - ends[0]) * 0.01, 60);
      group.all = [ends[0] - padding, ends[1] + padding];
    }
    draw();
    await detail.update(series);
  }

  function draw() {
    const { series, info, item } = state;
    const limit = info.undamaged?.threshold_probability ?? DEFAULT_LIMIT;
    const empty = (item?.batches ?? series.batches) === 0;
    charts.hidden = empty;
    for (const link of jumps.children) {
      link.hidden = empty && ["#condition", "#tracks", "#batch"].includes(link.getAttribute("href"));
    }
    spans.parentElement.hidden = empty;
    fill(first, empty ? nothingYet(info) : "");
    if (empty) return;
    const shown = group.range ?? [seconds(series.from), seconds(series.to)];
    fill(
      spanText,
      `${local(1000 * shown[0])} to ${local(1000 * shown[1])} (${zone()}), ${count(series.batches, "batch", "batches")}${series.reduced ? ", thinned for display with extremes kept" : ""}`,
    );
    figures.parameters.update(series, limit);
    figures.heat.update(series);
    figures.control.update(series);
    figures.trust.update(series);
    figures.tracks.update({
      frequencies: series.frequencies,
      maintenance: series.maintenance,
      reduced: series.reduced,
    });
  }

  async function loadInfo() {
    const [info, overview] = await Promise.all([read(at(id)), read("v1/overview")]);
    state.info = info;
    state.item = overview.items.find((item) => item.id === id) ?? null;
    fill(headline, head(id, state));
    used.update(info, state.item?.batches ?? 0);
  }

  const quietly = (work) => () => work().catch(() => {});
  const refresh = {
    info: throttled(quietly(loadInfo), 1500),
    series: throttled(quietly(loadSeries), 800),
    // A new batch also moves the end of the record, which only a request without a time range returns.
    grown: throttled(
      quietly(async () => {
        await loadInfo();
        if (group.range && length !== undefined) {
          const { from, to } = await read(at(id, "/series?points=10"));
          whole = [seconds(from), seconds(to)];
        }
        await loadSeries();
      }),
      1500,
    ),
    alarms: throttled(quietly(alarmList.load), 1500),
    diagnoses: throttled(quietly(diagnoses.load), 1000),
    all: throttled(
      quietly(async () => {
        await loadInfo();
        await Promise.all([loadSeries(), alarmList.load(), diagnoses.load(), windows.load()]);
        await detail.again();
      }),
      1500,
    ),
  };

  return {
    title: id,
    element,
    async load() {
      showSpans();
      await loadInfo();
      await Promise.all([loadSeries(), alarmList.load(), diagnoses.load(), windows.load()]);
    },
    event(name, data) {
      if (data.structure !== id) return;
      if (name === "batch") refresh.grown();
      else if (name === "alarm") {
        refresh.alarms();
        refresh.grown();
      } else if (name === "job") {
        refresh.diagnoses();
        // An alarm links to the diagnosis that it started.
        if (data.trigger === "rejected_episode") refresh.alarms();
        if (data.kind === "extension" && data.state === "done") refresh.all();
      } else if (name === "structure") refresh.all();
    },
    missed: () => refresh.all(),
    end: () => (left = true),
  };
}

const iso = (time_s) => new Date(1000 * time_s).toISOString();

/** Heading with the state and a summary of the latest batch. */
function head(id, { info, item }) {
  const latest = item?.latest;
  const silent = item?.state === "silent";
  const sentence = [];
  if (latest && latest.trust === "rejected")
    sentence.push("The latest batch was rejected; its probability of damage is withheld.");
  else if (latest && latest.max_probability_of_damage !== null && latest.max_probability_of_damage !== undefined)
    sentence.push(
      `Latest batch: highest probability of damage ${percent(latest.max_probability_of_damage)} (${latest.max_parameter})${latest.exceeds ? ", above the limit" : ""}.`,
    );
  if (item && !info.model) sentence.push("There is no trained model for this structure.");
  else if (item && !info.undamaged && item.batches > 0) sentence.push("Next step: declare the undamaged reference.");
  if (silent) sentence.push("Check the data logger and its connection.");
  return [
    h(
      "div",
      { class: "row" },
      h("h1", null, id),
      item && stateChip(item.state),
      item && h("span", { class: "soft" }, stateText(item.state)),
    ),
    info.definition.description && h("p", { class: "fine" }, info.definition.description),
    h("p", { class: "lead" }, sentence.join(" ")),
    item &&
      h(
        "p",
        { class: "fine" },
        "Last measured ",
        age(item.last_measured_at),
        ", last received ",
        age(item.last_received_at),
        ", ",
        count(item.batches, "batch", "batches"),
        item.open_alarms > 0 && [
          " · ",
          icon("alarm"),
          h("strong", null, count(item.open_alarms, "open alarm")),
          item.unacknowledged_alarms > 0 ? `, ${item.unacknowledged_alarms} not acknowledged` : ", acknowledged",
        ],
      ),
  ];
}

function nothingYet(info) {
  return h(
    "div",
    { class: "blank" },
    h("h2", null, "No measurements yet"),
    h(
      "p",
      null,
      "The structure is registered",
      info.model ? " and its trained model is ready" : "",
      ". Send the first batch; it appears here automatically:",
    ),
    h("pre", { tabindex: 0 }, h("code", null, postLine(info))),
  );
}
