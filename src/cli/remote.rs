//! Requests of a command to a running service, over its HTTP API.

use std::time::Duration;

use anyhow::Context as _;
use clap::Args;
use reqwest::header::{HeaderMap, RETRY_AFTER};
use reqwest::{Client, Method, RequestBuilder, Response, StatusCode};

use crate::config::Config;

/// Environment variable with the token.
const TOKEN: &str = "MODALWATCH_TOKEN";

/// Maximum time to connect to the service.
const CONNECT: Duration = Duration::from_secs(5);

/// The data folder, the settings and the service, for commands that work with and without a running service.
#[derive(Debug, Args)]
pub struct LocationArgs {
    /// Folder of the database [default: modalwatch-data]
    #[arg(long)]
    pub data_dir: Option<std::path::PathBuf>,
    /// Folder of your own structures and trained models
    #[arg(long)]
    pub models: Option<std::path::PathBuf>,
    /// Configuration file (TOML)
    #[arg(long)]
    pub config: Option<std::path::PathBuf>,
    /// URL of the service; the token is read from MODALWATCH_TOKEN [default: http.listen of the configuration, if a service has
    /// the data folder open]
    #[arg(long)]
    pub url: Option<String>,
}

impl LocationArgs {
    /// The configuration in force.
    ///
    /// # Errors
    /// An invalid configuration, or a `--data-dir` that does not exist.
    pub fn read(&self) -> Result<Config, crate::config::Error> {
        let flags = crate::config::Flags {
            data_dir: self.data_dir.clone(),
            models_dir: self.models.clone(),
            ..crate::config::Flags::default()
        };
        Config::read_for_existing(self.config.as_deref(), &flags)
    }

    /// The service at `--url`, otherwise at the address in the configuration.
    ///
    /// # Errors
    /// If the HTTP client cannot be created.
    pub fn service(&self, config: &Config) -> anyhow::Result<Service> {
        Service::at(&self.url.clone().unwrap_or_else(|| url_of(&config.http.listen)))
    }
}

/// URL of a service that listens on `listen`, as seen from this machine.
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
    /// If the HTTP client cannot be created.
    pub fn at(url: &str) -> anyhow::Result<Self> {
        let client = crate::notify::client_builder().connect_timeout(CONNECT).no_proxy().build()?;
        let token = std::env::var(TOKEN).ok().filter(|token| !token.is_empty());
        Ok(Self { url: url.trim_end_matches('/').to_owned(), client, token })
    }

    /// The URL of the service.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// A request with the token, if there is one.
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
    /// A service that cannot be reached, or its error message.
    pub async fn send(&self, request: RequestBuilder) -> anyhow::Result<Response> {
        let response = request.send().await.with_context(|| format!("{} cannot be reached", self.url))?;
        self.accepted(response).await
    }

    /// An answer that must be a success.
    ///
    /// # Errors
    /// The error message of the service.
    pub async fn accepted(&self, response: Response) -> anyhow::Result<Response> {
        let status = response.status();
        if status.is_success() {
            return Ok(response);
        }
        let text = response.text().await.unwrap_or_default();
        let problem: Option<serde_json::Value> = serde_json::from_str(&text).ok();
        let detail = problem.as_ref().and_then(|p| p["detail"].as_str()).unwrap_or(&text);
        let hint = match status.as_u16() {
            401 | 403 => format!("; set {TOKEN} to a token with the scope admin"),
            _ => String::new(),
        };
        anyhow::bail!("{} answers {status}: {detail}{hint}", self.url)
    }
}

/// The pause after which a request that was refused may succeed: the one that the service names, otherwise `pause`. `None` if the service
/// is neither busy nor away, so that it would refuse the same request again.
pub fn pause_before_another(status: StatusCode, headers: &HeaderMap, pause: Duration) -> Option<Duration> {
    let may_succeed = matches!(
        status,
        StatusCode::TOO_MANY_REQUESTS
            | StatusCode::SERVICE_UNAVAILABLE
            | StatusCode::BAD_GATEWAY
            | StatusCode::GATEWAY_TIMEOUT
    );
    let named = headers.get(RETRY_AFTER).and_then(|value| value.to_str().ok()?.parse().ok());
    may_succeed.then(|| named.map_or(pause, Duration::from_secs))
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

    #[test]
    fn a_request_is_repeated_when_the_service_is_busy_or_away() {
        let (named, unnamed) = (Duration::from_secs(7), Duration::from_secs(3));
        let asked = |status: u16, retry_after: Option<&'static str>| {
            let headers = retry_after.map(|pause| (RETRY_AFTER, pause.parse().unwrap())).into_iter().collect();
            pause_before_another(StatusCode::from_u16(status).unwrap(), &headers, unnamed)
        };
        for status in [429, 502, 503, 504] {
            assert_eq!(asked(status, Some("7")), Some(named), "{status}");
            assert_eq!(asked(status, None), Some(unnamed), "{status}");
            assert_eq!(asked(status, Some("soon")), Some(unnamed), "{status}");
        }
        for status in [200, 401, 404, 422, 500] {
            assert_eq!(asked(status, Some("7")), None, "{status}");
        }
    }
}
