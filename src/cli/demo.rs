//! `modalwatch demo`: case 1 of the paper, posted to a service over its HTTP API.

use std::path::PathBuf;

use anyhow::Context as _;
use clap::Args;
use serde::Serialize;
use serde_json::{json, Value};
use tokio::sync::oneshot;

use super::serve::{start, stop_signal};
use crate::baseline::library::find_structure;
use crate::clock;
use crate::config::{Config, Flags, HttpFlags};
use crate::measurement::{at_intervals, ModalMeasurement};
use crate::quantity::{Digest, Timestamp};
use crate::simulator::population::Population;
use crate::simulator::Simulator;
use crate::telemetry::{self, LogSettings};

/// Start a service and post case 1 of the paper to it, as if it had been measured in the last five days.
#[derive(Debug, Args)]
pub struct DemoArgs {
    /// Address and port [default: 127.0.0.1:8080, or a free port if that is in use]
    #[arg(long)]
    listen: Option<String>,
    /// Folder of the database [default: a temporary one]
    #[arg(long)]
    data_dir: Option<PathBuf>,
    /// Seed of the simulated measurements
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Stop the service after the table is printed
    #[arg(long)]
    exit: bool,
    /// Print the table as JSON
    #[arg(long)]
    json: bool,
}

const STRUCTURE: &str = "three-dof";
const MEASUREMENTS: usize = 50;
/// The paper's measurements have no noise; this is the smallest standard deviation that the trained model covers.
const RELATIVE_STD: f64 = 1e-4;
/// One day, µs.
const DAY: i64 = 86_400_000_000;

/// A state of the structure: the populations of Table 2 with means reduced as in Table 1, and the results of Table 4 (Wang et
/// al. 2025).
struct Scenario {
    name: &'static str,
    /// Target mean of k1, k2, k3, N/m.
    mean: [f64; 3],
    /// Probability of damage of k1, k2, k3 predicted in the paper, if Table 4 contains it.
    paper_pod: [Option<f64>; 3],
}

/// Target standard deviations of k1, k2, k3, N/m, in every state (Table 2).
const STD: [f64; 3] = [0.3, 0.1, 0.2];

const SCENARIOS: [Scenario; 5] = [
    Scenario { name: "undamaged reference", mean: [4.0, 5.0, 6.0], paper_pod: [None, None, None] },
    Scenario { name: "healthy", mean: [4.0, 5.0, 6.0], paper_pod: [None, None, None] },
    Scenario { name: "scenario 1", mean: [3.6, 5.0, 6.0], paper_pod: [Some(0.456), None, None] },
    Scenario { name: "scenario 2", mean: [4.0, 4.5, 4.8], paper_pod: [None, Some(1.0), Some(1.0)] },
    Scenario { name: "scenario 3", mean: [3.6, 4.5, 4.8], paper_pod: [Some(0.546), Some(1.0), Some(1.0)] },
];

#[derive(Debug, Serialize)]
struct Report {
    scenarios: Vec<ScenarioReport>,
}

#[derive(Debug, Serialize)]
struct ScenarioReport {
    name: String,
    parameters: Vec<ParameterReport>,
}

#[derive(Debug, Serialize)]
struct ParameterReport {
    name: String,
    target_mean: f64,
    realised_mean: f64,
    mean: f64,
    target_std: f64,
    realised_std: Option<f64>,
    std: Option<f64>,
    target_probability_of_damage: f64,
    realised_probability_of_damage: f64,
    paper_probability_of_damage: Option<f64>,
    pooled_probability_of_damage: Option<f64>,
    probability_of_damage: Option<f64>,
    probability_of_damage_interval: Option<[f64; 2]>,
    exceeds: Option<bool>,
    alarm_state: Option<String>,
}

/// Runs the demonstration.
///
/// # Errors
/// A service that does not start, or an answer that is not a success.
pub async fn demo(args: DemoArgs) -> anyhow::Result<()> {
    // The table should not be mixed with log lines; the alarms that would be logged as warnings stand in it.
    telemetry::start(&LogSettings { level: "error".to_owned(), ..LogSettings::default() })
        .map_err(anyhow::Error::msg)?;
    let temporary = tempfile::tempdir().context("cannot create a temporary folder")?;
    let data_dir = args.data_dir.clone().unwrap_or_else(|| temporary.path().to_owned());
    let listen = match &args.listen {
        Some(listen) => listen.clone(),
        None => free_address().await,
    };
    let flags = Flags { data_dir: Some(data_dir), http: HttpFlags { listen: Some(listen) }, ..Flags::default() };
    let mut config = Config::read(None, &flags)?;
    // The demonstration sends its requests without a token.
    config.access.admin_token_file = None;
    let (stop, stopped) = oneshot::channel::<()>();
    let signal = stop_signal()?;
    let shutdown = async move {
        tokio::select! { _ = stopped => {}, () = signal => {} }
    };
    let running = start(config, shutdown).await?;
    let url = format!("http://{}", running.address);

    let report = post_case_1(&url, args.seed).await?;
    if args.json {
        println!("{}", serde_json::to_string(&report)?);
    } else {
        print_table(&report);
    }
    if args.exit {
        drop(stop);
    } else {
        eprintln!("\nDashboard: {url}/");
        eprintln!("Documentation: {url}/docs/");
        eprintln!("The service keeps running; Ctrl-C stops it. Its results for other programs, for example:");
        eprintln!("  curl {url}/v1/structures/{STRUCTURE}/history?format=csv");
        eprintln!("  curl {url}/v1/structures/{STRUCTURE}/alarms");
        let _keep = stop;
        return running.task.await.context("the service panicked")?;
    }
    running.task.await.context("the service panicked")?
}

