//! `modalwatch demo`.

use std::io::{BufRead as _, BufReader, Read as _};
use std::process::Stdio;

use crate::commands::world::World;

/// Days of a calendar date since 1970-01-01 (Howard Hinnant, chrono-compatible low-level date algorithms).
fn days(date: &str) -> i64 {
    let part = |range: std::ops::Range<usize>| date[range].parse::<i64>().unwrap();
    let (year, month, day) = (part(0..4), part(5..7), part(8..10));
    let year = if month <= 2 { year - 1 } else { year };
    let era = year.div_euclid(400);
    let of_era = year - era * 400;
    let of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    era * 146_097 + of_era * 365 + of_era / 4 - of_era / 100 + of_year - 719_468
}

#[tokio::test]
async fn the_demo_fits_100_columns_prints_its_dashboard_and_has_data_of_the_last_days() {
    let world = World::new();
    let mut child =
        world.command(&["demo", "--listen", "0"]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut stderr = BufReader::new(child.stderr.take().unwrap());
    let mut said = String::new();
    let dashboard = loop {
        let mut line = String::new();
        assert!(stderr.read_line(&mut line).unwrap() > 0, "the demo ended: {said}");
        said += &line;
        if let Some(url) = line.strip_prefix("Dashboard: ") {
            break url.trim().to_owned();
        }
    };
    let client = modalwatch::notify::client_builder().build().unwrap();
    let page = client.get(&dashboard).send().await.unwrap();
    assert!(page.status().is_success() && page.text().await.unwrap().contains("<html"), "{dashboard}");
    let drawn = |query: &str| client.get(format!("{dashboard}v1/structures/three-dof/drawing.svg{query}")).send();
    let drawing = drawn("?mode=2").await.unwrap();
    assert_eq!(drawing.headers()["content-type"], "image/svg+xml");
    let svg = drawing.text().await.unwrap();
    assert!(svg.starts_with("<svg") && svg.contains("mode 2, ") && svg.contains("data-name=\"k6\""), "{svg}");
    for wrong in ["?mode=4", "?mode=0", "?mode=first", "?modes=1"] {
        assert_eq!(drawn(wrong).await.unwrap().status(), 422, "{wrong}");
    }
    let history = client.get(format!("{dashboard}v1/structures/three-dof/history?format=csv")).send().await.unwrap();
    let history = history.text().await.unwrap();
    let today = days(&modalwatch::clock::now().to_string());
    let dates: Vec<i64> = history
        .lines()
        .flat_map(|line| line.split(','))
        .filter(|cell| cell.len() >= 20 && cell.as_bytes()[4] == b'-' && cell.as_bytes()[10] == b'T')
        .map(days)
        .collect();
    assert!(!dates.is_empty() && dates.iter().all(|day| (today - 6..=today).contains(day)), "{history}");

    child.kill().unwrap();
    let mut table = String::new();
    child.stdout.take().unwrap().read_to_string(&mut table).unwrap();
    child.wait().unwrap();
    assert!(table.contains("scenario 3"), "{table}");
    for line in table.lines() {
        assert!(line.chars().count() <= 100, "{} columns: {line}", line.chars().count());
    }
}
