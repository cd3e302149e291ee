// Formatting of numbers, units and times.

import { h } from "./dom.js";

const MISSING = "–";

const full = new Intl.DateTimeFormat(undefined, {
  year: "numeric",
  month: "short",
  day: "2-digit",
  hour: "2-digit",
  minute: "2-digit",
  hour12: false,
});
const withZone = new Intl.DateTimeFormat(undefined, { timeZoneName: "short" });

/** Short name of the viewer's current time zone. */
export function zone() {
  return withZone.formatToParts(new Date()).find((part) => part.type === "timeZoneName")?.value ?? "local time";
}

/** A time as text in the viewer's zone. */
export function local(time) {
  if (!Number.isFinite(new Date(time).getTime())) return MISSING;
  return full.format(new Date(time));
}

/** A time in UTC, to the second. */
export function utc(time) {
  return `${new Date(time).toISOString().slice(0, 19).replace("T", " ")} UTC`;
}

/** A `<time>` element with the local time; its tooltip shows UTC. */
export function timeElement(time) {
  if (!time) return h("span", null, MISSING);
  return h("time", { datetime: new Date(time).toISOString(), title: utc(time) }, local(time));
}

/** A `<time>` element with the time relative to now, such as "5 minutes ago"; `refreshAges` keeps it up to date. */
export function age(time) {
  if (!time) return h("span", null, "never");
  const iso = new Date(time).toISOString();
  return h("time", { datetime: iso, title: `${local(time)} (${utc(time)})`, dataset: { age: iso } }, ago(time));
}

export function refreshAges() {
  for (const element of document.querySelectorAll("[data-age]")) {
    const text = ago(element.dataset.age);
    if (element.textContent !== text) element.textContent = text;
  }
}

const STEPS = [
  ["year", 31557600],
  ["month", 2629800],
  ["day", 86400],
  ["hour", 3600],
  ["minute", 60],
];

function ago(time) {
  const seconds = (Date.now() - new Date(time)) / 1000;
  const [name, length] = STEPS.find(([, length]) => Math.abs(seconds) >= length) ?? ["second", 1];
  if (name === "second") return seconds < -1 ? "in the future" : "just now";
  const count = Math.round(Math.abs(seconds) / length);
  const words = `${count} ${name}${count === 1 ? "" : "s"}`;
  return seconds < 0 ? `in ${words}` : `${words} ago`;
}

/** A number rounded to `digits` significant digits. */
export function number(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return MISSING;
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e6)) {
    const [mantissa, exponent] = value.toExponential(digits - 1).split("e");
    return minus(`${Number(mantissa)}·10${[...String(Number(exponent))].map((c) => SUPERSCRIPT[c]).join("")}`);
  }
  return minus(String(Number(value.toPrecision(digits))));
}

const SUPERSCRIPT = Object.fromEntries([..."0123456789-"].map((c, i) => [c, "⁰¹²³⁴⁵⁶⁷⁸⁹⁻"[i]]));

const PREFIXES = { "-2": "µ", "-1": "m", 0: "", 1: "k", 2: "M", 3: "G", 4: "T" };

/**
 * The unit in which numbers of about `size` are easy to read, `{unit, factor}`: 3·10⁷ N/m are 30 MN/m. Only units that begin with newton
 * or pascal take a prefix. The condition report has the same rule (`readable` in `page.rs`); both are tested by `tests/units.json`.
 */
export function scale(unit, size) {
  const plain = { unit: unit && unit !== "1" ? unit : "", factor: 1 };
  if (!/^(N|Pa)(\b|·|\/|$)/.test(unit ?? "") || !Number.isFinite(size) || size === 0) return plain;
  const power = Math.min(4, Math.max(-2, Math.floor(Math.log10(Math.abs(size)) / 3 + 1e-9)));
  return { unit: `${PREFIXES[power]}${unit}`, factor: 10 ** (-3 * power) };
}

/** A number with its unit. */
export function quantity(value, unit, digits) {
  if (value === null || value === undefined || !Number.isFinite(value)) return MISSING;
  const { unit: shown, factor } = scale(unit, value);
  return shown ? `${number(factor * value, digits)} ${shown}` : number(value, digits);
}

/** The difference of a value from a reference in per cent of the reference; values of the unit `ln` are logarithms of factors. */
export function changePercent(value, reference, unit) {
  if (unit === "ln") return 100 * Math.expm1(value - reference);
  return 100 * (value / reference - 1);
}

/** A probability in per cent; values close to 0 or 1 are not rounded to 0 % or 100 %. */
export function percent(probability) {
  if (probability === null || probability === undefined || !Number.isFinite(probability)) return MISSING;
  const value = 100 * probability;
  if (value > 0 && value < 0.1) return "< 0.1 %";
  if (value < 100 && value > 99.9) return "> 99.9 %";
  return `${value < 10 ? Number(value.toFixed(1)) : Math.round(value)} %`;
}

/** A probability with its interval. */
export function percentWithin(probability, low, high) {
  const interval = Number.isFinite(low) && Number.isFinite(high) && low !== null && high !== null;
  return interval ? `${percent(probability)} (${percent(low)} to ${percent(high)})` : percent(probability);
}

/** What a number of measurements is worth, where it is fewer: `, worth 12 independent ones`. */
export function worth(effective, all) {
  return Number.isFinite(effective) && effective !== null && effective < 0.995 * all
    ? `, worth ${Number(effective.toFixed(effective < 10 ? 1 : 0))} independent ones`
    : "";
}

/** `snake_case` as words. */
export function words(code) {
  const text = String(code).replaceAll("_", " ");
  return text.charAt(0).toUpperCase() + text.slice(1);
}

/** A text with a capital letter at its beginning. */
export function sentence(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

/** A number as text with the sign of minus instead of a hyphen. */
function minus(text) {
  return text.replace("-", "−");
}

/** The first digits of a digest; the tooltip shows all of them. */
export function digest(value) {
  return value ? h("code", { title: value }, value.slice(0, 12)) : h("span", null, MISSING);
}

/**
 * The name of a monitored quantity as people read it: `spring:k12`, a stiffness that follows from a parameter by a law, is the
 * “stiffness of spring k12”; `group:k1+k2`, parameters that the measurements cannot tell apart, is “k1 and k2 together”.
 */
export function inWords(quantity) {
  if (quantity?.startsWith("spring:")) return `stiffness of spring ${quantity.slice(7)}`;
  if (quantity?.startsWith("group:")) return `${quantity.slice(6).replaceAll("+", " and ")} together`;
  return quantity;
}

/** `1 batch`, `2 batches`. */
export function count(n, one, many = `${one}s`) {
  return `${n} ${n === 1 ? one : many}`;
}
