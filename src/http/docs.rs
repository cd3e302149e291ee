//! `/docs/…`: the Markdown pages of `docs/`, embedded in the program and rendered to plain HTML, with their images.
//!
//! The interactive API page is `/docs/api-explorer/` ([`super::explorer`]). Until version 0.1 its files were directly below `/docs/`;
//! those addresses are redirected.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::LazyLock;

use axum::body::Bytes;
use axum::extract::Path;
use axum::http::{header, HeaderName, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::Router;
use pulldown_cmark::{html, Alignment, CowStr, Event, Options, Parser, Tag, TagEnd};
use utoipa::openapi::OpenApi;

use super::error::ApiError;
use super::explorer;

#[derive(rust_embed::Embed)]
#[folder = "docs/"]
struct Files;

/// The page that `/docs/` shows.
const INDEX: &str = "README";

/// Headers of every page and image. The pages have no scripts; their policy is that of the API explorer.
const HEADERS: [(HeaderName, &str); 3] = [
    (header::CONTENT_SECURITY_POLICY, explorer::POLICY),
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::CACHE_CONTROL, "no-cache"),
];

/// The rendered pages by their name without `.md`.
static PAGES: LazyLock<BTreeMap<String, Bytes>> = LazyLock::new(|| {
    let rendered = |file: &str| {
        let name = file.strip_suffix(".md")?.to_owned();
        let markdown = Files::get(file)?.data;
        let html = page(&name, &String::from_utf8_lossy(&markdown));
        Some((name, Bytes::from(html)))
    };
    Files::iter().filter_map(|file| rendered(&file)).collect()
});

/// The routes below `/docs`, those of the API explorer and `/openapi.json`.
pub fn router<S: Clone + Send + Sync + 'static>(document: &OpenApi) -> Router<S> {
    Router::new()
        .route("/docs", get(|| async { (StatusCode::PERMANENT_REDIRECT, [(header::LOCATION, "docs/")]) }))
        .route("/docs/", get(|| async { file(INDEX) }))
        .route("/docs/{file}", get(|Path(name): Path<String>| async move { file(&name) }))
        .merge(explorer::router(document))
}

/// A page, an image, or a redirect from an earlier address.
fn file(name: &str) -> Result<Response, ApiError> {
    if let Some(page) = PAGES.get(name) {
        let content_type = (header::CONTENT_TYPE, "text/html; charset=utf-8");
        return Ok((HEADERS, [content_type], page.clone()).into_response());
    }
    let image = name.rsplit_once('.').and_then(|(_, ending)| image_type(ending));
    if let Some((content_type, image)) = image.zip(Files::get(name)) {
        return Ok((HEADERS, [(header::CONTENT_TYPE, content_type)], image.data).into_response());
    }
    let elsewhere = match name.strip_suffix(".md") {
        Some(page) if PAGES.contains_key(page) => Some(page.to_owned()),
        _ if explorer::has(name) => Some(format!("api-explorer/{name}")),
        _ => None,
    };
    let unknown = || ApiError::new(StatusCode::NOT_FOUND, "unknown_route", "the documentation has no such page");
    let location = [(header::LOCATION, elsewhere.ok_or_else(unknown)?)];
    Ok((StatusCode::PERMANENT_REDIRECT, location).into_response())
}

/// Content type of an image by the ending of its name.
fn image_type(ending: &str) -> Option<&'static str> {
    match ending {
        "png" => Some("image/png"),
        "svg" => Some("image/svg+xml"),
        _ => None,
    }
}

/// Renders a complete HTML page from its Markdown. All addresses in it are relative, so that it also works behind a
/// proxy that adds a prefix.
fn page(name: &str, markdown: &str) -> String {
    let mut events: Vec<Event<'_>> =
        Parser::new_ext(markdown, Options::ENABLE_TABLES).filter(|event| !is_raw_html(event)).collect();
    let title = add_anchors(&mut events).unwrap_or_else(|| name.to_owned());
    let mut body = String::new();
    html::push_html(&mut body, events.into_iter().scan(false, |outside, event| Some(adapt(event, outside))).flatten());
    let mut escaped = String::new();
    html::push_html(&mut escaped, std::iter::once(Event::Text(title.into())));
    format!(
        r#"<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{escaped} · modalwatch</title>
<link rel="icon" href="../assets/icon.svg" type="image/svg+xml">
<link rel="stylesheet" href="../assets/base.css">
<link rel="stylesheet" href="../assets/docs.css">
</head>
<body>
<header><nav aria-label="Documentation">
<a href="./">Documentation</a> <a href="api-explorer/">API explorer</a> <a href="../">Dashboard</a>
</nav></header>
<main>
{body}</main>
</body>
</html>
"#
    )
}

