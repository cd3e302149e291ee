//! The documentation: every page is served, every link leads somewhere, on disk and in the program.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::helpers::{problem, spawn};

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// Names of the pages in `docs/`, without `.md`.
fn pages() -> Vec<String> {
    let entries = std::fs::read_dir(root().join("docs")).unwrap();
    let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let pages: Vec<String> = names.filter_map(|name| name.strip_suffix(".md").map(str::to_owned)).collect();
    assert!(pages.len() >= 10, "{pages:?}");
    pages
}

/// Markdown without its code blocks and code spans.
fn prose(markdown: &str) -> String {
    let outside = markdown.split("```").step_by(2).collect::<String>();
    outside.lines().map(|line| line.split('`').step_by(2).collect::<String>() + "\n").collect()
}

/// Targets of the links and images of a Markdown text.
fn links(markdown: &str) -> Vec<String> {
    let prose = prose(markdown);
    prose.split("](").skip(1).map(|rest| rest[..rest.find(')').unwrap()].to_owned()).collect()
}

/// Anchors of the headings of a Markdown text, as code hosts make them.
fn anchors(markdown: &str) -> BTreeSet<String> {
    let outside = markdown.split("```").step_by(2).collect::<String>();
    let headings = outside.lines().filter(|line| line.starts_with('#')).map(|line| line.trim_start_matches('#').trim());
    let anchor = |heading: &str| {
        let kept = heading.to_lowercase().replace('`', "");
        kept.chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c)).collect::<String>().replace(' ', "-")
    };
    headings.map(anchor).collect()
}

fn assert_links_lead_somewhere(file: &Path) {
    let text = std::fs::read_to_string(file).unwrap();
    for link in links(&text).iter().filter(|link| !link.contains("://")) {
        let (path, anchor) = link.split_once('#').map_or((link.as_str(), None), |(path, anchor)| (path, Some(anchor)));
        let target = if path.is_empty() { file.to_path_buf() } else { file.parent().unwrap().join(path) };
        assert!(target.exists(), "{} links to {link}, which does not exist", file.display());
        if let Some(anchor) = anchor {
            let headings = anchors(&std::fs::read_to_string(&target).unwrap());
            assert!(headings.contains(anchor), "{} links to {link}; the headings are {headings:?}", file.display());
        }
    }
}

#[test]
fn every_relative_link_leads_to_a_file_or_a_heading() {
    for name in
        ["README.md", "CONTRIBUTING.md", "benches/README.md", "docker/README.md", "models/README.md", "tests/README.md"]
    {
        assert_links_lead_somewhere(&root().join(name));
    }
    for page in pages() {
        assert_links_lead_somewhere(&root().join(format!("docs/{page}.md")));
    }
}

#[test]
fn every_page_is_listed_in_the_index_and_the_readme_fits_150_lines() {
    let index = std::fs::read_to_string(root().join("docs/README.md")).unwrap();
    for page in pages().iter().filter(|page| *page != "README") {
        assert!(index.contains(&format!("({page}.md)")), "docs/README.md does not list {page}.md");
    }
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    assert!(readme.lines().count() <= 150, "README.md has {} lines", readme.lines().count());
}

#[tokio::test]
async fn every_page_and_its_links_are_served_under_the_strict_policy() {
    let (service, _folder) = spawn();
    let mut paths: BTreeSet<String> = pages().into_iter().map(|page| format!("/docs/{page}")).collect();
    paths.insert("/docs/".to_owned());
    let mut linked = BTreeSet::new();
    for path in &paths {
        let answer = service.get(path).send().await.unwrap();
        assert_eq!(answer.status(), 200, "{path}");
        assert_eq!(answer.headers()["content-type"], "text/html; charset=utf-8", "{path}");
        let policy = answer.headers()["content-security-policy"].to_str().unwrap().to_owned();
        assert!(policy.contains("default-src 'none'") && !policy.contains("unsafe"), "{path}: {policy}");
        assert_eq!(answer.headers()["x-content-type-options"], "nosniff", "{path}");
        let html = answer.text().await.unwrap();
        assert!(html.contains("<h1 id="), "{path} has no title");
        assert!(!html.contains("<script") && !html.contains("style="), "{path} has an inline script or style");
        for target in ["href=\"", "src=\""].iter().flat_map(|key| html.split(key).skip(1)) {
            let target = &target[..target.find('"').unwrap()];
            if !target.contains("://") && !target.starts_with('#') {
                linked.insert(target.split('#').next().unwrap().to_owned());
            }
        }
    }
    assert!(
        linked.contains("alarms") && linked.contains("api-explorer/") && linked.contains("dashboard.png"),
        "{linked:?}"
    );
    for target in linked {
        let answer = service.get(&format!("/docs/{target}")).send().await.unwrap();
        assert_eq!(answer.status(), 200, "/docs/{target}");
    }
}

