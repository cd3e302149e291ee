// The fleet: all structures with their states, the most urgent first.

import { at, read } from "./api.js";
import { acknowledgeDialog, alarmWords } from "./sections/alarms.js";
import { describe } from "./sections/describe.js";
import { guide } from "./sections/guide.js";
import { cell, fill, h, icon, refill, throttled } from "./dom.js";
import { age, count, inWords, percent } from "./format.js";
import { help } from "./help.js";
import { EVERY_STATE, stateChip, stateWord, trustChip, urgency } from "./states.js";

/** Maximum number of structures whose open alarms are listed at the top. */
const MOST_ALARMING = 20;

/** Help at the columns that a newcomer may not know. */
const COLUMN_HELP = {
  "Highest probability of damage": () => [" ", help("probability of damage")],
  "Latest batch": () => [" ", help("trust")],
  Model: () => [" ", help("calibration")],
};

export function overview() {
  const tiles = h("ul", { class: "tiles", "aria-label": "Structures by state" });
  const alarmList = h("section", { class: "panel", "aria-labelledby": "open-alarms" });
  const body = h("tbody", null);
  const table = h(
    "table",
    { class: "cards fleet" },
    h("caption", { class: "hidden-text" }, "Structures, most urgent first"),
    h(
      "thead",
      null,
      h(
        "tr",
        null,
        ["State", "Structure and verdict", "Last measured", "Alarms", "Highest probability of damage", "Latest batch", "Model"].map(
          (c) => h("th", { scope: "col" }, c, COLUMN_HELP[c]?.()),
        ),
      ),
    ),
    body,
  );
  const blank = h("div", null);
  /** Whether the guide is shown. */
  let guided = false;
  const another = h(
    "p",
    { class: "buttons start" },
    h("button", { type: "button", onclick: () => describe() }, "Describe a structure"),
  );
  const element = h(
    "div",
    { class: "view", dataset: { page: "fleet" } },
    h("h1", null, "Fleet"),
    tiles,
    alarmList,
    blank,
    table,
    another,
  );

  const load = async () => {
    const { items } = await read("v1/overview");
    const sorted = items.toSorted(
      (a, b) =>
        urgency(a.state) - urgency(b.state) ||
        b.unacknowledged_alarms - a.unacknowledged_alarms ||
        a.id.localeCompare(b.id),
    );
    const focused = document.activeElement?.closest?.("tr")?.dataset.structure;
    fill(
      tiles,
      EVERY_STATE.map((state) => [state, items.filter((item) => item.state === state).length])
        .filter(([, n]) => n > 0)
        .map(([state, n]) => h("li", null, h("strong", null, String(n)), stateChip(state))),
    );
    fill(body, sorted.map(row));
    if (focused) body.querySelector(`tr[data-structure="${CSS.escape(focused)}"] a`)?.focus();
    table.hidden = items.length === 0;
    // Until there are measurements, the way to them is what a person needs.
    const isNew = items.every((item) => item.batches === 0);
    tiles.hidden = isNew;
    // The first step of the guide has the same button.
    another.hidden = isNew;
    if (isNew !== guided) fill(blank, isNew ? firstSteps(items.length > 0) : "");
    guided = isNew;
    const open = items.reduce((sum, item) => sum + item.open_alarms, 0);
    // The title shows the number of alarms even if the tab is in the background.
    document.title = `${open > 0 ? `(${open}) ` : ""}Fleet – modalwatch`;
    await loadAlarms(sorted);
  };

  const loadAlarms = async (items) => {
    const alarming = items.filter((item) => item.open_alarms > 0).slice(0, MOST_ALARMING);
    const read_one = async (item) =>
      (await read(at(item.id, "/alarms?state=open&limit=20"))).items.map((alarm) => ({ ...alarm, structure: item.id }));
    const lists = await Promise.all(alarming.map((item) => read_one(item).catch(() => [])));
    const alarms = lists
      .flat()
      .sort(
        (a, b) => Boolean(a.acknowledgement) - Boolean(b.acknowledgement) || b.opened_at.localeCompare(a.opened_at),
      );
    alarmList.hidden = alarms.length === 0;
    refill(
      alarmList,
      h("h2", { id: "open-alarms" }, "Open alarms"),
      h(
        "ul",
        { class: "alarms" },
        alarms.map((alarm) =>
          h(
            "li",
            {
              class: alarm.acknowledgement ? "seen" : "unseen",
              dataset: { key: `${alarm.structure} ${alarm.alarm}` },
            },
            icon(["silence", "not_assessed"].includes(alarm.kind) ? "silent" : "alarm"),
            h(
              "span",
              { class: "grow" },
              h("a", { href: `#/structures/${encodeURIComponent(alarm.structure)}` }, alarm.structure),
              `: ${alarmWords(alarm)}, `,
              age(alarm.opened_at),
              alarm.acknowledgement && h("span", { class: "fine" }, `acknowledged by ${alarm.acknowledgement.by}`),
            ),
            !alarm.acknowledgement &&
              h(
                "button",
                {
                  type: "button",
                  onclick: () => acknowledgeDialog(alarm.structure, alarm).then((done) => done && again()),
                },
                "Acknowledge",
                h("span", { class: "hidden-text" }, ` ${alarm.structure}, alarm ${alarm.alarm}`),
              ),
          ),
        ),
      ),
    );
  };

  const again = throttled(() => load().catch(() => {}), 1500);
  return { title: "Fleet", element, load, event: (name) => name !== "job" && again(), missed: again };
}