/// Whether an event is raw HTML of the source, such as a comment. Raw HTML is left out: the pages contain none that a
/// reader should see.
fn is_raw_html(event: &Event<'_>) -> bool {
    matches!(
        event,
        Event::Html(_) | Event::InlineHtml(_) | Event::Start(Tag::HtmlBlock) | Event::End(TagEnd::HtmlBlock)
    )
}

/// Gives each heading the anchor that code hosts give it; returns the text of the first heading.
fn add_anchors(events: &mut [Event<'_>]) -> Option<String> {
    let (mut title, mut taken) = (None, BTreeSet::new());
    let mut heading: Option<(usize, String)> = None;
    for index in 0..events.len() {
        match &events[index] {
            Event::Start(Tag::Heading { .. }) => heading = Some((index, String::new())),
            Event::Text(text) | Event::Code(text) => {
                if let Some((_, words)) = &mut heading {
                    words.push_str(text);
                }
            }
            Event::End(TagEnd::Heading(_)) => {
                let Some((start, words)) = heading.take() else { continue };
                let anchor = unused(&anchor(&words), &mut taken);
                if let Event::Start(Tag::Heading { id, .. }) = &mut events[start] {
                    *id = Some(CowStr::from(anchor));
                }
                title = title.or(Some(words));
            }
            _ => {}
        }
    }
    title
}

/// The words of a heading in lower case, joined by hyphens, without punctuation.
fn anchor(words: &str) -> String {
    let kept = words.trim().chars().filter(|c| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_'));
    kept.flat_map(char::to_lowercase).map(|c| if c == ' ' { '-' } else { c }).collect()
}

/// The anchor; with a number appended if an earlier heading has the same anchor.
fn unused(anchor: &str, taken: &mut BTreeSet<String>) -> String {
    let numbered = (1..).map(|n| format!("{anchor}-{n}"));
    let free = std::iter::once(anchor.to_owned()).chain(numbered).find(|candidate| !taken.contains(candidate));
    let free = free.expect("there is always a further number");
    taken.insert(free.clone());
    free
}

/// Converts an event of the Markdown into those of the page. `outside` is true while the events are inside a link that
/// leaves `docs/`.
fn adapt<'a>(event: Event<'a>, outside: &mut bool) -> Vec<Event<'a>> {
    match event {
        // The program serves no other files of the repository: the text of such a link stays, without the link.
        Event::Start(Tag::Link { dest_url, .. }) if dest_url.starts_with("../") => {
            *outside = true;
            Vec::new()
        }
        Event::End(TagEnd::Link) if std::mem::take(outside) => Vec::new(),
        Event::Start(Tag::Link { link_type, dest_url, title, id }) => {
            let dest_url = served(&dest_url).into();
            vec![Event::Start(Tag::Link { link_type, dest_url, title, id })]
        }
        // Alignment would become inline styles, which the content security policy forbids. Wide tables scroll by themselves.
        Event::Start(Tag::Table(columns)) => {
            let plain = vec![Alignment::None; columns.len()];
            vec![Event::Html(r#"<div class="scroll" tabindex="0">"#.into()), Event::Start(Tag::Table(plain))]
        }
        Event::End(TagEnd::Table) => vec![Event::End(TagEnd::Table), Event::Html("</div>\n".into())],
        other => vec![other],
    }
}

/// The address of a linked page in the program: `alarms.md#trust` on disk is `alarms#trust` here.
fn served(link: &str) -> String {
    if link.contains("://") {
        return link.to_owned();
    }
    let (path, anchor) = link.split_once('#').map_or((link, None), |(path, anchor)| (path, Some(anchor)));
    let page = match path.strip_suffix(".md") {
        Some(INDEX) => "./",
        Some(page) => page,
        None => path,
    };
    anchor.map_or_else(|| page.to_owned(), |anchor| format!("{page}#{anchor}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_between_pages_lose_their_ending_and_links_out_of_the_folder_become_text() {
        let text = "# A & B\n\n[one](alarms.md#trust) [two](../models/README.md) [three](https://example.org/a.md) [four](README.md)";
        let html = page("x", text);
        for expected in [
            r#"<h1 id="a--b">A &amp; B</h1>"#,
            "<title>A &amp; B · modalwatch</title>",
            r#"<a href="alarms#trust">one</a> two <a href="https://example.org/a.md">three</a> <a href="./">four</a>"#,
        ] {
            assert!(html.contains(expected), "{expected} is not in {html}");
        }
    }

    #[test]
    fn nothing_in_a_page_is_inline_script_or_style() {
        let html = page("x", "# x\n\n<script>alert(1)</script>\n\n<!-- note -->\n\n| a |\n|---:|\n| 1 |\n\n## x\n");
        assert!(!html.contains("<script") && !html.contains("style=") && !html.contains("note"), "{html}");
        assert!(html.contains(r#"<h2 id="x-1">"#), "{html}");
    }
}
