//! `modalwatch doctor`: everything the service needs, looked at one by one, with the next step where something is wrong.

mod data;
mod host;
mod models;

use clap::Args;
use serde::Serialize;

use super::remote::PlaceArgs;

/// Look at everything the service needs.
#[derive(Debug, Args)]
pub struct DoctorArgs {
    #[command(flatten)]
    place: PlaceArgs,
    /// Print the checks as JSON
    #[arg(long)]
    json: bool,
}

/// How a check came out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
enum Verdict {
    Ok,
    Warn,
    Fail,
}

/// One check.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
struct Check {
    check: String,
    verdict: Verdict,
    found: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    next_step: Option<String>,
}

impl Check {
    fn ok(check: impl Into<String>, found: impl Into<String>) -> Self {
        Self { check: check.into(), verdict: Verdict::Ok, found: found.into(), next_step: None }
    }

    fn warn(check: impl Into<String>, found: impl Into<String>, next: impl Into<String>) -> Self {
        let (check, found) = (check.into(), found.into());
        Self { check, verdict: Verdict::Warn, found, next_step: Some(next.into()) }
    }

    fn fail(check: impl Into<String>, found: impl Into<String>, next: impl Into<String>) -> Self {
        Self { verdict: Verdict::Fail, ..Self::warn(check, found, next) }
    }
}

/// Runs all checks and prints them.
///
/// # Errors
/// When a check fails, so that the exit status says so.
pub async fn doctor(args: &DoctorArgs) -> anyhow::Result<()> {
    let checks = checks(args).await;
    let worst = checks.iter().map(|check| check.verdict).max().unwrap_or(Verdict::Ok);
    if args.json {
        let report = serde_json::json!({
            "verdict": worst, "version": env!("CARGO_PKG_VERSION"), "checks": checks,
        });
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print_table(&checks);
    }
    let failed = checks.iter().filter(|check| check.verdict == Verdict::Fail).count();
    anyhow::ensure!(failed == 0, "{failed} of {} checks failed", checks.len());
    Ok(())
}

async fn checks(args: &DoctorArgs) -> Vec<Check> {
    let config = match args.place.read() {
        Ok(config) => config,
        Err(error) => {
            // Nothing else can be looked at without knowing where it is.
            let next = "mend the file, the environment or the flag; `modalwatch config print --default` has every key";
            return vec![Check::fail("configuration", error.to_string(), next)];
        }
    };
    let mut checks = vec![host::configuration(&config)];
    checks.extend(data::folder(&config));
    let looked = data::database(&config).await;
    checks.extend(looked.checks);
    let newest = looked.inspection.as_ref().and_then(|inspection| inspection.newest_received);
    checks.extend(data::backups(&config, newest.is_some()));
    checks.extend(models::library(&config));
    if let Some(inspection) = &looked.inspection {
        checks.extend(models::trained(inspection));
    }
    checks.push(host::clock(newest));
    checks.push(host::open_files(&config));
    checks.extend(host::service(&args.place, &config, looked.in_use).await);
    checks
}

fn print_table(checks: &[Check]) {
    let width = checks.iter().map(|check| check.check.chars().count()).max().unwrap_or(0);
    for Check { check, verdict, found, next_step } in checks {
        let verdict = match verdict {
            Verdict::Ok => "ok  ",
            Verdict::Warn => "warn",
            Verdict::Fail => "FAIL",
        };
        println!("{verdict}  {check:width$}  {found}");
        if let Some(next) = next_step {
            println!("      {:width$}  → {next}", "");
        }
    }
}

/// Bytes as people read them.
fn size(bytes: u64) -> String {
    let units = [("GiB", 30), ("MiB", 20), ("KiB", 10)];
    let unit = units.into_iter().find(|(_, shift)| bytes >= 1_u64 << shift);
    unit.map_or_else(
        || format!("{bytes} B"),
        |(name, shift)| format!("{:.1} {name}", bytes as f64 / (1_u64 << shift) as f64),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_readable() {
        assert_eq!([size(10), size(2048), size(3 << 30)], ["10 B", "2.0 KiB", "3.0 GiB"]);
    }
}
