//! The address of a client, with or without proxies.

use std::convert::Infallible;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;

use axum::extract::{ConnectInfo, FromRequestParts, Request};
use axum::http::request::Parts;
use ipnet::IpNet;

use super::denial::forbidden;
use super::route::Subject;
use crate::access::{Actor, Grant, TokenText};
use crate::http::error::ApiError;
use crate::measurement::body::RawBatch;
use crate::monitor::DEFAULT_SOURCE;
use crate::quantity::shown;

/// Text that is neither an address nor a network.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0} is neither an address (10.0.0.7) nor a network (10.0.0.0/24)")]
pub struct NotANetwork(String);

/// The client of a request, for rate limits, audit, and a further look at its token while the request goes on.
#[derive(Debug, Clone)]
pub struct Client {
    /// Address of the client, behind trusted proxies.
    pub address: Option<IpAddr>,
    /// Key under which its requests are counted.
    pub(in crate::http) key: Key,
    /// The rights that it was given.
    pub(super) grant: Grant,
    /// The token for which it was given them.
    pub(super) presented: Option<Arc<TokenText>>,
}

/// Key under which requests are counted: the token, otherwise the address.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Key {
    /// A token by its id.
    Token(String),
    /// An address; for IPv6 its /64 network, which usually belongs to one customer.
    Address(IpAddr),
    /// Shared by clients without an address and those above the number of tracked clients.
    Others,
}

impl Key {
    /// The key of an address.
    pub fn of_address(address: Option<IpAddr>) -> Self {
        match address {
            None => Self::Others,
            Some(IpAddr::V6(address)) => {
                let network = u128::from(address) >> 64 << 64;
                Self::Address(IpAddr::V6(Ipv6Addr::from(network)))
            }
            Some(address) => Self::Address(address),
        }
    }
}

impl Client {
    pub(super) fn new(grant: &Grant, address: Option<IpAddr>, presented: Option<TokenText>) -> Self {
        let key = match grant.actor() {
            Actor::Token { id, .. } => Key::Token(id.clone()),
            Actor::Local | Actor::Nobody => Key::of_address(address),
        };
        Self { address, key, grant: grant.clone(), presented: presented.map(Arc::new) }
    }

    /// The id of its token.
    pub fn token(&self) -> Option<String> {
        match self.grant.actor() {
            Actor::Token { id, .. } => Some(id.clone()),
            Actor::Local | Actor::Nobody => None,
        }
    }

    /// The source of a batch that it posts: the one that is named, or the one that is meant without a name.
    ///
    /// # Errors
    /// 403 if its token is limited to other sources.
    pub fn source(&self, named: Option<String>) -> Result<String, ApiError> {
        self.grant.source(named, DEFAULT_SOURCE).map_err(|denied| forbidden(&denied, Subject::Structure))
    }

    /// A batch that it posts, with its source and its token.
    ///
    /// # Errors
    /// 403 if its token is limited to other sources.
    pub fn posts(&self, raw: RawBatch) -> Result<RawBatch, ApiError> {
        Ok(RawBatch { source: Some(self.source(raw.source)?), posted_by: self.token(), ..raw })
    }
}

impl<S: Send + Sync> FromRequestParts<S> for Client {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        let nobody = || Self { address: None, key: Key::Others, grant: Grant::nobody(), presented: None };
        Ok(parts.extensions.get::<Self>().cloned().unwrap_or_else(nobody))
    }
}

/// Proxies whose `X-Forwarded-For` header is trusted.
#[derive(Debug, Default)]
pub struct Proxies(Vec<IpNet>);

impl Proxies {
    /// Parses addresses and networks.
    ///
    /// # Errors
    /// The first text that is neither.
    pub fn parse(texts: &[String]) -> Result<Self, NotANetwork> {
        let network = |text: &String| {
            let network = text.parse::<IpNet>().or_else(|_| text.parse::<IpAddr>().map(IpNet::from));
            network.map_err(|_| NotANetwork(shown(text)))
        };
        texts.iter().map(network).collect::<Result<_, _>>().map(Self)
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub(super) fn trust(&self, address: IpAddr) -> bool {
        self.0.iter().any(|network| network.contains(&address.to_canonical()))
    }

    /// Key under which the connections of an address are counted; `None` for a trusted proxy, whose connections are those of many clients.
    pub fn connection_key(&self, peer: IpAddr) -> Option<Key> {
        let peer = peer.to_canonical();
        (!self.trust(peer)).then(|| Key::of_address(Some(peer)))
    }

    /// The address of the client: the peer address, or, if that is a trusted proxy, the last address in
    /// `X-Forwarded-For` that is not a trusted proxy. Addresses before that one were sent by the client and are not
    /// trusted.
    pub(super) fn client(&self, request: &Request) -> Option<IpAddr> {
        let peer = request.extensions().get::<ConnectInfo<SocketAddr>>()?.0.ip().to_canonical();
        if !self.trust(peer) {
            return Some(peer);
        }
        let lines = request.headers().get_all("x-forwarded-for").iter().rev();
        let mut client = peer;
        for text in lines.flat_map(|line| line.to_str().unwrap_or("?").split(',').rev()) {
            let Ok(address) = text.trim().parse::<IpAddr>() else { break };
            client = address.to_canonical();
            if !self.trust(client) {
                break;
            }
        }
        Some(client)
    }
}

/// Whether a `Host` names this machine: a loopback address, `localhost`, or a name below `localhost`, with or without a port.
///
/// Other names, also those without a dot, may be resolved by the name server of a network to this machine for the page of somebody
/// else (DNS rebinding).
pub(super) fn is_local_name(host: &str) -> bool {
    let is_port =
        |text: &str| text.is_empty() || text.strip_prefix(':').is_some_and(|port| port.parse::<u16>().is_ok());
    if let Some((address, port)) = host.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        return is_port(port) && address.parse::<Ipv6Addr>().is_ok_and(|a| a.to_canonical().is_loopback());
    }
    let (name, port) = host.split_at(host.find(':').unwrap_or(host.len()));
    let is_loopback = || name.parse::<Ipv4Addr>().is_ok_and(|address| address.is_loopback());
    let name_of_this_machine =
        name.eq_ignore_ascii_case("localhost") || name.to_ascii_lowercase().ends_with(".localhost");
    is_port(port) && (name_of_this_machine || is_loopback())
}

