// The page: header, routes, the sign-in, and events that bring views up to date.

import { ApiError, keepToken, onUnauthorized, token } from "./api.js";
import { endCharts } from "./charts/base.js";
import { themeChanged } from "./charts/theme.js";
import { ask, fill, h, icon, notify, problem } from "./dom.js";
import { follow } from "./events.js";
import { refreshAges } from "./format.js";
import { jobs, showRunning } from "./jobs.js";
import { overview } from "./overview.js";
import { report } from "./report.js";
import { structure } from "./structure.js";

const main = document.getElementById("main");

/** The view on the page: `{element, title, load(), event(name, data), missed()}`, and
 * `end()` where work may be under way. */
let view = null;

const ROUTES = [
  [/^#?\/?$/, "fleet", () => overview()],
  [/^#\/structures\/([^/]+)$/, "fleet", (id) => structure(id)],
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
      h("h1", null, "Nothing here"),
      h("p", null, "This address names no view. ", h("a", { href: "#/" }, "To the fleet")),
    );
    return;
  }
  const opened = open(...location.hash.match(pattern).slice(1).map(decodeURIComponent));
  view = opened;
  document.title = `${opened.title} – modalwatch`;
  fill(main, h("p", { class: "loading" }, "Loading…"));
  window.scrollTo(0, 0);
  try {
    await opened.load();
    if (view === opened) fill(main, opened.element);
  } catch (error) {
    // A mistake of the page itself belongs into the console too.
    if (!(error instanceof ApiError)) console.error(error);
    if (view === opened) fill(main, h("h1", null, opened.title), problem(error, route));
  }
}

window.addEventListener("hashchange", () => {
  // A new view begins at its top, for keyboards and screen readers too.
  route().then(() => main.focus({ preventScroll: true }));
});

document.getElementById("skip").addEventListener("click", (event) => {
  event.preventDefault();
  main.focus();
});

// Colours: as the system, or as chosen.
const THEMES = [
  ["auto", "auto", "as the system"],
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

// The token: asked for once, when the service wants one.
let asking = null;
const signButton = document.getElementById("sign");
/** An open service has nothing to sign in to. */
let wantsToken = false;
function showSign() {
  signButton.hidden = !wantsToken && !token();
  fill(signButton, token() ? "Sign out" : "Sign in");
}
function askForToken(error) {
  wantsToken = true;
  showSign();
  asking ??= ask({
    title: "Sign in",
    body: h(
      "p",
      null,
      error && token() ? "The service did not take the token kept in this tab. " : "",
      "Enter an API token (mw_…) of this service. It stays in this tab and is forgotten when the tab closes.",
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
    notify("Signed out: the token is forgotten.");
    route();
  } else if (await askForToken(null)) route();
});
window.addEventListener("token", showSign);
showSign();

// What happens, as it happens.
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
    // The service tells a client that was too slow for some events.
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
