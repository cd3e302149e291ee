//! Section `http` of the configuration.

use serde::{Deserialize, Serialize};

/// Address and limits of the HTTP server.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HttpSettings {
    /// Address and port. Port 0 chooses a free port.
    pub listen: String,
    /// Maximum size of a request body in bytes; for NDJSON, of each line.
    pub max_body_bytes: usize,
    /// Maximum size of an NDJSON body in bytes.
    pub max_bulk_bytes: usize,
    /// Time limit for receiving the header of a request, seconds.
    pub header_timeout_s: u64,
    /// Time limit for receiving the body of a request, seconds.
    pub body_timeout_s: u64,
    /// Time limit for a client to take what waits for it of an answer, seconds.
    pub write_timeout_s: u64,
    /// Maximum number of connections that are served; requests on further ones wait 10 s for a place.
    pub max_connections: usize,
    /// The same for each address (for IPv6, each /64 network) that is not a trusted proxy.
    pub max_connections_per_address: usize,
    /// Time that open requests are given to finish when the service stops, seconds.
    pub drain_s: u64,
    /// Addresses and networks of the proxies whose `X-Forwarded-For` header is trusted.
    pub trusted_proxies: Vec<String>,
    /// Maximum number of structures with metrics of their own in `GET /metrics`; 0 disables them.
    pub metrics_structures: usize,
    /// Rate limits of each client.
    pub rate_limit: RateLimitSettings,
}

impl Default for HttpSettings {
    fn default() -> Self {
        Self {
            listen: "127.0.0.1:8080".to_owned(),
            max_body_bytes: 4 << 20,
            max_bulk_bytes: 32 << 20,
            header_timeout_s: 10,
            body_timeout_s: 30,
            write_timeout_s: 20,
            max_connections: 1_024,
            max_connections_per_address: 256,
            drain_s: 30,
            trusted_proxies: Vec::new(),
            metrics_structures: 100,
            rate_limit: RateLimitSettings::default(),
        }
    }
}

/// Rate limits of each client. A client is identified by its token, or by its address if it has none.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RateLimitSettings {
    /// Sustained rate of requests per second; 0 disables the limit.
    pub requests_per_s: u32,
    /// Number of requests that may arrive at once.
    pub burst: u32,
    /// Sustained rate of measurements per second; 0 disables the limit. A batch of the maximum size is always accepted
    /// at once.
    pub measurements_per_s: u32,
    /// Number of failed authentications per minute and address; 0 disables the limit.
    pub failed_authentications_per_min: u32,
}

impl Default for RateLimitSettings {
    fn default() -> Self {
        Self { requests_per_s: 500, burst: 2_000, measurements_per_s: 0, failed_authentications_per_min: 10 }
    }
}