/// The default address, or one with a free port if the default port is in use.
async fn free_address() -> String {
    let usual = Config::default().http.listen;
    match tokio::net::TcpListener::bind(&usual).await {
        Ok(_) => usual,
        Err(_) => "127.0.0.1:0".to_owned(),
    }
}

async fn post_case_1(url: &str, seed: u64) -> anyhow::Result<Report> {
    let simulator = find_structure(STRUCTURE)?;
    let client = crate::notify::client_builder().build()?;
    let structure_url = format!("{url}/v1/structures/{STRUCTURE}");
    let mut scenarios = Vec::new();
    let mut realised_thresholds = [0.0; 3];
    for (index, scenario) in SCENARIOS.iter().enumerate() {
        let drawn = draw(&simulator, scenario, seed, index)?;
        let body = json!({ "source": "demo", "measurements": drawn.measurements });
        let answer = post(&client, &format!("{structure_url}/batches"), &body).await?;
        if index == 0 {
            post(&client, &format!("{structure_url}/reference"), &json!({ "batches": [answer["batch"]] })).await?;
            for (k, threshold) in realised_thresholds.iter_mut().enumerate() {
                let std = crate::stats::sample_std(&drawn.stiffness[k])
                    .context("the standard deviation of fifty values is defined")?;
                *threshold = crate::stats::mean(&drawn.stiffness[k]) + crate::stats::normal_quantile(0.05) * std;
            }
            continue;
        }
        scenarios.push(report(scenario, &answer, &drawn.stiffness, realised_thresholds)?);
    }
    Ok(Report { scenarios })
}

/// Simulated measurements and the stiffnesses that they were simulated from.
struct Drawn {
    measurements: Vec<ModalMeasurement>,
    /// One list for each of k1, k2, k3, N/m.
    stiffness: [Vec<f64>; 3],
}

fn draw(simulator: &Simulator, scenario: &Scenario, seed: u64, index: usize) -> anyhow::Result<Drawn> {
    let moments: Vec<(String, f64, f64)> = (0..3).map(|k| (format!("k{}", k + 1), scenario.mean[k], STD[k])).collect();
    let population = Population::new(simulator.space(), &moments)?;
    // Each scenario has its own seed.
    let drawn = population.draw(simulator, MEASUREMENTS, 0.0, seed_of(seed, index))?;
    // One batch a day, the last of them yesterday. The whole day in UTC makes the data of two runs on the same day equal.
    let today = clock::now().micros().div_euclid(DAY) * DAY;
    let start = today - (SCENARIOS.len() - index) as i64 * DAY;
    let rows: Vec<Vec<f64>> = drawn.frequencies_hz.row_iter().map(|row| row.iter().copied().collect()).collect();
    let measurements = at_intervals(&rows, Timestamp::from_micros(start)?, 600, Some(RELATIVE_STD))?;
    let stiffness = [0, 1, 2].map(|k| drawn.theta.column(k).iter().copied().collect());
    Ok(Drawn { measurements, stiffness })
}

fn seed_of(seed: u64, index: usize) -> u64 {
    let digest = Digest::of(&[&seed.to_le_bytes(), &(index as u64).to_le_bytes()]);
    u64::from_str_radix(&digest.as_str()[..16], 16).expect("a digest is hexadecimal")
}

async fn post(client: &reqwest::Client, url: &str, body: &Value) -> anyhow::Result<Value> {
    let response = client.post(url).json(body).send().await.with_context(|| format!("POST {url}"))?;
    let status = response.status();
    let answer: Value = response.json().await.with_context(|| format!("POST {url}"))?;
    anyhow::ensure!(status.is_success(), "POST {url} was answered {status}: {answer}");
    Ok(answer)
}

