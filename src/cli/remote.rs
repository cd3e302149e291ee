//! A running service, asked by a command over its own HTTP API.

use std::time::Duration;

use anyhow::Context as _;
use clap::Args;
use reqwest::{Client, Method, RequestBuilder, Response};

use crate::config::Config;

/// Variable with the token of commands.
const TOKEN: &str = "MODALWATCH_TOKEN";

/// Longest time to reach the service.
const CONNECT: Duration = Duration::from_secs(5);

/// Where data and settings are, for commands that work with a service or without.
#[derive(Debug, Args)]
pub struct PlaceArgs {
    /// Folder of the database [default: modalwatch-data]
    #[arg(long)]
    pub data_dir: Option<std::path::PathBuf>,
    /// Folder of your own structures and trained baselines
    #[arg(long)]
    pub models: Option<std::path::PathBuf>,
    /// Configuration file (TOML)
    #[arg(long)]
    pub config: Option<std::path::PathBuf>,
    /// Service to ask; its token is read from MODALWATCH_TOKEN [default: http.listen of the configuration, where a service has
    /// the data folder open]
    #[arg(long)]
    pub url: Option<String>,
}

impl PlaceArgs {
    /// The configuration in force.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn read(&self) -> Result<Config, crate::config::Error> {
        let flags = crate::config::Flags {
            data_dir: self.data_dir.clone(),
            models_dir: self.models.clone(),
            ..crate::config::Flags::default()
        };
        Config::read(self.config.as_deref(), &flags)
    }

    /// The service named by the flag, or the one that the configuration makes listen.
    ///
    /// # Errors
    /// When no client can be made.
    pub fn service(&self, config: &Config) -> anyhow::Result<Service> {
        Service::at(&self.url.clone().unwrap_or_else(|| url_of(&config.http.listen)))
    }
}

/// Where a service that listens on `listen` is reached from this machine.
pub fn url_of(listen: &str) -> String {
    let reached = listen.replacen("0.0.0.0", "127.0.0.1", 1).replacen("[::]", "[::1]", 1);
    format!("http://{reached}")
}

/// A running service.
pub struct Service {
    url: String,
    client: Client,
    token: Option<String>,
}

impl Service {
    /// The service at a URL.
    ///
    /// # Errors
    /// When no client can be made.
    pub fn at(url: &str) -> anyhow::Result<Self> {
        let client = crate::notify::client_builder().connect_timeout(CONNECT).no_proxy().build()?;
        let token = std::env::var(TOKEN).ok().filter(|token| !token.is_empty());
        Ok(Self { url: url.trim_end_matches('/').to_owned(), client, token })
    }

    /// Its address.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// A request with the token.
    pub fn request(&self, method: Method, path: &str) -> RequestBuilder {
        let request = self.client.request(method, format!("{}{path}", self.url));
        match &self.token {
            Some(token) => request.bearer_auth(token),
            None => request,
        }
    }

    /// Sends a request that must succeed.
    ///
    /// # Errors
    /// When the service cannot be reached, or what it says against it.
    pub async fn send(&self, request: RequestBuilder) -> anyhow::Result<Response> {
        let response = request.send().await.with_context(|| format!("{} cannot be reached", self.url))?;
        let status = response.status();
        if status.is_success() {
            return Ok(response);
        }
        let text = response.text().await.unwrap_or_default();
        let problem: Option<serde_json::Value> = serde_json::from_str(&text).ok();
        let detail = problem.as_ref().and_then(|p| p["detail"].as_str()).unwrap_or(&text);
        let hint = match status.as_u16() {
            401 | 403 => format!("; put a token with the scope admin into {TOKEN}"),
            _ => String::new(),
        };
        anyhow::bail!("{} answers {status}: {detail}{hint}", self.url)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_for_everybody_is_reached_on_this_machine() {
        assert_eq!(url_of("0.0.0.0:8080"), "http://127.0.0.1:8080");
        assert_eq!(url_of("[::]:8080"), "http://[::1]:8080");
        assert_eq!(url_of("192.168.0.7:80"), "http://192.168.0.7:80");
    }
}
