//! `modalwatch report`: the condition report of a structure as an HTML file, from a running service.

use std::path::PathBuf;

use anyhow::Context as _;
use clap::Args;
use reqwest::Method;

use super::remote::LocationArgs;
use crate::quantity::{StructureId, Timestamp};

/// Write the condition report of a structure, as a page made for print.
#[derive(Debug, Args)]
pub struct ReportArgs {
    /// Id of the structure
    #[arg(long)]
    structure: String,
    /// Begin of the period, such as 2026-01-01T00:00:00Z [default: the first batch]
    #[arg(long)]
    from: Option<String>,
    /// End of the period [default: the last batch]
    #[arg(long)]
    to: Option<String>,
    /// HTML file
    #[arg(long)]
    out: PathBuf,
    #[command(flatten)]
    location: LocationArgs,
}

/// Requests the report and writes it.
///
/// # Errors
/// An invalid id or time, a service that cannot be reached or refuses, or a file that cannot be written.
pub async fn report(args: &ReportArgs) -> anyhow::Result<()> {
    let structure = StructureId::parse(&args.structure).context("--structure")?;
    let mut query = Vec::new();
    for (name, text) in [("from", &args.from), ("to", &args.to)] {
        if let Some(text) = text {
            let time = Timestamp::parse(text).with_context(|| format!("--{name}"))?;
            query.push(format!("{name}={time}"));
        }
    }
    let service = args.location.service(&args.location.read()?)?;
    let path = format!("/v1/structures/{structure}/report?{}", query.join("&"));
    let html = service.send(service.request(Method::GET, &path)).await?.text().await?;
    std::fs::write(&args.out, html).with_context(|| format!("{} cannot be written", args.out.display()))?;
    println!("Wrote {}.", args.out.display());
    Ok(())
}