fn report(
    scenario: &Scenario,
    answer: &Value,
    stiffness: &[Vec<f64>; 3],
    realised_thresholds: [f64; 3],
) -> anyhow::Result<ScenarioReport> {
    let parameters = answer["assessment"]["parameters"].as_array();
    let parameters = parameters.with_context(|| format!("the service did not assess {}: {answer}", scenario.name))?;
    let parameter = |(k, p): (usize, &Value)| {
        let undamaged = SCENARIOS[0].mean[k];
        let target_threshold = undamaged + crate::stats::normal_quantile(0.05) * STD[k];
        let damaged = stiffness[k].iter().filter(|x| **x < realised_thresholds[k]).count();
        ParameterReport {
            name: p["name"].as_str().unwrap_or_default().to_owned(),
            target_mean: scenario.mean[k],
            realised_mean: crate::stats::mean(&stiffness[k]),
            mean: p["mean"].as_f64().unwrap_or(f64::NAN),
            target_std: STD[k],
            realised_std: crate::stats::sample_std(&stiffness[k]),
            std: p["std"].as_f64(),
            target_probability_of_damage: crate::stats::normal_cdf((target_threshold - scenario.mean[k]) / STD[k]),
            realised_probability_of_damage: damaged as f64 / MEASUREMENTS as f64,
            paper_probability_of_damage: scenario.paper_pod[k],
            pooled_probability_of_damage: p["pooled"]["probability_of_damage"].as_f64(),
            probability_of_damage: p["probability_of_damage"].as_f64(),
            probability_of_damage_interval: serde_json::from_value(p["probability_of_damage_interval"].clone()).ok(),
            exceeds: p["exceeds"].as_bool(),
            alarm_state: chart_state(answer, p["name"].as_str().unwrap_or_default()),
        }
    };
    let parameters = parameters.iter().enumerate().map(parameter).collect();
    Ok(ScenarioReport { name: scenario.name.to_owned(), parameters })
}

/// State of the alarm chart of a parameter after the batch.
fn chart_state(answer: &Value, parameter: &str) -> Option<String> {
    let charts = answer["charts"].as_array()?;
    let own = charts.iter().find(|point| point["chart"] == parameter)?;
    own["state"].as_str().map(str::to_owned)
}

fn print_table(report: &Report) {
    println!(
        "Case 1 of Wang et al. (2025): three masses, k1 to k3 to the ground, {MEASUREMENTS} measurements a batch."
    );
    println!(
        "target: the population; realised: the {MEASUREMENTS} stiffnesses drawn from it; updated: estimated from their"
    );
    println!("frequencies. The standard deviations of the population are {}, {} and {} N/m.", STD[0], STD[1], STD[2]);
    println!("PoD: probability of damage. pooled: of all samples of the batch together, noise included, as in the");
    println!("paper; updated: of the population that was estimated, with its 90 % interval.\n");
    println!("   ------ mean, N/m ------ -- std, N/m ---- ----------------- PoD, % -----------------");
    println!(
        "{:<3}{:>6}{:>9}{:>8} {:>9}{:>8} {:>6}{:>9}{:>6}{:>7}{:>16} alarm",
        "",
        "target",
        "realised",
        "updated",
        "realised",
        "updated",
        "target",
        "realised",
        "paper",
        "pooled",
        "updated (90 %)"
    );
    let percent = |p: Option<f64>| p.map_or("-".to_owned(), |p| format!("{:.1}", 100.0 * p));
    let interval = |p: Option<f64>, interval: Option<[f64; 2]>| match (p, interval) {
        (Some(p), Some([low, high])) => format!("{:.1} ({:.0}…{:.0})", 100.0 * p, 100.0 * low, 100.0 * high),
        _ => percent(p),
    };
    let number = |x: Option<f64>| x.map_or("-".to_owned(), |x| format!("{x:.4}"));
    for scenario in &report.scenarios {
        println!("{}", scenario.name);
        for p in &scenario.parameters {
            println!(
                "{:<3}{:>6.2}{:>9.4}{:>8.4} {:>9}{:>8} {:>6.1}{:>9.1}{:>6}{:>7}{:>16} {}",
                p.name,
                p.target_mean,
                p.realised_mean,
                p.mean,
                number(p.realised_std),
                number(p.std),
                100.0 * p.target_probability_of_damage,
                100.0 * p.realised_probability_of_damage,
                percent(p.paper_probability_of_damage),
                percent(p.pooled_probability_of_damage),
                interval(p.probability_of_damage, p.probability_of_damage_interval),
                p.alarm_state.as_deref().unwrap_or("-")
            );
        }
    }
    println!("\nAbout every second undamaged batch of {MEASUREMENTS} has a PoD above 5 %: that is not an alarm. False alarms");
    println!(
        "have a fixed rate, one in 1000 undamaged batches. Compare \"updated\" with \"realised\": {MEASUREMENTS} draws"
    );
    println!("deviate randomly from their population.");
}
