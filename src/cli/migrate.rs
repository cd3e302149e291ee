//! `modalwatch migrate`: the schema of a PostgreSQL database, and moving everything between it and a data folder.

use std::path::PathBuf;

use anyhow::Context as _;
use clap::{Args, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};

use crate::config::{Config, Flags};
use crate::quantity::shown;
use crate::store::transfer::{transfer, Location, Moved, Step};
use crate::store::{server, DatabaseUrl};

/// Make or change the schema of a PostgreSQL database, or move everything that is stored between it and a data folder.
#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true, arg_required_else_help = true)]
pub struct MigrateArgs {
    #[command(subcommand)]
    what: Option<MigrateCommand>,
    /// Where the data are: sqlite:FOLDER or postgres://user@host:5432/database
    #[arg(long, required = true)]
    from: Option<String>,
    /// Where they go: the other of the two
    #[arg(long, required = true)]
    to: Option<String>,
    /// Make a PostgreSQL database that has data already equal to the source: what only it has is removed
    #[arg(long)]
    replace: bool,
    /// Print the tables with their numbers of rows and digests as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Subcommand)]
enum MigrateCommand {
    /// Make the tables in an empty PostgreSQL database, or bring them to the version of this program. A service never does that itself.
    Schema {
        /// URL of the database [default: store.url of the configuration]
        #[arg(long)]
        url: Option<String>,
        /// Configuration file (TOML)
        #[arg(long)]
        config: Option<PathBuf>,
    },
}

/// Runs the command.
///
/// # Errors
/// A database that cannot be used, with a remedy; a move that was not completed.
pub async fn migrate(args: &MigrateArgs) -> anyhow::Result<()> {
    if let Some(MigrateCommand::Schema { url, config }) = &args.what {
        return schema(url.as_deref(), config.as_deref()).await;
    }
    let from = location("--from", args.from.as_deref().unwrap_or_default())?;
    let to = location("--to", args.to.as_deref().unwrap_or_default())?;
    let bar = ProgressBar::no_length().with_style(ProgressStyle::with_template("{elapsed} {spinner} {msg}")?);
    let mut show = |step: Step<'_>, rows: u64| {
        let (doing, table) = match step {
            Step::Writing(table) => ("writing", table),
            Step::Checking(table) => ("checking", table),
        };
        bar.set_message(format!("{doing} {table}: {rows} rows"));
        bar.tick();
    };
    let moved = transfer(&from, &to, args.replace, &mut show).await;
    bar.finish_and_clear();
    let moved = moved?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&moved)?);
    } else {
        print(&moved);
    }
    Ok(())
}

async fn schema(url: Option<&str>, config: Option<&std::path::Path>) -> anyhow::Result<()> {
    let url = match url {
        Some(text) => DatabaseUrl::parse(text).context("--url")?,
        None => Config::read(config, &Flags::default())?
            .store
            .url
            .context("the configuration has no store.url: give --url postgres://user@host:5432/database")?,
    };
    let migrated = server::migrate(&url).await?;
    match migrated.from {
        None => println!("{url}: the tables are made, schema version {}", migrated.to),
        Some(from) if from == migrated.to => println!("{url}: schema version {from}, nothing to do"),
        Some(from) => println!("{url}: schema version {from} is now {}", migrated.to),
    }
    Ok(())
}

/// The place of an argument.
fn location(flag: &str, text: &str) -> anyhow::Result<Location> {
    match text.split_once(':') {
        Some(("sqlite", folder)) if !folder.is_empty() => {
            Ok(Location::Folder(PathBuf::from(folder.strip_prefix("//").unwrap_or(folder))))
        }
        Some(("postgres" | "postgresql", _)) => Ok(Location::Server(DatabaseUrl::parse(text).context(flag.to_owned())?)),
        _ => anyhow::bail!(
            "{flag} begins with {}: it must be sqlite:FOLDER, with the data folder of a service, or postgres://user@host:5432/database",
            // What follows may be a password in a URL whose scheme has a mistake.
            shown(text.split_once(':').map_or("no scheme", |(scheme, _)| scheme))
        ),
    }
}

fn print(moved: &Moved) {
    println!("{:24} {:>10} {:>10} {:>10}  sha256 of both sides", "table", "rows", "written", "removed");
    for table in &moved.tables {
        println!(
            "{:24} {:>10} {:>10} {:>10}  {}",
            table.table,
            table.rows,
            table.written,
            table.removed,
            table.sha256.get(..16).unwrap_or_default()
        );
    }
    println!("Both sides are equal in every row.");
    if moved.rehearsal {
        println!(
            "A service was using the source: what it has stored since the beginning is not in the target. Stop it and run the same command \
             with --replace for the final move."
        );
    }
}
