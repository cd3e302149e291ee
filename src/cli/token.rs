//! `modalwatch token`: manages tokens while the service is stopped.

use std::collections::BTreeSet;
use std::path::PathBuf;

use anyhow::Context as _;
use clap::{Args, Subcommand};

use crate::access::{write_admin_token, NewToken, Scope, TokenId, TokenRecord, TokenText};
use crate::clock;
use crate::config::{Config, Flags};
use crate::quantity::{shown, StructureId, Timestamp};
use crate::store::{self, NewAuditEntry, Store};

/// Create, list, revoke and rotate tokens while the service is stopped.
#[derive(Debug, Args)]
pub struct TokenArgs {
    #[command(subcommand)]
    command: TokenCommand,
    /// Folder of the database [default: modalwatch-data]
    #[arg(long, global = true)]
    data_dir: Option<PathBuf>,
    /// Configuration file (TOML)
    #[arg(long, global = true)]
    config: Option<PathBuf>,
}

#[derive(Debug, Subcommand)]
enum TokenCommand {
    /// Create a token; it is printed once.
    Create {
        /// Name that describes what the token is for
        #[arg(long)]
        name: String,
        /// Scope: ingest, read or admin; may be repeated
        #[arg(long = "scope", required = true)]
        scopes: Vec<Scope>,
        /// Restrict the token to this structure; may be repeated [default: all structures]
        #[arg(long = "structure")]
        structures: Vec<String>,
        /// Restrict the posts of a token with the scope ingest to this source; may be repeated [default: all sources]
        #[arg(long = "source")]
        sources: Vec<String>,
        /// Time of expiry, RFC 3339 with an offset [default: never]
        #[arg(long)]
        expires_at: Option<String>,
    },
    /// List all tokens, without their secrets.
    List,
    /// Revoke a token.
    Revoke {
        /// Id of the token: the part between its underscores
        id: String,
    },
    /// Give a token a new secret; it is printed once.
    Rotate {
        /// Id of the token: the part between its underscores
        id: String,
        /// Seconds for which the old secret stays valid
        #[arg(long, default_value_t = 3_600)]
        overlap_s: u32,
    },
    /// Create an admin token file for MODALWATCH_ADMIN_TOKEN_FILE; no database is needed.
    File {
        /// File to create; only its owner can read it
        path: PathBuf,
    },
}

/// Runs the command.
///
/// # Errors
/// An invalid token, or a database that cannot be opened, for example because a service is running.
pub async fn token(args: TokenArgs) -> anyhow::Result<()> {
    if let TokenCommand::File { path } = &args.command {
        write_admin_token(path)?;
        println!("{}", path.display());
        return Ok(());
    }
    let flags = Flags { data_dir: args.data_dir, ..Flags::default() };
    let config = Config::read_for_existing(args.config.as_deref(), &flags)?;
    let store = Store::open_with(&config.data_dir, &config.store.without_waiting()).await.map_err(|error| match error {
        store::Error::Locked(folder) => anyhow::anyhow!(
            "the service is running on {}: use its API (POST /v1/tokens, DELETE /v1/tokens/{{id}}, POST \
             /v1/tokens/{{id}}/rotation), or stop it first",
            folder.display()
        ),
        store::Error::ServedElsewhere(reason) => anyhow::anyhow!(
            "{reason}; a running service makes and revokes tokens by its API (POST /v1/tokens, DELETE /v1/tokens/{{id}})"
        ),
        other => other.into(),
    })?;
    let done = run(&store, args.command).await;
    store.close().await;
    done
}

