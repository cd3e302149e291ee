//! `modalwatch export` and `modalwatch import`.

use std::path::PathBuf;

use clap::Args;

use super::download::Draft;
use super::remote::LocationArgs;
use crate::baseline::library::Library;
use crate::config::Config;
use crate::monitor::Monitor;
use crate::quantity::StructureId;
use crate::store::{Error, Store, DATABASE_FILE};

/// Write one structure with all its data to a file.
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// Id of the structure
    #[arg(long, value_parser = parse_id)]
    structure: StructureId,
    /// File to write; one JSON object per line
    #[arg(long)]
    out: PathBuf,
    #[command(flatten)]
    location: LocationArgs,
}

/// Read a file that `modalwatch export` wrote. The service must be stopped.
#[derive(Debug, Args)]
pub struct ImportArgs {
    /// File to read
    #[arg(long)]
    from: PathBuf,
    #[command(flatten)]
    location: LocationArgs,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

fn parse_id(text: &str) -> Result<StructureId, String> {
    StructureId::parse(text).map_err(|e| e.to_string())
}

/// Writes the archive of a structure. If a service has the data folder open, the archive is requested from it, again if it is away for a
/// moment; otherwise it is read from the folder.
///
/// # Errors
/// Whatever prevents a complete archive; then no file is written.
pub async fn export(args: &ExportArgs) -> anyhow::Result<()> {
    let config = args.location.read()?;
    let opened = if args.location.url.is_some() { None } else { open(&config).await? };
    let mut file = Draft::begin(&args.out)?;
    if let Some(monitor) = opened {
        let mut lines = monitor.archive().export(&args.structure).await?;
        while let Some(line) = lines.recv().await {
            file.write(&line?)?;
        }
        monitor.store().close().await;
    } else {
        let service = args.location.service(&config)?;
        file.download(&service, &format!("/v1/structures/{}/export", args.structure)).await?;
    }
    let bytes = file.finish()?;
    println!("{}: {bytes} bytes", args.out.display());
    Ok(())
}

/// Imports an archive.
///
/// # Errors
/// A file that is incomplete or contradicts the stored data, with the line.
pub async fn import(args: &ImportArgs) -> anyhow::Result<()> {
    let config = args.location.read()?;
    let library = Library::open(config.models_dir.as_deref())?;
    let store = Store::open_with(&config.data_dir, &config.store.without_waiting()).await?;
    let monitor = Monitor::open(store, library, config.monitor).await?;
    let imported = monitor.archive().import(&args.from).await;
    monitor.store().close().await;
    let done = imported?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&done)?);
        return Ok(());
    }
    println!("{}: {} of {} batches were new and have been assessed", done.structure, done.batches_new, done.batches);
    println!(
        "  new: {} versions, {} trained models, {} undamaged references, {} maintenance windows, {} acknowledgements, {} alarm actions, {} notes",
        done.versions, done.models, done.undamaged_states, done.maintenance_windows, done.acknowledgements,
        done.alarm_actions, done.notes
    );
    for warning in done.warnings {
        println!("  warning: {warning}");
    }
    Ok(())
}

/// Opens the data folder; `None` if a service has it open.
async fn open(config: &Config) -> anyhow::Result<Option<Monitor>> {
    let exists = config.store.url.is_some() || config.data_dir.join(DATABASE_FILE).exists();
    anyhow::ensure!(exists, "{} has no database: give --data-dir or --url", config.data_dir.display());
    match Store::open_with(&config.data_dir, &config.store.without_waiting()).await {
        Ok(store) => {
            let library = Library::open(config.models_dir.as_deref())?;
            Ok(Some(Monitor::open(store, library, config.monitor.clone()).await?))
        }
        Err(Error::Locked(_) | Error::ServedElsewhere(_)) => Ok(None),
        Err(error) => Err(error.into()),
    }
}
