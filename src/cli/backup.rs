//! `modalwatch backup` and `modalwatch restore`.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;
use reqwest::Method;
use serde_json::json;

use super::remote::LocationArgs;
use crate::baseline::library::Library;
use crate::clock;
use crate::config::Config;
use crate::private;
use crate::store::backup::{self, BackupModel, Content, DraftFolder, Manifest, Restored};
use crate::store::Error;

/// Copy the database to a folder.
#[derive(Debug, Args)]
pub struct BackupArgs {
    /// Folder of the backup; it must not exist yet [default: backups/<time> in the data folder]
    #[arg(long)]
    out: Option<PathBuf>,
    #[command(flatten)]
    location: LocationArgs,
    /// Keep the secrets of webhooks in the copy; without them its webhooks are disabled
    #[arg(long)]
    with_secrets: bool,
    /// Print the manifest of the backup as JSON
    #[arg(long)]
    json: bool,
}

/// Restore the database of a backup to a data folder.
#[derive(Debug, Args)]
pub struct RestoreArgs {
    /// Folder of the backup, with modalwatch.sqlite and manifest.json
    #[arg(long)]
    from: PathBuf,
    /// Folder for the database; it must exist [default: modalwatch-data]
    #[arg(long)]
    data_dir: Option<PathBuf>,
    /// Configuration file (TOML)
    #[arg(long)]
    config: Option<PathBuf>,
    /// Only verify the backup
    #[arg(long)]
    verify: bool,
    /// Replace an existing database, which is kept under another name
    #[arg(long)]
    replace: bool,
}

/// Makes a backup. If a service has the data folder open, the service makes it, otherwise it is made from the folder.
///
/// # Errors
/// Whatever prevents a complete backup; then there is none.
pub async fn backup(args: &BackupArgs) -> anyhow::Result<()> {
    let config = args.location.read()?;
    if config.store.url.is_some() {
        return Err(backup::Error::Server.into());
    }
    let now = clock::now();
    let out = args.out.clone().unwrap_or_else(|| config.data_dir.join(backup::FOLDER).join(backup::name_of(now)));
    anyhow::ensure!(!out.exists(), "{} already exists: give another folder with --out", out.display());
    let manifest = if args.location.url.is_some() {
        by_service(args, &config, &out).await?
    } else {
        let content = Content { models: models_in_use(&config)?, with_secrets: args.with_secrets };
        match backup::of_folder(&config.data_dir, &out, content, now).await {
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

/// Lets the service make a backup in its data folder, and moves it to `--out` if that is given.
async fn by_service(args: &BackupArgs, config: &Config, out: &Path) -> anyhow::Result<Manifest> {
    let service = args.location.service(config)?;
    let request = service.request(Method::POST, "/v1/backups").json(&json!({ "with_secrets": args.with_secrets }));
    let manifest: Manifest = service.send(request).await?.json().await?;
    let made = config.data_dir.join(backup::FOLDER).join(&manifest.name);
    let elsewhere = || {
        format!(
            "{} made the backup {} in its data folder, which is not {}: copy it from there, or give its data folder with --data-dir",
            service.url(),
            manifest.name,
            config.data_dir.display()
        )
    };
    anyhow::ensure!(backup::read_manifest(&made).is_ok_and(|found| found == manifest), elsewhere());
    if args.out.is_none() {
        // The service has made it in the default folder.
        return Ok(manifest);
    }
    copy_folder(&made, out).with_context(|| format!("cannot copy {} to {}", made.display(), out.display()))?;
    let copied = backup::verify(out).await?;
    std::fs::remove_dir_all(&made).with_context(|| format!("cannot remove {}", made.display()))?;
    Ok(copied)
}

/// Copies the two files of a backup to a temporary folder, which is renamed to `to` when it is complete.
fn copy_folder(from: &Path, to: &Path) -> anyhow::Result<()> {
    let parent = to.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    private::create_folder(parent)?;
    let draft = DraftFolder::create(parent)?;
    for entry in std::fs::read_dir(from)? {
        let entry = entry?;
        let copy = draft.path().join(entry.file_name());
        std::fs::copy(entry.path(), &copy)?;
        std::fs::File::open(&copy)?.sync_all()?;
    }
    private::narrow(draft.path())?;
    std::fs::File::open(draft.path())?.sync_all()?;
    std::fs::rename(draft.keep()?, to)?;
    std::fs::File::open(parent)?.sync_all()?;
    Ok(())
}

/// The trained models of the program and the models folder. The assessments depend on them, but they are not in the database.
fn models_in_use(config: &Config) -> anyhow::Result<Vec<BackupModel>> {
    let library = Library::open(config.models_dir.as_deref())?;
    let mut models = Vec::new();
    for (id, entry) in library.iter() {
        if let Some(model) = &entry.baseline {
            let files = library.files_of(model.digest())?;
            let kept_in = files.map_or_else(|| "program".to_owned(), |files| files.kept_in);
            models.push(BackupModel { structure: id.to_string(), digest: model.digest().to_string(), kept_in });
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
            folder => format!("NOT in the backup: back up {folder} too"),
        };
        println!("  model of {structure} {}…: {note}", digest.get(..12).unwrap_or(digest));
    }
}

/// Verifies a backup and restores it to the data folder, unless only the verification is requested.
///
/// # Errors
/// A backup that is damaged or too new, a data folder that is in use or already has a database.
pub async fn restore(args: &RestoreArgs) -> anyhow::Result<()> {
    if args.verify {
        let manifest = backup::verify(&args.from).await?;
        print_manifest(&args.from, &manifest);
        println!("The backup is complete and intact.");
        return Ok(());
    }
    let flags = crate::config::Flags { data_dir: args.data_dir.clone(), ..crate::config::Flags::default() };
    let config = Config::read_for_existing(args.config.as_deref(), &flags)?;
    let Restored { manifest, kept_aside, webhooks_without_secret } =
        backup::restore(&args.from, &config.data_dir, args.replace, clock::now()).await?;
    print_manifest(&args.from, &manifest);
    if let Some(aside) = kept_aside {
        println!("The previous database is kept as {}.", aside.display());
    }
    println!("Restored to {}.", config.data_dir.display());
    if webhooks_without_secret > 0 {
        println!(
            "The backup has no secrets: {webhooks_without_secret} webhooks are disabled. Give each a new secret by POST \
             /v1/webhooks/{{id}}/secret, tell it to its receiver, and enable the webhook by PUT."
        );
    }
    Ok(())
}
