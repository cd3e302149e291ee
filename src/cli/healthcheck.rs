//! `modalwatch healthcheck`: readiness as exit status, for Docker and other supervisors.

use std::time::Duration;

use anyhow::Context as _;
use clap::Args;
use reqwest::Method;

use super::remote::{url_of, Service};
use crate::config::{Config, Flags};

/// Ask a running service whether it is ready.
#[derive(Debug, Args)]
pub struct HealthcheckArgs {
    /// URL of the service [default: http.listen of the configuration and the environment]
    #[arg(long)]
    url: Option<String>,
    /// Maximum time to wait for the answer, seconds
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..=600))]
    timeout_s: u64,
}

/// Requests `/readyz` and prints the answer.
///
/// # Errors
/// A service that is not ready, cannot be reached or does not answer in time.
pub async fn healthcheck(args: &HealthcheckArgs) -> anyhow::Result<()> {
    let url = match args.url.clone() {
        Some(url) => url,
        None => url_of(&Config::read(None, &Flags::default())?.http.listen),
    };
    let service = Service::at(&url)?;
    let request = service.request(Method::GET, "/readyz").timeout(Duration::from_secs(args.timeout_s));
    let response = request.send().await.with_context(|| format!("{url} does not answer"))?;
    let (status, text) = (response.status(), response.text().await?);
    println!("{text}");
    anyhow::ensure!(status.is_success(), "not ready: {status}");
    Ok(())
}
