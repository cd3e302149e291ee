//! The verdict about a structure: the page and the JSON say the same, from the alarm charts alone.

use std::fmt::Write as _;
use std::time::{Duration, Instant};

use rand::{Rng as _, SeedableRng as _};
use rand_distr::StandardNormal;
use serde_json::{json, Value};

use crate::chromium::Page;
use crate::dashboard::{at, turn};
use crate::helpers::{created, eventually, measurements, spawn, within, Service};

const HEALTHY: [f64; 3] = [4.0, 5.0, 6.0];
const DAY_S: usize = 86_400;
const REFERENCE: &str = "/v1/structures/three-dof/reference";

/// The number of pixels of the heat map in the red of alarms.
const RED_PIXELS: &str = "(() => {
    const probe = document.body.appendChild(document.createElement('span'));
    probe.style.color = 'var(--bad)';
    const red = getComputedStyle(probe).color.match(/[0-9.]+/g).slice(0, 3).map(Number);
    probe.remove();
    const canvas = document.querySelector('[data-figure=\"heat\"] canvas');
    const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
    let found = 0;
    for (let i = 0; i < data.length; i += 4)
        if (data[i + 3] === 255 && red.every((value, c) => Math.abs(data[i + c] - value) < 3)) found += 1;
    return found;
})()";

/// Everything on the page that has the colour or the sign of an alarm.
const ALARMING: &str =
    "[...document.querySelectorAll('.bad, .chip.bad')].filter((e) => e.offsetParent !== null).map((e) => e.textContent)";

async fn post(service: &Service, k: [f64; 3], count: usize, day: usize) -> Value {
    service.post_batch("three-dof", &measurements(k, count, day * DAY_S)).await
}

async fn overview(service: &Service) -> Value {
    let all = service.read("/v1/overview").await;
    all["items"].as_array().unwrap().iter().find(|item| item["id"] == "three-dof").unwrap().clone()
}

fn visit(page: &mut Page, service: &Service) {
    page.visit(&at(service, "#/structures/three-dof"));
    page.wait_for("document.querySelector('.lead.verdict') !== null");
}

fn verdict_on(page: &mut Page) -> String {
    page.evaluate("document.querySelector('.lead.verdict').textContent").as_str().unwrap().to_owned()
}

/// Change and interval in a sentence such as `k2 −8.0 % (−10.0 to −6.0 %) …`, in per cent.
fn change_in(sentence: &str, name: &str) -> [f64; 3] {
    let after = sentence.split(&format!("{name} ")).nth(1).unwrap_or_else(|| panic!("{name} is not in: {sentence}"));
    let plain = after.replace('−', "-");
    let numbers = plain.split(|c: char| !(c.is_ascii_digit() || c == '.' || c == '-' || c == '+'));
    let values: Vec<f64> = numbers.filter_map(|text| text.parse().ok()).take(3).collect();
    values.try_into().unwrap_or_else(|_| panic!("no change with an interval: {sentence}"))
}

#[tokio::test(flavor = "multi_thread")]
async fn without_an_undamaged_reference_nothing_is_called_normal() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    for day in 0..3 {
        post(&service, HEALTHY, 10, day).await;
    }
    let item = overview(&service).await;
    assert_eq!(item["state"], "not_judged", "{item}");
    assert!(item["verdict"].as_str().unwrap().contains("no undamaged reference"), "{item}");
    let mut page = Page::open();
    page.visit(&at(&service, ""));
    page.wait_for("document.querySelector('tr[data-structure=three-dof]')?.textContent.includes('Not judged')");
    visit(&mut page, &service);
    assert!(verdict_on(&mut page).contains("no undamaged reference"));
    let text = page.evaluate("document.body.textContent");
    for word in ["Normal", "No alarm:", "all charts inside"] {
        assert!(!text.as_str().unwrap().contains(word), "{word}");
    }
    assert_eq!(page.complaints(), Vec::<String>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_healthy_structure_looks_healthy_although_a_probability_exceeds_that_of_the_reference() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    let mut ids = Vec::new();
    for day in 0..6 {
        ids.push(post(&service, HEALTHY, 20, day).await["batch"].clone());
    }
    created(service.post(REFERENCE, &json!({ "batches": ids })).await).await;
    // One in twenty healthy batches lies so low by chance that its probability of damage is above 5 % beyond doubt; that one shall be the
    // latest.
    let mut found = None;
    for day in 6..60 {
        let [k1, k2, k3] = HEALTHY;
        let low = k1 * (1.0 - 0.005 * (day - 6) as f64);
        if post(&service, [low, k2, k3], 3, day).await["assessment"]["exceeds"] == true {
            found = Some(overview(&service).await);
            break;
        }
    }
    let item = found.expect("a healthy batch with a probability of damage above that of the reference");
    assert_eq!((&item["latest"]["exceeds"], &item["open_alarms"]), (&json!(true), &json!(0)), "{item}");
    assert!(["normal", "pending"].contains(&item["state"].as_str().unwrap()), "{item}");
    let mut page = Page::open();
    page.look("light", 1280);
    page.visit(&at(&service, ""));
    page.wait_for("document.querySelector('tr[data-structure=three-dof] .meter') !== null");
    assert_eq!(page.evaluate(ALARMING), json!([]), "the fleet");
    visit(&mut page, &service);
    page.wait_for("document.querySelector('[data-figure=\"heat\"] canvas') !== null");
    assert_eq!(verdict_on(&mut page).trim(), item["verdict"].as_str().unwrap());
    assert_eq!(page.evaluate(ALARMING), json!([]), "the structure");
    assert_eq!(page.evaluate(RED_PIXELS), json!(0), "the heat map");
    assert!(!page.evaluate("document.body.textContent").as_str().unwrap().contains("above the limit"));

    // The same page of a structure that is damaged, so that the checks above can fail.
    for day in 60..63 {
        post(&service, [4.0, 4.4, 6.0], 20, day).await;
    }
    page.wait_for("document.querySelector('.headline').textContent.includes('Alarm')");
    page.wait_for(&format!("{RED_PIXELS} > 0"));
    assert_ne!(page.evaluate(ALARMING), json!([]));
}