async fn run(store: &Store, command: TokenCommand) -> anyhow::Result<()> {
    match command {
        TokenCommand::Create { name, scopes, structures, sources, expires_at } => {
            let structures = structures.iter().map(|id| StructureId::parse(id)).collect::<Result<_, _>>();
            let structures = structures.context("--structure")?;
            let new = NewToken {
                name,
                scopes: scopes.into_iter().collect(),
                structures: Some(structures).filter(|ids: &BTreeSet<_>| !ids.is_empty()),
                sources: Some(sources.into_iter().collect()).filter(|names: &BTreeSet<_>| !names.is_empty()),
                expires_at: expires_at.as_deref().map(Timestamp::parse).transpose().context("--expires-at")?,
            };
            create(store, new).await
        }
        TokenCommand::List => list(store).await,
        TokenCommand::Revoke { id } => {
            let record = find(store, &id).await?;
            let revoked = TokenRecord { revoked_at: record.revoked_at.or(Some(clock::now())), ..record };
            let revocation = store.tokens().update_token(&revoked);
            store.audit().without_floor().audited(entry("revoke", &revoked.id), revocation).await?;
            println!("{} is revoked", revoked.id);
            Ok(())
        }
        TokenCommand::Rotate { id, overlap_s } => rotate(store, &id, overlap_s).await,
        TokenCommand::File { .. } => unreachable!("handled before the database is opened"),
    }
}

fn entry(what: &str, id: &TokenId) -> NewAuditEntry {
    NewAuditEntry::local(clock::now(), format!("modalwatch token {what}"), Some(format!("/v1/tokens/{id}")))
}

async fn create(store: &Store, new: NewToken) -> anyhow::Result<()> {
    let now = clock::now();
    if let Some(problem) = new.problems(now).into_iter().next() {
        anyhow::bail!("{}: {}", problem.pointer.trim_start_matches('/'), problem.message);
    }
    let text = TokenText::generate()?;
    let record = new.record(&text, now);
    store.audit().audited(entry("create", &record.id), store.tokens().insert_token(&record)).await?;
    show_once(&text);
    Ok(())
}

async fn rotate(store: &Store, id: &str, overlap_s: u32) -> anyhow::Result<()> {
    let (record, now) = (find(store, id).await?, clock::now());
    anyhow::ensure!(record.is_active(now), "token {id} is {}: make a new one", record.state(now));
    let text = TokenText::with_id(record.id.clone())?;
    let until = Timestamp::from_micros(now.micros() + i64::from(overlap_s) * 1_000_000)?;
    let rotated = record.rotated(&text, until);
    let rotation = store.tokens().update_token(&rotated);
    store.audit().without_floor().audited(entry("rotate", &rotated.id), rotation).await?;
    eprintln!("The old secret is valid until {until}.");
    show_once(&text);
    Ok(())
}

async fn list(store: &Store) -> anyhow::Result<()> {
    let now = clock::now();
    println!(
        "{:16}  {:7}  {:18}  {:20}  {:10}  {:10}  name",
        "id", "state", "scopes", "expires", "structures", "sources"
    );
    for token in store.tokens().list().await? {
        let scopes: Vec<&str> = token.scopes.iter().map(Scope::as_str).collect();
        let expires = token.expires_at.map_or_else(|| "never".to_owned(), |at| at.to_string());
        let structures = token.structures.as_ref().map(|ids| ids.iter().map(StructureId::as_str).collect());
        let sources = token.sources.as_ref().map(|names| names.iter().map(String::as_str).collect());
        let (structures, sources) = (listed(structures), listed(sources));
        let (state, scopes) = (token.state(now), scopes.join(","));
        let (id, name) = (token.id.as_str(), &token.name);
        println!("{id:16}  {state:7}  {scopes:18}  {expires:20}  {structures:10}  {sources:10}  {name}");
    }
    Ok(())
}

/// What a token is limited to.
fn listed(names: Option<Vec<&str>>) -> String {
    names.map_or_else(|| "all".to_owned(), |names| names.join(","))
}

/// Prints the token to standard output, for scripts, and the explanation to standard error.
fn show_once(text: &TokenText) {
    eprintln!("The token is shown only once: the service stores only its SHA-256.");
    println!("{}", text.reveal());
}

async fn find(store: &Store, id: &str) -> anyhow::Result<TokenRecord> {
    let found = store.tokens().list().await?.into_iter().find(|token| token.id.as_str() == id);
    found.with_context(|| format!("there is no token {}; modalwatch token list shows all ids", shown(id)))
}
