//! `modalwatch retention`: lists or deletes the batches that are older than the retention period.

use clap::Args;
use reqwest::Method;

use super::remote::LocationArgs;
use crate::clock;
use crate::monitor::retention::{delete_expired, plan};
use crate::store::{Error, Store, DATABASE_FILE};

/// List or delete the batches that are older than the retention period.
#[derive(Debug, Args)]
pub struct RetentionArgs {
    /// Retention period, days [default: retention.measurements_days of the configuration]
    #[arg(long)]
    days: Option<u32>,
    /// Only list what would be deleted
    #[arg(long)]
    dry_run: bool,
    #[command(flatten)]
    location: LocationArgs,
}

/// Prints the expired batches and deletes them, except with `--dry-run`.
///
/// # Errors
/// A data folder that cannot be opened, or, without `--dry-run`, one that a service has open.
pub async fn retention(args: &RetentionArgs) -> anyhow::Result<()> {
    let config = args.location.read()?;
    let mut settings = config.retention;
    settings.measurements_days = args.days.unwrap_or(settings.measurements_days);
    let exists = config.store.url.is_some() || config.data_dir.join(DATABASE_FILE).exists();
    let opened = if args.location.url.is_some() {
        None
    } else {
        anyhow::ensure!(exists, "{} has no database: give --data-dir", config.data_dir.display());
        match Store::open_with(&config.data_dir, &config.store.without_waiting()).await {
            Ok(store) => Some(store),
            Err(Error::Locked(_) | Error::ServedElsewhere(_)) => None,
            Err(error) => return Err(error.into()),
        }
    };
    let Some(store) = opened else {
        anyhow::ensure!(
            args.dry_run,
            "a service has the data folder open and deletes expired batches itself: set retention.measurements_days, or stop the \
             service; --dry-run lists what would be deleted"
        );
        let service = args.location.service(&config)?;
        let query = args.days.map_or_else(String::new, |days| format!("?days={days}"));
        let response = service.send(service.request(Method::GET, &format!("/v1/retention{query}"))).await?;
        let plan: serde_json::Value = response.json().await?;
        println!("{}", serde_json::to_string_pretty(&plan)?);
        return Ok(());
    };
    let plan = plan(&store, settings, clock::now()).await?;
    println!("{}", serde_json::to_string_pretty(&plan)?);
    if !args.dry_run {
        let deleted = delete_expired(&store, settings, clock::now()).await?;
        println!("Deleted {} batches with {} measurements.", deleted.batches, deleted.measurements);
    }
    store.close().await;
    Ok(())
}