#[tokio::test(flavor = "multi_thread")]
async fn one_event_is_one_alarm_however_often_the_reference_is_declared() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    let mut ids = Vec::new();
    let mut stream = rand_chacha::ChaCha8Rng::seed_from_u64(22);
    // Each stiffness varies from day to day by itself.
    let mut of_day = |k: [f64; 3]| k.map(|k| k * (1.0 + 0.01 * stream.sample::<f64, _>(StandardNormal)));
    // From 20 batches on, the reference has a process, with a chart for each parameter and one for all together.
    for day in 0..24 {
        ids.push(post(&service, of_day(HEALTHY), 10, day).await["batch"].clone());
    }
    for version in 1..4 {
        created(service.post(REFERENCE, &json!({ "batches": ids })).await).await;
        if version == 1 {
            for (day, k2) in [(24, 5.0), (25, 5.0), (26, 4.5), (27, 4.5), (28, 4.5)] {
                post(&service, of_day([4.0, k2, 6.0]), 10, day).await;
            }
        }
        let judged = eventually("the batches are judged with the newest reference", async || {
            let item = overview(&service).await;
            (item["waiting_batches"] == 0 && item["state"] == "alarming").then_some(item)
        })
        .await;
        let sentence = judged["verdict"].as_str().unwrap();
        let [change, low, high] = change_in(sentence, "k2");
        assert!(low < change && change < high, "{sentence}");
        assert!((low..high).contains(&-10.0), "version {version}: {sentence}");
        assert_eq!((&judged["open_alarms"], &judged["unacknowledged_alarms"]), (&json!(1), &json!(1)), "{judged}");
    }
    let charts = service.read("/v1/structures/three-dof/charts").await.to_string();
    assert!(charts.contains("structure:joint"), "there is no chart of all parameters: {charts}");
    let alarms = "/v1/structures/three-dof/alarms";
    let now = service.read(alarms).await["items"].as_array().unwrap().clone();
    assert_eq!(now.len(), 1, "{now:?}");
    assert_eq!((&now[0]["state"], &now[0]["undamaged_version"]), (&json!("open"), &json!(3)), "{now:?}");
    assert_eq!(now[0]["parameter"], "k2", "{now:?}");
    let all = service.read(&format!("{alarms}?superseded=true")).await["items"].as_array().unwrap().clone();
    let states: Vec<&str> = all.iter().map(|alarm| alarm["state"].as_str().unwrap()).collect();
    assert_eq!(states, ["open", "superseded", "superseded"], "{all:?}");
    assert_eq!(now[0]["continues"], all[1]["alarm"], "{all:?}");
    assert_eq!(all[1]["superseded_by"], 3, "{all:?}");
    let series = service.read("/v1/structures/three-dof/series").await;
    assert_eq!(series["alarms"].as_array().unwrap().len(), 1, "{series}");
    eventually("one open alarm in the metrics", async || {
        let metrics = service.get("/metrics").send().await.unwrap().text().await.unwrap();
        metrics.contains("modalwatch_open_alarms{kind=\"damage\"} 1\n").then_some(())
    })
    .await;

    let mut page = Page::open();
    visit(&mut page, &service);
    page.wait_for("document.querySelectorAll('#alarms > div > ul.alarms > li').length === 1");
    page.wait_for(
        "document.querySelector('#alarms [data-key=superseded] summary').textContent.includes('2 alarms of earlier')",
    );
    page.wait_for("document.querySelector('.headline strong').textContent === '1 open alarm'");
    let [change, low, high] = change_in(&verdict_on(&mut page), "k2");
    assert!(low < change && change < high);
    assert_eq!(page.complaints(), Vec::<String>::new());
}

