//! `modalwatch backup` and `modalwatch restore`.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;
use reqwest::Method;
use serde_json::json;

use super::remote::PlaceArgs;
use crate::baseline::library::Library;
use crate::config::Config;
use crate::quantity::Timestamp;
use crate::store::backup::{self, BackupModel, Manifest, Restored};
use crate::store::Error;

/// Copy the database into a folder.
#[derive(Debug, Args)]
pub struct BackupArgs {
    /// Folder for the backup; it must not be there yet [default: backups/<time> of the data folder]
    #[arg(long)]
    out: Option<PathBuf>,
    #[command(flatten)]
    place: PlaceArgs,
    /// Print the record as JSON
    #[arg(long)]
    json: bool,
}

/// Put the database of a backup into a data folder.
#[derive(Debug, Args)]
pub struct RestoreArgs {
    /// The backup: a folder with modalwatch.sqlite and manifest.json
    #[arg(long)]
    from: PathBuf,
    /// Folder of the database [default: modalwatch-data]
    #[arg(long)]
    data_dir: Option<PathBuf>,
    /// Configuration file (TOML)
    #[arg(long)]
    config: Option<PathBuf>,
    /// Only check the backup
    #[arg(long)]
    verify: bool,
    /// Put it in the place of a database that is there; that one is kept beside it
    #[arg(long)]
    replace: bool,
}

/// Makes a backup: by the service that has the folder open, or else of the folder itself.
///
/// # Errors
/// Whatever keeps the backup from being made; there is none then.
pub async fn backup(args: &BackupArgs) -> anyhow::Result<()> {
    let config = args.place.read()?;
    let now = Timestamp::now();
    let out = args.out.clone().unwrap_or_else(|| config.data_dir.join(backup::FOLDER).join(backup::name_of(now)));
    anyhow::ensure!(!out.exists(), "{} is there already: give another --out", out.display());
    let manifest = if args.place.url.is_some() {
        by_service(args, &config, &out).await?
    } else {
        let models = models_in_use(&config)?;
        match backup::of_folder(&config.data_dir, &out, models, now).await {
            Err(backup::Error::Store(Error::Locked(_))) => by_service(args, &config, &out).await?,
            made => made?,
        }
    };
    if args.json {
        println!("{}", serde_json::to_string_pretty(&manifest)?);
    } else {
        print_manifest(&out, &manifest);
    }
    Ok(())
}

/// Asks the service for a backup in its own folder, and copies that to where it was asked for.
async fn by_service(args: &BackupArgs, config: &Config, out: &Path) -> anyhow::Result<Manifest> {
    let service = args.place.service(config)?;
    let request = service.request(Method::POST, "/v1/backups").json(&json!({}));
    let manifest: Manifest = service.send(request).await?.json().await?;
    let made = config.data_dir.join(backup::FOLDER).join(&manifest.name);
    let here = || {
        format!(
            "{} made the backup {} in its own data folder, which is not {}: fetch it from there, or give --data-dir",
            service.url(),
            manifest.name,
            config.data_dir.display()
        )
    };
    anyhow::ensure!(backup::read_manifest(&made).is_ok_and(|found| found == manifest), here());
    if args.out.is_none() {
        // It is where it would have been put anyway.
        return Ok(manifest);
    }
    copy_folder(&made, out).with_context(|| format!("cannot copy {} to {}", made.display(), out.display()))?;
    let copied = backup::verify(out).await?;
    std::fs::remove_dir_all(&made).with_context(|| format!("cannot remove {}", made.display()))?;
    Ok(copied)
}

/// Copies the two files of a backup into a folder that appears when it is whole.
fn copy_folder(from: &Path, to: &Path) -> anyhow::Result<()> {
    let parent = to.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::fs::create_dir_all(parent)?;
    let draft = tempfile::Builder::new().prefix(".draft-").tempdir_in(parent)?;
    for entry in std::fs::read_dir(from)? {
        let entry = entry?;
        let copy = draft.path().join(entry.file_name());
        std::fs::copy(entry.path(), &copy)?;
        std::fs::File::open(&copy)?.sync_all()?;
    }
    std::fs::File::open(draft.path())?.sync_all()?;
    std::fs::rename(draft.keep(), to)?;
    std::fs::File::open(parent)?.sync_all()?;
    Ok(())
}

/// The trained baselines of program and models folder: which belong to the data, though they are not in the database.
fn models_in_use(config: &Config) -> anyhow::Result<Vec<BackupModel>> {
    let library = Library::open(config.models_dir.as_deref())?;
    let mut models = Vec::new();
    for (id, entry) in library.iter() {
        if let Some(baseline) = &entry.baseline {
            let files = library.files_of(baseline.digest())?;
            let kept_in = files.map_or_else(|| "program".to_owned(), |files| files.kept_in);
            models.push(BackupModel { structure: id.to_string(), digest: baseline.digest().to_string(), kept_in });
        }
    }
    Ok(models)
}

fn print_manifest(folder: &Path, manifest: &Manifest) {
    println!("{}", folder.display());
    let Manifest { bytes, schema_version, sha256, created_at, program_version, .. } = manifest;
    println!("  {bytes} bytes, schema {schema_version}, SHA-256 {sha256}");
    println!("  made {created_at} by modalwatch {program_version}");
    for table in ["structure", "measurement_batch", "measurement", "undamaged_state", "alarm_episode"] {
        if let Some(rows) = manifest.rows.get(table) {
            println!("  {table}: {rows}");
        }
    }
    for BackupModel { structure, digest, kept_in } in &manifest.models {
        let note = match kept_in.as_str() {
            "database" => "in the backup".to_owned(),
            "program" => "shipped inside the program".to_owned(),
            folder => format!("NOT in the backup: keep {folder} too"),
        };
        println!("  model of {structure} {}…: {note}", digest.get(..12).unwrap_or(digest));
    }
}

/// Checks a backup, and puts it into the data folder unless only the check was asked for.
///
/// # Errors
/// A backup that is damaged or too new, a folder that is in use or has a database.
pub async fn restore(args: &RestoreArgs) -> anyhow::Result<()> {
    if args.verify {
        let manifest = backup::verify(&args.from).await?;
        print_manifest(&args.from, &manifest);
        println!("The backup is whole.");
        return Ok(());
    }
    let flags = crate::config::Flags { data_dir: args.data_dir.clone(), ..crate::config::Flags::default() };
    let config = Config::read(args.config.as_deref(), &flags)?;
    let Restored { manifest, kept_aside } =
        backup::restore(&args.from, &config.data_dir, args.replace, Timestamp::now()).await?;
    print_manifest(&args.from, &manifest);
    if let Some(aside) = kept_aside {
        println!("The database that was there is kept as {}.", aside.display());
    }
    println!("Restored into {}.", config.data_dir.display());
    Ok(())
}