/// Whether an `Origin` is the service itself, which has answered under the name `host`.
pub(super) fn is_same_origin(origin: &str, host: &str) -> bool {
    let place = origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"));
    place.is_some_and(|place| place.eq_ignore_ascii_case(host))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn client(proxies: &[&str], peer: &str, forwarded: &[&str]) -> String {
        let proxies: Vec<String> = proxies.iter().map(ToString::to_string).collect();
        let peer: IpAddr = peer.parse().unwrap();
        let mut request = Request::new(axum::body::Body::empty());
        request.extensions_mut().insert(ConnectInfo(SocketAddr::new(peer, 1)));
        for line in forwarded {
            request.headers_mut().append("x-forwarded-for", line.parse().unwrap());
        }
        Proxies::parse(&proxies).unwrap().client(&request).unwrap().to_string()
    }

    #[test]
    fn only_the_address_added_by_a_trusted_proxy_is_used() {
        let table: [(&[&str], &str, &[&str], &str); 8] = [
            (&[], "192.0.2.1", &["203.0.113.9"], "192.0.2.1"),
            (&["10.0.0.7"], "192.0.2.1", &["203.0.113.9"], "192.0.2.1"),
            (&["10.0.0.7"], "10.0.0.7", &["203.0.113.9"], "203.0.113.9"),
            (&["10.0.0.7"], "10.0.0.7", &["1.1.1.1, 203.0.113.9"], "203.0.113.9"),
            (&["10.0.0.0/8"], "10.0.0.7", &["1.1.1.1, 203.0.113.9", "10.0.0.8"], "203.0.113.9"),
            (&["10.0.0.7"], "10.0.0.7", &["1.1.1.1, nonsense"], "10.0.0.7"),
            (&["10.0.0.7"], "10.0.0.7", &[], "10.0.0.7"),
            (&["10.0.0.7"], "::ffff:10.0.0.7", &["2001:db8::5"], "2001:db8::5"),
        ];
        for (proxies, peer, forwarded, expected) in table {
            assert_eq!(client(proxies, peer, forwarded), expected, "{proxies:?} {peer} {forwarded:?}");
        }
    }

    #[test]
    fn an_invalid_proxy_address_is_reported() {
        let error = Proxies::parse(&["proxy.local".to_owned()]).unwrap_err();
        assert!(error.to_string().contains("\"proxy.local\""), "{error}");
    }

    #[test]
    fn addresses_of_one_customer_are_one_key() {
        let key = |text: &str| Key::of_address(Some(text.parse().unwrap()));
        assert_eq!(key("2001:db8::1"), key("2001:db8::ffff:2"));
        assert_ne!(key("2001:db8::1"), key("2001:db8:0:1::1"));
        assert_ne!(key("192.0.2.1"), key("192.0.2.2"));
    }

    #[test]
    fn names_from_outside_are_not_this_machine() {
        for local in ["localhost", "LocalHost:8080", "127.0.0.1:1", "127.8.8.8", "[::1]:80", "[::1]", "a.localhost"] {
            assert!(is_local_name(local), "{local}");
        }
        for foreign in [
            "",
            "evil",
            "evil.example",
            "evil.example:8080",
            "192.0.2.1",
            "[2001:db8::1]",
            "localhost.evil.example",
            "[::1].evil.example",
            "[::1]:80.evil.example",
            "127.0.0.1.evil.example",
            "localhost:80@evil.example",
            "127.1",
        ] {
            assert!(!is_local_name(foreign), "{foreign}");
        }
    }

    #[test]
    fn only_the_service_itself_is_the_same_origin() {
        let same = |origin: &str| is_same_origin(origin, "localhost:8080");
        assert!(same("http://localhost:8080") && same("https://LOCALHOST:8080"));
        for foreign in [
            "null",
            "",
            "localhost:8080",
            "http://localhost",
            "http://localhost:3000",
            "chrome-extension://localhost:8080",
            "http://evil",
        ] {
            assert!(!same(foreign), "{foreign}");
        }
    }
}
