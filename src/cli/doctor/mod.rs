//! `modalwatch doctor`: checks everything the service needs and suggests a remedy for each problem.

mod check;
mod data;
mod host;
mod models;

use clap::Args;

use self::check::{Check, CheckVerdict};
use super::remote::LocationArgs;

/// Check everything the service needs.
#[derive(Debug, Args)]
pub struct DoctorArgs {
    #[command(flatten)]
    location: LocationArgs,
    /// Print the checks as JSON
    #[arg(long)]
    json: bool,
}

/// Runs all checks and prints them.
///
/// # Errors
/// When a check fails, so that the exit status is 1.
pub async fn doctor(args: &DoctorArgs) -> anyhow::Result<()> {
    let checks = checks(args).await;
    let worst = checks.iter().map(|check| check.verdict).max().unwrap_or(CheckVerdict::Ok);
    if args.json {
        let report = serde_json::json!({
            "verdict": worst, "version": env!("CARGO_PKG_VERSION"), "checks": checks,
        });
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print_table(&checks);
    }
    let failed = checks.iter().filter(|check| check.verdict == CheckVerdict::Fail).count();
    anyhow::ensure!(failed == 0, "{failed} of {} checks failed", checks.len());
    Ok(())
}

async fn checks(args: &DoctorArgs) -> Vec<Check> {
    let config = match args.location.read() {
        Ok(config) => config,
        Err(error) => {
            // Without the configuration the places of the other checks are unknown.
            let next =
                "correct the file, the environment or the flag; `modalwatch config print --default` lists all keys";
            return vec![Check::fail("configuration", error.to_string(), next)];
        }
    };
    let mut checks = vec![host::configuration(&config)];
    // With a database server, nothing is kept in the data folder.
    let in_folder = config.store.url.is_none();
    if in_folder {
        checks.extend(data::folder(&config));
    }
    let database = data::database(&config).await;
    checks.extend(database.checks);
    let newest = database.inspection.as_ref().and_then(|inspection| inspection.newest_received);
    if in_folder {
        checks.extend(data::backups(&config, newest.is_some()));
        checks.extend(data::left_behind(&config));
    }
    checks.extend(models::library(&config));
    if let Some(inspection) = &database.inspection {
        checks.extend(models::trained(inspection));
    }
    checks.push(host::clock(newest));
    checks.push(host::open_files(&config));
    checks.extend(host::service(&args.location, &config, database.in_use).await);
    checks
}

fn print_table(checks: &[Check]) {
    let width = checks.iter().map(|check| check.check.chars().count()).max().unwrap_or(0);
    for Check { check, verdict, found, next_step } in checks {
        let verdict = match verdict {
            CheckVerdict::Ok => "ok  ",
            CheckVerdict::Warn => "warn",
            CheckVerdict::Fail => "FAIL",
        };
        println!("{verdict}  {check:width$}  {found}");
        if let Some(next) = next_step {
            println!("      {:width$}  → {next}", "");
        }
    }
}