/// Batches of the history that is judged again.
const HISTORY: usize = 800;
/// Seconds between its batches.
const EVERY_S: usize = 6_000;

/// A batch of three measurements every 100 minutes, as one table.
async fn long_history(service: &Service) {
    let mut table = "measured_at,f1_hz,f2_hz,f3_hz\n".to_owned();
    for batch in 0..HISTORY {
        for row in measurements(HEALTHY, 3, batch * EVERY_S) {
            let f = &row["frequencies_hz"];
            writeln!(table, "{},{},{},{}", row["measured_at"].as_str().unwrap(), f[0], f[1], f[2]).unwrap();
        }
    }
    let stored = service.post_text("/v1/structures/three-dof/batches?split=gap:1h", "text/csv", table).await;
    assert!(stored.status().is_success(), "{}", stored.text().await.unwrap());
    // A batch that waits for less than five seconds has just arrived: that is not a history to be judged.
    let sent = Instant::now();
    within(Duration::from_mins(10), "all batches are assessed and not new", async || {
        let item = overview(service).await;
        let assessed = item["batches"] == HISTORY && item["waiting_batches"] == 0;
        (assessed && sent.elapsed() > Duration::from_secs(6)).then_some(())
    })
    .await;
}

/// The numbers in `Judging: 500 of 800 batches are assessed.`
fn judging(sentence: &str) -> Option<[usize; 2]> {
    let counts = sentence.trim().strip_prefix("Judging: ")?.strip_suffix(" batches are assessed.")?;
    let (assessed, all) = counts.split_once(" of ")?;
    Some([assessed.parse().unwrap(), all.parse().unwrap()])
}

#[tokio::test(flavor = "multi_thread")]
async fn while_a_history_waits_for_its_verdict_it_is_judging_and_not_normal() {
    let Some(_turn) = turn().await else { return };
    let (service, _folder) = spawn();
    long_history(&service).await;
    let mut page = Page::open();
    visit(&mut page, &service);
    // What the page says at any moment, however short: the verdict and the sign beside it.
    page.evaluate(
        "{ window.said = []; const note = () => { const text = document.querySelector('.headline').textContent;
            if (said.at(-1) !== text) said.push(text); };
           note(); new MutationObserver(note).observe(document.querySelector('main'), { childList: true, subtree: true, characterData: true }); }",
    );
    let declared = json!({ "from": "2026-01-01T00:00:00Z", "to": "2026-01-02T00:00:00Z" });
    let declare = async { created(service.post(REFERENCE, &declared).await).await };
    let watch = async {
        let mut seen: Vec<Value> = Vec::new();
        within(Duration::from_mins(10), "all batches are judged", async || {
            let item = overview(&service).await;
            let (state, waiting) = (item["state"].clone(), item["waiting_batches"].as_u64().unwrap());
            seen.push(item);
            (waiting == 0 && state != "not_judged").then_some(())
        })
        .await;
        seen
    };
    let (_, seen) = tokio::join!(declare, watch);
    let mut counted = Vec::new();
    for item in &seen[..seen.len() - 1] {
        let (state, sentence) = (item["state"].as_str().unwrap(), item["verdict"].as_str().unwrap());
        let waiting = item["waiting_batches"].as_u64().unwrap() as usize;
        match judging(sentence) {
            Some(counts) => {
                assert_eq!((state, counts), ("judging", [HISTORY - waiting, HISTORY]), "{item}");
                counted.push(counts[0]);
            }
            None => assert_eq!((state, waiting), ("not_judged", 0), "{item}"),
        }
    }
    assert!(!counted.is_empty() && counted.is_sorted(), "{counted:?}");
    // The page shows the end as well, after it has shown the way there.
    let last = seen.last().unwrap()["verdict"].as_str().unwrap();
    page.wait_for(&format!("document.querySelector('.lead.verdict').textContent.trim().startsWith({})", json!(last)));
    let said = page.evaluate("said.map((text) => text.replace(/\\s+/g, ' '))");
    let said: Vec<&str> = said.as_array().unwrap().iter().map(|text| text.as_str().unwrap()).collect();
    let sentence = format!(" of {HISTORY} batches are assessed.");
    let first = said.iter().position(|text| text.contains("Judging: ") && text.contains(&sentence));
    let first = first.unwrap_or_else(|| panic!("the page has not said that it is judging: {said:?}"));
    let end = said.iter().rposition(|text| text.contains("Judging: ")).unwrap();
    for text in &said[first..=end] {
        assert!(!text.contains("Normal") && !text.contains("No alarm:"), "{text}");
    }
    assert_eq!(page.complaints(), Vec::<String>::new());
}
