// Help at a term: a button “?” that shows the first paragraph of its entry in the glossary of the documentation, with a link to it.
// `docs/glossary.md` is the only source of these texts.

import { fill, h } from "./dom.js";

const PAGE = "docs/glossary";

/** The anchor of a heading in the documentation. */
const anchorOf = (term) => term.toLowerCase().replaceAll(" ", "-");

let glossary = null;

/** The first paragraph of each entry by its anchor; read once, when the first help is opened. */
function entries() {
  glossary ??= fetch(PAGE)
    .then((answer) => (answer.ok ? answer.text() : Promise.reject(new Error(`HTTP status ${answer.status}`))))
    .then((html) => {
      const page = new DOMParser().parseFromString(html, "text/html");
      const found = [...page.querySelectorAll("h3[id]")].map((title) => [title.id, title.nextElementSibling?.textContent]);
      return new Map(found);
    })
    .catch((error) => {
      glossary = null;
      throw error;
    });
  return glossary;
}

let openOne = null;

/** Closes the help that is open. */
function closeHelp(focus = false) {
  const one = openOne;
  openOne = null;
  if (!one) return;
  one.text.remove();
  one.button.setAttribute("aria-expanded", "false");
  if (focus) one.button.focus();
}
document.addEventListener("keydown", (event) => {
  if (event.key !== "Escape" || !openOne) return;
  // The dialog around the help stays open.
  event.preventDefault();
  closeHelp(true);
});
document.addEventListener("click", (event) => {
  if (openOne && !openOne.place.contains(event.target)) closeHelp();
});
window.addEventListener("hashchange", () => closeHelp());

/** Moves the text into the window: it is as wide as a card and its term may be at the right edge. */
function placeText(text) {
  text.style.left = "0";
  const { left, right } = text.getBoundingClientRect();
  const edge = document.documentElement.clientWidth - 8;
  text.style.left = `${Math.max(8 - left, Math.min(0, edge - right))}px`;
}

/** A button with the help for a term, which must be a heading of the glossary. */
export function help(term) {
  const button = h(
    "button",
    { type: "button", class: "help", "aria-label": `What is “${term}”?`, "aria-expanded": "false", onclick: () => toggle() },
    "?",
  );
  const place = h("span", { class: "help-place", dataset: { term } }, button);
  async function toggle() {
    const own = openOne?.button === button;
    closeHelp();
    if (own) return;
    const link = `${PAGE}#${anchorOf(term)}`;
    const words = h("span", null, "…");
    const text = h(
      "span",
      { class: "help-text", role: "status" },
      h("strong", null, term.charAt(0).toUpperCase() + term.slice(1)),
      words,
      h("a", { href: link, target: "_blank", rel: "noopener" }, "More in the glossary"),
    );
    openOne = { button, place, text };
    button.setAttribute("aria-expanded", "true");
    place.append(text);
    placeText(text);
    const found = await entries().catch(() => null);
    fill(words, found?.get(anchorOf(term)) ?? "The glossary cannot be read at the moment.");
    placeText(text);
  }
  return place;
}
