// The page of one structure: its state, charts over a common time span, one batch in detail, model, diagnoses, maintenance.

import { at, read } from "./api.js";
import { TimeGroup, seconds } from "./charts/base.js";
import { control } from "./charts/control.js";
import { heat } from "./charts/heat.js";
import { parameters } from "./charts/parameters.js";
import { scatter } from "./charts/scatter.js";
import { tracks } from "./charts/tracks.js";
import { trust } from "./charts/trust.js";
import { ask, fieldTime, fill, h, keepInAddress, icon, notify, throttled } from "./dom.js";
import { age, count, inWords, local, percent, zone } from "./format.js";
import { help } from "./help.js";
import { alarms } from "./sections/alarms.js";
import { batch } from "./sections/batch.js";
import { diagnosis } from "./sections/diagnosis.js";
import { drawing } from "./sections/drawing.js";
import { guide } from "./sections/guide.js";
import { maintenance } from "./sections/maintenance.js";
import { marking } from "./sections/marking.js";
import { declare, model, postLine } from "./sections/model.js";
import { notes } from "./sections/notes.js";
import { upload } from "./sections/upload.js";
import { stateChip } from "./states.js";

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
/** Probability of damage of the undamaged reference itself as long as none specifies it. */
const USUAL_PROBABILITY = 0.05;

/** The sections of the page, of which one is shown at a time. */
const SECTIONS = [
  ["condition", "Condition"],
  ["tracks", "Frequencies"],
  ["batch", "Batch"],
  ["upload", "Upload"],
  ["model", "Model"],
  ["diagnosis", "Diagnosis"],
  ["maintenance", "Maintenance and notes"],
];

/** Sections that show the time span that is chosen. */
const OVER_TIME = ["condition", "tracks", "batch"];

/** Sections with charts on which the healthy period can be marked by dragging. */
const MARKED_ON = ["condition", "tracks"];