function row(item) {
  const latest = item.latest;
  const damage = latest && latest.max_probability_of_damage !== null && latest.max_probability_of_damage !== undefined;
  return h(
    "tr",
    { dataset: { structure: item.id, state: item.state } },
    cell("State", stateChip(item.state)),
    h(
      "th",
      { scope: "row" },
      h("a", { href: `#/structures/${encodeURIComponent(item.id)}` }, item.id),
      h("span", { class: "fine verdict" }, item.verdict),
    ),
    cell(
      "Last measured",
      age(item.last_measured_at),
      item.batches > 0 && h("span", { class: "fine" }, count(item.batches, "batch", "batches")),
    ),
    cell("Alarms", alarmCount(item)),
    cell(
      "Probability of damage",
      damage
        ? h("span", null, meter(latest), ` ${inWords(latest.max_parameter)}`)
        : h(
            "span",
            { class: "soft" },
            latest?.trust === "rejected" ? "withheld" : item.undamaged_version ? "–" : "no reference",
          ),
    ),
    cell("Latest batch", latest ? trustChip(latest.trust, latest.findings) : h("span", { class: "soft" }, "none yet")),
    cell("Model", modelMark(item)),
  );
}

function alarmCount(item) {
  if (item.open_alarms === 0) return h("span", { class: "soft" }, "none");
  const unseen = item.unacknowledged_alarms;
  return h(
    "span",
    null,
    h("strong", null, `${item.open_alarms} open`),
    h("span", { class: "fine" }, unseen > 0 ? `${unseen} not acknowledged` : "all acknowledged"),
  );
}

function meter(latest) {
  const value = latest.max_probability_of_damage;
  const bar = h("span", { class: "bar", "aria-hidden": "true" }, h("span", null));
  bar.firstChild.style.width = `${100 * value}%`;
  return h(
    "span",
    { class: "meter" },
    bar,
    percent(value),
  );
}

function modelMark(item) {
  if (!item.model_digest)
    return h(
      "span",
      { title: item.model_missing ?? "" },
      h("span", { class: "chip idle" }, icon("unassessed"), stateWord("no_model")),
    );
  if (item.calibration_outcome === "overconfident")
    return h("span", { class: "chip warn" }, icon("note"), "Intervals too narrow");
  if (item.calibration_outcome === "not_measured") return h("span", { class: "soft" }, "calibration not measured yet");
  if (item.calibration_outcome === "cautious") return h("span", { class: "soft" }, "calibrated, some intervals too wide");
  return h("span", { class: "soft" }, "calibrated");
}

/** The way to the first verdict, for a service without any measurements. Some structures are shipped with the program. */
function firstSteps(others) {
  return guide({
    title: "No measurements yet: the way to the first verdict",
    done: [false, false, false, false],
    act: [() => describe()],
    // A structure whose training must be asked for says so on its page.
    trains: true,
    more: h(
      "p",
      { class: "fine" },
      others && "The structures below are examples that are shipped with the program, or yours: their pages go on with the step that comes next. ",
      "Everything is done on these pages; programs do the same over the ",
      h("a", { href: "docs/api" }, "API"),
      ".",
    ),
  });
}
