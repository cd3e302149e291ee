// Entry point of the page: header, routing, sign-in, and the server events that update the view.

import { ApiError, keepToken, onUnauthorized, token } from "./api.js";
import { endCharts } from "./charts/base.js";
import { themeChanged } from "./charts/theme.js";
import { compare } from "./compare.js";
import { condition } from "./condition.js";
import { ask, fill, h, icon, notify, problem } from "./dom.js";
import { follow } from "./events.js";
import { refreshAges } from "./format.js";
import { jobs, showRunning } from "./jobs.js";
import { overview } from "./overview.js";
import { report } from "./report.js";
import { structure } from "./structure.js";

const main = document.getElementById("main");

/** The view that is shown: `{element, title, load(), event(name, data), missed()}`, and `end()` if it must be told that the
 * user has left it. */
let view = null;

const ROUTES = [
  [/^#?\/?$/, "fleet", () => overview()],
  [/^#\/structures\/([^/?]+)(?:\?(.*))?$/, "fleet", (id, query) => structure(id, new URLSearchParams(query))],
  [/^#\/structures\/([^/?]+)\/report(?:\?(.*))?$/, "fleet", (id, query) => condition(id, new URLSearchParams(query))],
  [/^#\/compare(?:\?(.*))?$/, "compare", (query) => compare(new URLSearchParams(query))],
  [/^#\/diagnoses\/([^/]+)$/, "fleet", (id) => report(id)],
  [/^#\/jobs$/, "jobs", () => jobs()],
];

async function route() {
  const [pattern, name, open] = ROUTES.find(([pattern]) => pattern.test(location.hash)) ?? [];
  document.querySelectorAll("[data-view]").forEach((link) => {
    if (link.dataset.view === name) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  });
  view?.end?.();
  endCharts();
  if (!open) {
    view = null;
    fill(
      main,
      h("h1", null, "Page not found"),
      h(
        "p",
        null,
        "This address does not belong to any page of the dashboard. ",
        h("a", { href: "#/" }, "Go to the fleet"),
      ),
    );
    return;
  }
  const opened = open(...location.hash.match(pattern).slice(1).map((part) => part && (part.includes("=") ? part : decodeURIComponent(part))));
  view = opened;
  document.title = `${opened.title} – modalwatch`;
  fill(main, h("p", { class: "loading" }, "Loading…"));
  window.scrollTo(0, 0);
  try {
    await opened.load();
    if (view === opened) fill(main, opened.element);
  } catch (error) {
    // An error in this code, not in an answer of the service, is also written to the console.
    if (!(error instanceof ApiError)) console.error(error);
    if (view === opened) fill(main, h("h1", null, opened.title), problem(error, route));
  }
}

window.addEventListener("hashchange", () => {
  // Keyboard and screen reader users start at the top of a new view as well.
  route().then(() => main.focus({ preventScroll: true }));
});

document.getElementById("skip").addEventListener("click", (event) => {
  event.preventDefault();
  main.focus();
});

// Colour theme: the setting of the operating system, or the choice of the user.
const THEMES = [
  ["auto", "auto", "system setting"],
  ["light", "sun", "light"],
  ["dark", "moon", "dark"],
];
const themeButton = document.getElementById("theme");
function showTheme(choice) {
  const [name, sign, words] = THEMES.find(([name]) => name === choice) ?? THEMES[0];
  if (name === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = name;
  fill(themeButton, icon(sign));
  themeButton.setAttribute("aria-label", `Colours: ${words}`);
  themeButton.title = `Colours: ${words}`;
  themeChanged();
}
themeButton.addEventListener("click", () => {
  const now = THEMES.findIndex(([name]) => name === (localStorage.getItem("modalwatch.theme") ?? "auto"));
  const next = THEMES[(now + 1) % THEMES.length][0];
  localStorage.setItem("modalwatch.theme", next);
  showTheme(next);
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", themeChanged);
showTheme(localStorage.getItem("modalwatch.theme"));

// Sign-in: the user is asked for a token once, if the service requires one.
let asking = null;
const signButton = document.getElementById("sign");
/** Whether the service has asked for a token; without that, the sign-in button stays hidden. */
let needsToken = false;
function showSign() {
  signButton.hidden = !needsToken && !token();
  fill(signButton, token() ? "Sign out" : "Sign in");
}
function askForToken(error) {
  needsToken = true;
  showSign();
  asking ??= ask({
    title: "Sign in",
    body: h(
      "p",
      null,
      error && token() ? "The service did not accept the token stored in this tab. " : "",
      "Enter an API token (mw_…) of this service. It is stored in this tab only and deleted when the tab is closed.",
    ),
    fields: [{ name: "token", label: "Token", type: "password", required: true, autocomplete: "current-password" }],
    confirm: "Sign in",
    submit: ({ token: given }) => keepToken(given.trim()),
  }).finally(() => (asking = null));
  return asking.then(Boolean);
}
onUnauthorized(askForToken);
signButton.addEventListener("click", async () => {
  if (token()) {
    keepToken(null);
    notify("Signed out. The token has been deleted from this tab.");
    route();
  } else if (await askForToken(null)) route();
});
window.addEventListener("token", showSign);
showSign();

// Live updates from the service.
const live = document.getElementById("live");
const LIVE = { connecting: "Connecting", live: "Live", reconnecting: "Reconnecting", "signed-out": "Signed out" };
follow("v1/events", {
  state: (state) => {
    if (live.dataset.state === state) return;
    live.dataset.state = state;
    fill(live, LIVE[state]);
  },
  event: (name, data) => {
    if (name === "job") showRunning();
    // The service sends `resync` to a client that has missed events because it read them too slowly.
    if (name === "resync") view?.missed?.();
    else view?.event?.(name, data);
  },
  missed: () => {
    showRunning();
    view?.missed?.();
  },
});
fill(live, LIVE[live.dataset.state]);

setInterval(refreshAges, 20000);
route().then(showRunning);
