//! The page of a reproduction: complete, self-contained, and as wide as the screen that shows it.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use modalwatch::reproduce::report::html;
use modalwatch::reproduce::{Case, Reproduction};
use tempfile::TempDir;

use crate::needs;
use crate::reproduce::fake;

/// Tables and figures of both cases.
const IDS: [&str; 21] = [
    "table3", "table4", "table5", "table6", "table8", "table9", "table10", "fig8", "fig9", "fig10", "fig11", "fig12",
    "fig13", "fig14", "fig16", "fig17", "fig18", "fig19", "fig20", "fig21", "fig22",
];

/// Number of elements with an id.
fn given(page: &str, id: &str) -> usize {
    page.matches(&format!(" id=\"{id}\"")).count()
}

/// Words and numbers of the page, tags included.
fn words(page: &str) -> impl Iterator<Item = &str> {
    page.split(|c: char| !c.is_alphanumeric())
}

#[test]
fn every_table_and_figure_of_the_paper_is_there_once() {
    let page = html(&fake::reproduction(1));
    for id in IDS {
        assert_eq!(given(&page, id), 1, "{id}");
    }
    let links = page.split("href=\"#").skip(1).map(|rest| rest.split('"').next().unwrap());
    for link in links {
        assert_eq!(given(&page, link), 1, "a link to {link}");
    }
    let figures = page.matches("<figure").count();
    assert_eq!((figures, page.matches("<figcaption").count()), (14, 14));
    let panels = page.matches("<svg class=\"panel\" role=\"img\" aria-label=\"").count();
    assert_eq!(panels, 3 + 3 + 3 + 9 + 9 + 9 + 3 + 1 + 1 + 2 + 2 + 2 + 2 + 2);
}

#[test]
fn the_page_is_self_contained_and_all_its_numbers_are_finite() {
    let page = html(&fake::reproduction(2));
    assert!(!words(&page).any(|word| ["NaN", "inf", "None"].contains(&word)));
    assert!(!page.contains("<script") && !page.contains("javascript:") && !page.contains("@import"));
    let elsewhere = page.replace("http://www.w3.org/2000/svg", "");
    assert!(!elsewhere.contains("http://") && !elsewhere.contains("https://") && !elsewhere.contains("url("));
    assert!(page.contains("Fake &lt;CPU&gt; &amp; co.") && page.contains("50 draws &lt;of&gt; a distribution"));
}

#[test]
fn a_case_that_was_not_run_is_left_out() {
    let page = html(&Reproduction { case2: None, ..fake::reproduction(3) });
    assert!(given(&page, "fig14") == 1 && given(&page, "fig16") == 0 && !page.contains("href=\"#fig16\""));
    let nothing = html(&Reproduction { case1: None, case2: None, ..fake::reproduction(3) });
    assert!(nothing.contains("<h1>") && !nothing.contains("<figure"));
}

#[test]
fn a_case_without_data_or_with_infinite_ones_is_still_a_page() {
    let mut broken = fake::reproduction(4);
    let bare =
        |case: &Case| Case { accuracy: Vec::new(), states: Vec::new(), methods: Vec::new(), rig: None, ..case.clone() };
    broken.case2 = broken.case2.as_ref().map(bare);
    let case1 = broken.case1.as_mut().unwrap();
    for row in case1.table3.iter_mut().chain(&mut case1.table4) {
        (row.mean.ours.median, row.std.ours.high, row.std.target) = (f64::NAN, f64::INFINITY, 0.0);
    }
    for quantity in case1.states.iter_mut().flat_map(|s| &mut s.quantities) {
        quantity.samples.fill(f64::NAN);
        quantity.threshold = f64::NAN;
    }
    case1.accuracy[0].estimate[0] = f64::INFINITY;
    let page = html(&broken);
    assert!(!words(&page).any(|word| ["NaN", "inf"].contains(&word)));
    assert!(IDS.iter().all(|id| given(&page, id) == 1 || *id == "fig17"));
}

/// Runs Chromium without a window.
fn chromium(home: &Path, arguments: &[&str], file: &Path) -> Output {
    let mut command = Command::new("chromium");
    command.args([
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--enable-logging=stderr",
        "--v=0",
        "--hide-scrollbars",
    ]);
    command.arg(format!("--user-data-dir={}", home.join("profile").display()));
    command.args(arguments).arg(format!("file://{}", file.display())).output().unwrap()
}

/// Opens collapsed sections and reports the width of this page to its parent.
const MEASURE: &str = "<script>document.querySelectorAll('details').forEach(d => d.open = true);\
    const empty = [...document.querySelectorAll('svg')].filter(s => { const b = s.getBoundingClientRect();\
    return b.width === 0 || b.height === 0; }).length;\
    const texts = [...document.querySelectorAll('svg.panel text')];\
    const small = texts.filter(t => Math.min(t.getBoundingClientRect().height, t.getBoundingClientRect().width) === 0\
    || parseFloat(t.getAttribute('font-size')) * t.getScreenCTM().d < 11 && !t.hasAttribute('transform')).length;\
    const wide = document.documentElement.scrollWidth;\
    parent.postMessage(`scroll=${wide} inner=${innerWidth} empty=${empty} small=${small}`, '*');\
    </script>";

/// A page that shows another in a frame of a given width, because a window of Chromium is never narrower than 500 px.
fn framed(page: &Path, width: u32) -> String {
    format!(
        "<!doctype html><title>waiting</title><script>onmessage = e => document.title = e.data</script>\
         <iframe src=\"file://{}\" width=\"{width}\" height=\"800\" style=\"border:0\"></iframe>",
        page.display()
    )
}

#[test]
fn in_a_browser_the_page_never_scrolls_sideways_and_every_drawing_has_a_size() {
    if needs::program("chromium").is_none() {
        return;
    }
    let folder = TempDir::new().unwrap();
    let home = folder.path();
    let page = html(&fake::reproduction(5));
    let measuring = home.join("measuring.html");
    fs::write(&measuring, page.replace("</body>", &format!("{MEASURE}</body>"))).unwrap();
    fs::write(home.join("report.html"), &page).unwrap();
    for width in [390, 1200] {
        let frame = home.join(format!("frame-{width}.html"));
        fs::write(&frame, framed(&measuring, width)).unwrap();
        let arguments = ["--dump-dom", "--virtual-time-budget=5000", "--window-size=1300,900"];
        let output = chromium(home, &arguments, &frame);
        let log = String::from_utf8_lossy(&output.stderr);
        assert!(!log.contains("CONSOLE"), "at {width} px: {log}");
        let dom = String::from_utf8_lossy(&output.stdout);
        let title = dom.split("<title>").nth(1).and_then(|rest| rest.split("</title>").next()).unwrap_or_default();
        assert_eq!(title, format!("scroll={width} inner={width} empty=0 small=0"), "{log}");
        let picture = format!("--screenshot={}", home.join(format!("report-{width}.png")).display());
        chromium(home, &[&picture, "--window-size=1300,900"], &frame);
    }
}