/** `query` is the part of the address that says what is shown: `section`, `from`, `to`, `batch`. */
export function structure(id, query) {
  const state = { info: null, item: null, series: null, batch: query.get("batch") };
  const headline = h("div", { class: "headline" });
  const group = new TimeGroup(zoom);
  const select = async (chosen) => {
    show("batch");
    await detail.select(chosen);
    document.getElementById("batch-title")?.focus();
  };
  const figures = {
    parameters: parameters(group, select),
    heat: heat(group, select),
    control: control(group, select),
    trust: trust(group, select),
    tracks: tracks(group),
    scatter: scatter(),
  };
  const detail = batch(id, (chosen) => {
    state.batch = chosen;
    writeAddress();
  });
  const drawn = drawing(id, (part) => {
    const sets = (p) => [p.sets ?? []].flat().some((set) => set.spring === part || set.beam === part);
    const own = (state.info.definition.parameter ?? []).filter(sets).map((p) => p.name);
    const ofGroup = ({ chart }) => own.some((name) => chart.startsWith("group:") && chart.slice(6).split("+").includes(name));
    const groups = (state.series?.charts ?? []).filter(ofGroup).map((c) => c.chart);
    if (figures.control.choose([part, `spring:${part}`, ...own, ...groups])) figures.control.element.scrollIntoView({ block: "start" });
    else notify(own.length > 0 ? `There is no control chart of ${part} yet.` : `${part} is not monitored: no parameter of the structure sets it.`);
  });
  const alarmList = alarms(id);
  const windows = maintenance(id, () => refresh.series());
  const noteList = notes(id, () => refresh.series());
  const diagnoses = diagnosis(id, () => refresh.all());
  const used = model(id, () => refresh.all());
  const spans = h("div", { class: "picker", role: "group", "aria-label": "Time span" });
  const spanText = h("span", { class: "fine" });
  const asReference = h(
    "button",
    { type: "button", onclick: () => declare(id, () => refresh.all(), { period: shownSpan() }) },
    "Use this time span as undamaged reference",
  );
  const marker = marking(group, (period) => declare(id, () => refresh.all(), { period }));
  const first = h("div", { hidden: true });
  const sections = {
    condition: section(
      "condition",
      "Condition",
      h("div", { class: "beside" }, drawn.element, figures.parameters.element),
      figures.control.element,
      h("div", { class: "grid two" }, figures.heat.element, figures.trust.element),
    ),
    tracks: section("tracks", "Frequencies", figures.tracks.element, figures.scatter.element),
    batch: detail.element,
    upload: upload(id, () => refresh.all()).element,
    model: used.element,
    diagnosis: h("div", { class: "stack" }, diagnoses.card, diagnoses.element),
    maintenance: h("div", { class: "stack" }, windows.element, noteList.element),
  };
  let shown = SECTIONS.some(([name]) => name === query.get("section")) ? query.get("section") : "condition";
  const compared = h("a", { class: "button", href: "#/compare" }, "Compare");
  const printed = h("a", { class: "button" }, "Condition report");
  const spansRow = h("div", { class: "row spans" }, spans, spanText, marker.button, h("span", null, asReference, " ", help("undamaged reference")), printed, compared);
  const jumps = h(
    "nav",
    { class: "jumps", "aria-label": "Sections" },
    SECTIONS.map(([name, word]) =>
      h(
        "a",
        { href: `${address()}?section=${name}`, dataset: { section: name }, onclick: (event) => choose(event, name) },
        word,
      ),
    ),
  );
  const element = h(
    "div",
    { class: "view", dataset: { page: "structure", structure: id } },
    h("p", { class: "crumbs" }, h("a", { href: "#/" }, "Fleet"), ` / ${id}`),
    headline,
    alarmList.element,
    jumps,
    first,
    spansRow,
    marker.hint,
    Object.values(sections),
  );

  function section(name, title, ...content) {
    return h(
      "section",
      { id: name, class: "panel", "aria-labelledby": `${name}-title` },
      h("h2", { id: `${name}-title`, tabindex: -1 }, title),
      content,
    );
  }

  function address() {
    return `#/structures/${encodeURIComponent(id)}`;
  }

  /** Writes what is shown into the address. */
  function writeAddress() {
    const parts = new URLSearchParams();
    if (shown !== "condition") parts.set("section", shown);
    if (group.range && length === undefined) {
      parts.set("from", iso(group.range[0]));
      parts.set("to", iso(group.range[1]));
    }
    if (state.batch) parts.set("batch", state.batch);
    keepInAddress(address(), parts);
  }

  /** Shows one section. Without any batch, only those that do not need one can be shown. */
  function show(name) {
    shown = name;
    const empty = state.empty ?? false;
    for (const [own, part] of Object.entries(sections)) {
      part.hidden = own !== shown || (empty && OVER_TIME.includes(own));
    }
    for (const link of jumps.children) {
      link.hidden = empty && OVER_TIME.includes(link.dataset.section);
      if (link.dataset.section === shown) link.setAttribute("aria-current", "true");
      else link.removeAttribute("aria-current");
    }
    spansRow.hidden = empty || !OVER_TIME.includes(shown);
    if (!MARKED_ON.includes(shown)) marker.end();
    writeAddress();
  }

  function choose(event, name) {
    event.preventDefault();
    show(name);
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
    writeAddress();
    refresh.series();
  }

  function showSpans() {
    const focused = spans.contains(document.activeElement) ? document.activeElement.textContent : null;
    const press = (span) => () => {
      length = span;
      group.range = span === null || !whole ? null : [whole[1] - span, whole[1]];
      showSpans();
      writeAddress();
      refresh.series();
    };
    fill(
      spans,
      SPANS.map(([word, span]) =>
        h("button", { type: "button", "aria-pressed": String(length === span), onclick: press(span) }, word),
      ),
      h("button", { type: "button", "aria-pressed": String(length === undefined), onclick: choosePeriod }, "From … to …"),
    );
    [...spans.children].find((button) => button.textContent === focused)?.focus();
  }

  /** Dialog to choose a time span by its ends. */
  async function choosePeriod() {
    const ends = shownSpan();
    const chosen = await ask({
      title: "Time span",
      fields: [
        { name: "from", label: `From (${zone()})`, type: "datetime-local", required: true, value: fieldTime(ends[0]) },
        { name: "to", label: `To (${zone()})`, type: "datetime-local", required: true, value: fieldTime(ends[1] + 60) },
      ],
      confirm: "Show",
      submit: async ({ from, to }) => {
        const range = [seconds(from), seconds(to)];
        if (range[1] > range[0]) return range;
        throw Object.assign(new Error("The end must be after the beginning."), { title: "No time span" });
      },
    });
    if (chosen) zoom(chosen);
  }

  /** The time span in view, seconds. */
  function shownSpan() {
    return group.range ?? [seconds(state.series.from), seconds(state.series.to)];
  }

  async function loadSeries() {
    if (length && whole) group.range = [whole[1] - length, whole[1]];
    const range =
      group.range && `&from=${encodeURIComponent(iso(group.range[0]))}&to=${encodeURIComponent(iso(group.range[1]))}`;
    const asked = group.range;
    const series = await read(at(id, `/series?points=${POINTS}${range ?? ""}`));
    await group.released();
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
    const usual = info.undamaged?.threshold_probability ?? USUAL_PROBABILITY;
    const empty = (item?.batches ?? series.batches) === 0;
    state.empty = empty;
    show(empty && OVER_TIME.includes(shown) ? "upload" : shown);
    showSteps();
    alarmList.element.hidden = empty;
    if (empty) return;
    asReference.hidden = !info.model;
    marker.button.hidden = !info.model;
    const ends = shownSpan();
    const period = new URLSearchParams({ from: iso(ends[0]), to: iso(ends[1] + 60) });
    printed.href = `${address()}/report?${period}`;
    fill(
      spanText,
      `${local(1000 * ends[0])} to ${local(1000 * ends[1])} (${zone()}), ${count(series.batches, "batch", "batches")}${series.reduced ? ", thinned for display with extremes kept" : ""}`,
    );
    figures.parameters.update(series, usual);
    figures.heat.update(series);
    figures.control.update(series);
    figures.trust.update(series);
    compared.href = `#/compare?${new URLSearchParams({ a: `${id}/${series.parameters[0]?.name ?? ""}` })}`;
    figures.scatter.update(series);
    figures.tracks.update({
      frequencies: series.frequencies,
      maintenance: series.maintenance,
      notes: series.notes,
      reduced: series.reduced,
    });
  }

  /** What of the guide is shown, so that it is drawn again only after a step was done. */
  let stepsShown = null;

  /** The guide to the first verdict, until there is one. */
  function showSteps() {
    const { info, empty } = state;
    const done = [true, Boolean(info.model), !empty, Boolean(info.undamaged)];
    if (String(done) === stepsShown) return;
    stepsShown = String(done);
    const train = () => {
      show("model");
      used.train();
    };
    const mark = () => {
      show("condition");
      marker.begin();
      spansRow.scrollIntoView({ block: "start" });
    };
    const more = empty && byProgram(info);
    const act = [null, train, () => show("upload"), mark];
    const steps = guide({ title: "The way to the first verdict", done, act, trains: info.trains_by_itself, more });
    first.hidden = steps === null;
    fill(first, steps);
  }

  async function loadInfo() {
    const [info, overview] = await Promise.all([read(at(id)), read("v1/overview")]);
    state.info = info;
    state.item = overview.items.find((item) => item.id === id) ?? null;
    fill(headline, head(id, state));
    used.update(info, state.item?.batches ?? 0);
    if (state.empty !== undefined) showSteps();
    await drawn.load(info);
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
        await Promise.all([loadSeries(), alarmList.load(), diagnoses.load(), windows.load(), noteList.load()]);
        await detail.again();
      }),
      1500,
    ),
  };

  return {
    title: id,
    element,
    async load() {
      const asked = [query.get("from"), query.get("to")].map((time) => seconds(time ?? ""));
      if (asked.every(Number.isFinite) && asked[0] < asked[1]) {
        // The ends of the record are known only from a request without a time range.
        const { from, to } = await read(at(id, "/series?points=10"));
        if (from && to) {
          whole = [seconds(from), seconds(to)];
          group.all = whole;
        }
        group.range = asked;
        length = undefined;
      }
      showSpans();
      await loadInfo();
      await Promise.all([loadSeries(), alarmList.load(), diagnoses.load(), windows.load(), noteList.load()]);
      const wanted = query.get("batch");
      if (wanted && !state.empty) await detail.select(wanted);
    },
    event(name, data) {
      if (data.structure !== id) return;
      // What an open alarm says follows the newest batch, also while its state stays the same.
      if (name === "batch" || name === "alarm") {
        refresh.alarms();
        refresh.grown();
      } else if (name === "job") {
        refresh.diagnoses();
        // An alarm links to the diagnosis that it started.
        if (data.trigger === "rejected_episode") refresh.alarms();
        if (data.kind === "training") used.job(data);
        if (data.kind === "extension" && data.state === "done") refresh.all();
      } else if (name === "structure") refresh.all();
    },
    missed: () => refresh.all(),
    end: () => {
      left = true;
      marker.leave();
    },
  };
}

