//! A service as one of several nodes of a PostgreSQL database: its registration, and standing by while another node serves.

use std::net::SocketAddr;

use anyhow::Context as _;
use metrics_exporter_prometheus::PrometheusHandle;
use tokio::sync::watch;
use tracing::info;

use super::supervisor;
use crate::config::Config;
use crate::http::server::Duty;
use crate::http::standby::Standby;
use crate::store::server::Nodes;

/// Registers this process among the nodes of its database; with `store.standby`, the server begins to pass requests on to the node that serves.
/// `None` for a database in the data folder, which has one process.
///
/// # Errors
/// A database that cannot be used, with a remedy.
pub(super) async fn join(
    config: &Config,
    address: SocketAddr,
    duty: &watch::Sender<Duty>,
    metrics: &PrometheusHandle,
) -> anyhow::Result<Option<Nodes>> {
    let Some(database) = &config.store.url else { return Ok(None) };
    let url = match &config.store.node_url {
        Some(url) => url.trim_end_matches('/').to_owned(),
        None => default_url(address)?,
    };
    let nodes = Nodes::join(database, url.clone()).await?;
    if config.store.standby {
        duty.send_replace(Duty::StandingBy(Standby::new(nodes.clone(), metrics.clone(), &config.http)?));
        info!(%address, url, "Listening on http://{address}; other nodes reach this one at {url} (store.node_url)");
        supervisor::standing_by(duty.subscribe());
    }
    Ok(Some(nodes))
}

/// The address at which the service listens, or, if it listens on all addresses of its machine, the name of the machine.
fn default_url(address: SocketAddr) -> anyhow::Result<String> {
    if !address.ip().is_unspecified() {
        return Ok(format!("http://{address}"));
    }
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let (name, port) = (name.trim(), address.port());
    let url = format!("http://{name}:{port}");
    let is_url = reqwest::Url::parse(&url).is_ok_and(|url| url.host_str().is_some());
    (is_url && !name.is_empty()).then_some(url).with_context(|| {
        format!("this machine has no name by which other nodes could reach it ({name:?}): set store.node_url")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_address_for_other_nodes_is_that_of_the_service_or_the_name_of_the_machine() {
        assert_eq!(default_url("192.0.2.7:8080".parse().unwrap()).unwrap(), "http://192.0.2.7:8080");
        assert_eq!(default_url("[2001:db8::7]:80".parse().unwrap()).unwrap(), "http://[2001:db8::7]:80");
        let named = default_url("0.0.0.0:8081".parse().unwrap()).unwrap();
        assert!(named.starts_with("http://") && named.ends_with(":8081") && !named.contains("0.0.0.0"), "{named}");
    }
}
