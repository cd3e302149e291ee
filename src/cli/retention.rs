//! `modalwatch retention`: what is older than asked to keep.

use clap::Args;
use reqwest::Method;

use super::remote::PlaceArgs;
use crate::monitor::retention::{delete_expired, plan};
use crate::quantity::Timestamp;
use crate::store::{Error, Store, DATABASE_FILE};

/// Say which batches are older than asked to keep, or delete them.
#[derive(Debug, Args)]
pub struct RetentionArgs {
    /// Days to keep [default: retention.measurements_days of the configuration]
    #[arg(long)]
    days: Option<u32>,
    /// Only say what would go
    #[arg(long)]
    dry_run: bool,
    #[command(flatten)]
    place: PlaceArgs,
}

/// Prints what would go, and deletes it unless only that was asked for.
///
/// # Errors
/// A folder that cannot be opened; a running service, where something is to be deleted.
pub async fn retention(args: &RetentionArgs) -> anyhow::Result<()> {
    let config = args.place.read()?;
    let mut settings = config.retention;
    settings.measurements_days = args.days.unwrap_or(settings.measurements_days);
    let database = config.data_dir.join(DATABASE_FILE);
    let opened = if args.place.url.is_some() {
        None
    } else {
        anyhow::ensure!(database.exists(), "{} has no database: give --data-dir", config.data_dir.display());
        match Store::open_with(&config.data_dir, &config.store).await {
            Ok(store) => Some(store),
            Err(Error::Locked(_)) => None,
            Err(error) => return Err(error.into()),
        }
    };
    let Some(store) = opened else {
        anyhow::ensure!(
            args.dry_run,
            "a service has the data folder open and deletes by its own settings: set retention.measurements_days, or stop it; \
             --dry-run says what would go"
        );
        let service = args.place.service(&config)?;
        let query = args.days.map_or_else(String::new, |days| format!("?days={days}"));
        let response = service.send(service.request(Method::GET, &format!("/v1/retention{query}"))).await?;
        let plan: serde_json::Value = response.json().await?;
        println!("{}", serde_json::to_string_pretty(&plan)?);
        return Ok(());
    };
    let plan = plan(&store, settings, Timestamp::now()).await?;
    println!("{}", serde_json::to_string_pretty(&plan)?);
    if !args.dry_run {
        let deleted = delete_expired(&store, settings, Timestamp::now()).await?;
        println!("Deleted {} batches with {} measurements.", deleted.batches, deleted.measurements);
    }
    store.close().await;
    Ok(())
}