const iso = (time_s) => new Date(1000 * time_s).toISOString();

/** Heading with the state and the verdict, which follows from the alarm charts alone. */
function head(id, { info, item }) {
  const latest = item?.latest;
  const facts = [];
  if (latest && latest.trust === "rejected")
    facts.push("The latest batch was rejected; its probability of damage is withheld.");
  else if (latest && latest.max_probability_of_damage !== null && latest.max_probability_of_damage !== undefined)
    facts.push(
      ["Highest probability of damage ", help("probability of damage")],
      ` in the latest batch: ${percent(latest.max_probability_of_damage)} (${inWords(latest.max_parameter)}).`,
    );
  if (item?.state === "not_judged" && item.undamaged_version) facts.push("The undamaged reference can be declared again under “Model”.");
  if (item?.state === "silent") facts.push("Check the data logger and its connection.");
  return [
    h("div", { class: "row" }, h("h1", null, id), item && stateChip(item.state)),
    info.definition.description && h("p", { class: "fine" }, info.definition.description),
    item && h("p", { class: "lead verdict" }, item.verdict, item.alarm_since && [" Alarm raised ", age(item.alarm_since), "."]),
    item &&
      h(
        "p",
        { class: "fine" },
        facts.flatMap((fact) => [fact, " "]),
        item.batches === 0
          ? "No measurements yet."
          : [
              "Last measured ",
              age(item.last_measured_at),
              ", last received ",
              age(item.last_received_at),
              ", ",
              count(item.batches, "batch", "batches"),
            ],
        item.open_alarms > 0 && [
          " · ",
          icon("alarm"),
          h("strong", null, count(item.open_alarms, "open alarm")),
          item.unacknowledged_alarms > 0 ? `, ${item.unacknowledged_alarms} not acknowledged` : ", acknowledged",
        ],
      ),
  ];
}

/** How a program sends the first batch. */
function byProgram(info) {
  return h(
    "details",
    null,
    h("summary", null, "Send measurements by a program"),
    h("p", { class: "fine" }, "They appear here by themselves:"),
    h("pre", { tabindex: 0 }, h("code", null, postLine(info))),
  );
}
