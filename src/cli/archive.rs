//! `modalwatch export` and `modalwatch import`.

use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;
use reqwest::Method;

use super::remote::PlaceArgs;
use crate::baseline::library::Library;
use crate::config::Config;
use crate::monitor::Monitor;
use crate::quantity::StructureId;
use crate::store::{Error, Store, DATABASE_FILE};

/// Write one structure into a file.
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// The structure
    #[arg(long, value_parser = parse_id)]
    structure: StructureId,
    /// The file; lines of JSON
    #[arg(long)]
    out: PathBuf,
    #[command(flatten)]
    place: PlaceArgs,
}

/// Take a file that `export` wrote. The service must be stopped.
#[derive(Debug, Args)]
pub struct ImportArgs {
    /// The file
    #[arg(long)]
    from: PathBuf,
    #[command(flatten)]
    place: PlaceArgs,
    /// Print what was done as JSON
    #[arg(long)]
    json: bool,
}

fn parse_id(text: &str) -> Result<StructureId, String> {
    StructureId::parse(text).map_err(|e| e.to_string())
}

/// Writes the archive of a structure: asks the service that has the folder open, or else reads the folder itself.
///
/// # Errors
/// Whatever keeps the file from being whole; there is none then.
pub async fn export(args: &ExportArgs) -> anyhow::Result<()> {
    let config = args.place.read()?;
    let opened = if args.place.url.is_some() { None } else { open(&config).await? };
    let mut file = Draft::begin(&args.out)?;
    if let Some(monitor) = opened {
        let mut lines = monitor.archive().export(&args.structure).await?;
        while let Some(line) = lines.recv().await {
            file.write(&line?)?;
        }
        monitor.store().close().await;
    } else {
        let service = args.place.service(&config)?;
        let request = service.request(Method::GET, &format!("/v1/structures/{}/export", args.structure));
        let mut response = service.send(request).await?;
        while let Some(piece) = response.chunk().await.context("the export broke off")? {
            file.write(&piece)?;
        }
    }
    let bytes = file.finish()?;
    println!("{}: {bytes} bytes", args.out.display());
    Ok(())
}

/// Takes an archive.
///
/// # Errors
/// A file that is not whole or does not fit what is here, with the line.
pub async fn import(args: &ImportArgs) -> anyhow::Result<()> {
    let config = args.place.read()?;
    let library = Library::open(config.models_dir.as_deref())?;
    let store = Store::open_with(&config.data_dir, &config.store).await?;
    let monitor = Monitor::open(store, library, config.monitor).await?;
    let imported = monitor.archive().import(&args.from).await;
    monitor.store().close().await;
    let done = imported?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&done)?);
        return Ok(());
    }
    println!("{}: {} of {} batches were new and are assessed", done.structure, done.batches_new, done.batches);
    println!(
        "  new: {} versions, {} trained baselines, {} undamaged states, {} maintenance windows, {} acknowledgements",
        done.versions, done.models, done.undamaged_states, done.maintenance_windows, done.acknowledgements
    );
    for warning in done.warnings {
        println!("  warning: {warning}");
    }
    Ok(())
}

/// The data folder, unless a service has it open.
async fn open(config: &Config) -> anyhow::Result<Option<Monitor>> {
    let database = config.data_dir.join(DATABASE_FILE);
    anyhow::ensure!(database.exists(), "{} has no database: give --data-dir or --url", config.data_dir.display());
    match Store::open_with(&config.data_dir, &config.store).await {
        Ok(store) => {
            let library = Library::open(config.models_dir.as_deref())?;
            Ok(Some(Monitor::open(store, library, config.monitor.clone()).await?))
        }
        Err(Error::Locked(_)) => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// A file in the making, beside its place.
struct Draft {
    file: std::io::BufWriter<tempfile::NamedTempFile>,
    out: PathBuf,
    bytes: u64,
}

impl Draft {
    fn begin(out: &Path) -> anyhow::Result<Self> {
        let folder = out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let file = tempfile::NamedTempFile::new_in(folder);
        let file = file.with_context(|| format!("cannot write {}", out.display()))?;
        Ok(Self { file: std::io::BufWriter::new(file), out: out.to_owned(), bytes: 0 })
    }

    fn write(&mut self, bytes: &[u8]) -> anyhow::Result<()> {
        self.bytes += bytes.len() as u64;
        self.file.write_all(bytes).with_context(|| format!("cannot write {}", self.out.display()))
    }

    fn finish(self) -> anyhow::Result<u64> {
        let place = || format!("cannot write {}", self.out.display());
        let file = self.file.into_inner().map_err(std::io::IntoInnerError::into_error).with_context(place)?;
        file.as_file().sync_all().with_context(place)?;
        file.persist(&self.out).with_context(place)?;
        Ok(self.bytes)
    }
}