#[tokio::test]
async fn earlier_addresses_are_redirected_and_unknown_ones_are_not_found() {
    let (service, _folder) = spawn();
    for (earlier, now) in [
        ("/docs", "/docs/"),
        ("/docs/alarms.md", "/docs/alarms"),
        ("/docs/api-explorer", "/docs/api-explorer/"),
        ("/docs/index.html", "/docs/api-explorer/index.html"),
        ("/docs/swagger-ui.css", "/docs/api-explorer/swagger-ui.css"),
    ] {
        // The client follows redirects.
        let answer = service.get(earlier).send().await.unwrap();
        assert_eq!((answer.status().as_u16(), answer.url().path()), (200, now), "{earlier}");
    }
    for unknown in ["/docs/nothing", "/docs/nothing.png", "/docs/nothing.md"] {
        problem(service.get(unknown).send().await.unwrap(), 404, "unknown_route").await;
    }
}

/// Text of all files below a folder with this ending.
fn sources(folder: &Path, ending: &str, text: &mut String) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, ending, text);
        } else if path.extension().is_some_and(|found| found == ending) {
            *text += &std::fs::read_to_string(path).unwrap();
        }
    }
}

/// A limit whose setting was renamed, or whose test is gone, is a promise that nobody keeps.
#[test]
fn the_limits_of_the_security_page_name_settings_and_tests_that_exist() {
    let page = std::fs::read_to_string(root().join("docs/security.md")).unwrap();
    let settings: toml::Table =
        toml::from_str(&std::fs::read_to_string(root().join("src/config.default.toml")).unwrap()).unwrap();
    let is_setting = |key: &str| {
        let mut place = Some(&settings);
        let (sections, name) = key.rsplit_once('.').unwrap_or(("", key));
        for section in sections.split('.') {
            place = place.and_then(|table| table.get(section)).and_then(toml::Value::as_table);
        }
        place.is_some_and(|table| table.contains_key(name))
    };
    let mut code = String::new();
    sources(&root().join("src"), "rs", &mut code);
    sources(&root().join("crates"), "rs", &mut code);
    sources(&root().join("tests"), "rs", &mut code);
    let of = |cell: &str| cell.split('`').skip(1).step_by(2).map(str::to_owned).collect::<Vec<_>>();
    let limits = page.split("\n## Limits").nth(1).unwrap().split("\n## ").next().unwrap();
    let mut rows = 0;
    for row in limits.lines().filter(|line| line.starts_with("| ") && !line.starts_with("| limit")) {
        let cells: Vec<&str> = row.trim_matches('|').split('|').collect();
        let [_, number, setting, test] = cells[..] else { panic!("{row}") };
        assert!(!number.trim().is_empty() && !of(setting).is_empty() && !of(test).is_empty(), "{row}");
        for setting in of(setting) {
            let is_there = if setting.contains('/') { root().join(&setting).is_file() } else { is_setting(&setting) };
            assert!(is_there, "no setting or file {setting}: {row}");
        }
        for test in of(test) {
            let is_there =
                if test.contains('/') { root().join(&test).is_file() } else { code.contains(&format!("fn {test}(")) };
            assert!(is_there, "no test {test}: {row}");
        }
        rows += 1;
    }
    assert!(rows >= 25, "{rows} limits: the test reads the page wrongly");
}
