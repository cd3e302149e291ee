//! Addresses that webhooks may reach: the public internet, and private addresses only where the configuration allows
//! them.
//!
//! A user who may create webhooks must not be able to reach services that only this machine can reach: its own ports,
//! the internal network, the metadata service of a cloud (server-side request forgery). Addresses are therefore checked
//! when the connection is made, after the name was resolved, so that a name that changes its address between two
//! lookups (DNS rebinding) gains nothing.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use ipnet::IpNet;
use reqwest::dns::{Addrs, Name, Resolve, Resolving};
use reqwest::Url;

use crate::quantity::shown;

/// Maximum length of a URL, bytes.
const LONGEST_URL: usize = 2_000;

/// Time limit for resolving a name when a webhook is created.
const RESOLVE_TIMEOUT: Duration = Duration::from_secs(2);

/// Decides which addresses may be reached.
#[derive(Debug, Clone, Default)]
pub struct Guard {
    allowed: Vec<(IpNet, Option<u16>)>,
}

impl Guard {
    /// A guard that allows these private targets: addresses, address:port, or networks.
    ///
    /// # Errors
    /// The entry that has none of these forms.
    pub fn new(allowed: &[String]) -> Result<Self, String> {
        let target = |text: &String| {
            let parsed = text.parse::<SocketAddr>().map(|socket| (IpNet::from(socket.ip()), Some(socket.port())));
            let parsed = parsed.or_else(|_| text.parse::<IpAddr>().map(|ip| (IpNet::from(ip), None)));
            parsed.or_else(|_| text.parse::<IpNet>().map(|net| (net, None))).map_err(|_| text.clone())
        };
        Ok(Self { allowed: allowed.iter().map(target).collect::<Result<_, _>>()? })
    }

    /// Whether an address may be reached.
    ///
    /// # Errors
    /// A message with the address and its kind.
    pub fn check(&self, address: IpAddr, port: u16) -> Result<(), String> {
        let canonical = address.to_canonical();
        let allowed = |(net, on): &(IpNet, Option<u16>)| net.contains(&canonical) && on.is_none_or(|on| on == port);
        match reserved(canonical) {
            Some(kind) if !self.allowed.iter().any(allowed) => Err(format!(
                "{address} is {kind}: webhooks may reach it only if notify.allow_private_targets contains it"
            )),
            _ => Ok(()),
        }
    }

    /// Checks the URL of a webhook. A name in it is checked later, when it is resolved.
    ///
    /// # Errors
    /// A message with the reason.
    pub fn check_url(&self, text: &str) -> Result<Url, String> {
        if text.len() > LONGEST_URL {
            return Err(format!("the URL has {} bytes: at most {LONGEST_URL} are allowed", text.len()));
        }
        let url = Url::parse(text).map_err(|e| format!("{} is not a valid URL: {e}", shown(text)))?;
        if !["http", "https"].contains(&url.scheme()) {
            return Err(format!("{} has the scheme {}: only http and https are supported", shown(text), url.scheme()));
        }
        if !url.username().is_empty() || url.password().is_some() {
            return Err("a URL with a user name or password is refused: messages are signed instead".to_owned());
        }
        if let Some(address) = literal(&url) {
            self.check(address, port(&url))?;
        }
        Ok(url)
    }

    /// As [`Guard::check_url`], and checks the addresses to which a name in the URL resolves. A name that does not
    /// resolve now is accepted, because it may resolve later.
    ///
    /// # Errors
    /// A message with the reason.
    pub async fn check_new_url(&self, text: &str) -> Result<(), String> {
        let url = self.check_url(text)?;
        let Some(host) = url.host_str().filter(|_| literal(&url).is_none()) else { return Ok(()) };
        let looked_up = tokio::time::timeout(RESOLVE_TIMEOUT, tokio::net::lookup_host((host, port(&url)))).await;
        match looked_up {
            Ok(Ok(addresses)) => self.reachable(host, addresses, port(&url)).map(drop),
            _ => Ok(()),
        }
    }

    /// The addresses of a name that may be reached.
    fn reachable(
        &self,
        host: &str,
        addresses: impl Iterator<Item = SocketAddr>,
        port: u16,
    ) -> Result<Vec<SocketAddr>, String> {
        let (mut reachable, mut refused) = (Vec::new(), None);
        for address in addresses {
            match self.check(address.ip(), port) {
                Ok(()) => reachable.push(address),
                Err(reason) => refused = Some(reason),
            }
        }
        match refused {
            Some(reason) if reachable.is_empty() => Err(format!("{} resolves to {reason}", shown(host))),
            _ => Ok(reachable),
        }
    }
}

/// The IP address in a URL, in any notation.
fn literal(url: &Url) -> Option<IpAddr> {
    url.host_str()?.trim_start_matches('[').trim_end_matches(']').parse().ok()
}

fn port(url: &Url) -> u16 {
    url.port_or_known_default().unwrap_or_default()
}

/// Resolves names for connections to one port, and omits addresses that may not be reached.
pub struct GuardedResolver {
    guard: Arc<Guard>,
    port: u16,
}

impl GuardedResolver {
    /// A resolver for connections to `port`.
    pub fn new(guard: Arc<Guard>, port: u16) -> Self {
        Self { guard, port }
    }
}

impl Resolve for GuardedResolver {
    fn resolve(&self, name: Name) -> Resolving {
        let (guard, port) = (Arc::clone(&self.guard), self.port);
        Box::pin(async move {
            let found = tokio::net::lookup_host((name.as_str(), port)).await?;
            let reachable = guard.reachable(name.as_str(), found, port)?;
            Ok(Box::new(reachable.into_iter()) as Addrs)
        })
    }
}

/// Kind of an address that is not on the public internet, after the IANA registries of special-purpose addresses.
fn reserved(address: IpAddr) -> Option<&'static str> {
    match address {
        IpAddr::V4(v4) => reserved_v4(v4),
        IpAddr::V6(v6) => reserved_v6(v6),
    }
}

fn reserved_v4(address: Ipv4Addr) -> Option<&'static str> {
    let [a, b, c, _] = address.octets();
    match (a, b, c) {
        (0, ..) => Some("an address of this machine"),
        (127, ..) => Some("a loopback address"),
        (10, ..) | (172, 16..=31, _) | (192, 168, _) => Some("a private address"),
        (169, 254, _) => Some("a link-local address, where clouds keep their metadata"),
        (100, 64..=127, _) => Some("an address of carrier-grade NAT"),
        (192, 0, 0) | (192, 88, 99) | (198, 18..=19, _) => Some("an address for special use"),
        (192, 0, 2) | (198, 51, 100) | (203, 0, 113) => Some("an address for examples"),
        (224..=239, ..) => Some("a multicast address"),
        (240..=255, ..) => Some("a reserved address"),
        _ => None,
    }
}

fn reserved_v6(address: Ipv6Addr) -> Option<&'static str> {
    let s = address.segments();
    let embedded = |high: u16, low: u16| {
        let [a, b] = high.to_be_bytes();
        let [c, d] = low.to_be_bytes();
        reserved_v4(Ipv4Addr::new(a, b, c, d))
    };
    match s {
        _ if address.is_unspecified() => Some("an address of this machine"),
        _ if address.is_loopback() => Some("a loopback address"),
        // IPv4-embedded addresses (RFC 6052) and 6to4 addresses contain an IPv4 address.
        [0x64, 0xff9b, 0, 0, 0, 0, high, low] | [0x2002, high, low, ..] => embedded(high, low),
        [0x2001, 0..=0x1ff, ..] => Some("an address for special use"),
        [0x2001, 0xdb8, ..] | [0x3fff, 0..=0xfff, ..] => Some("an address for examples"),
        [0xfc00..=0xfdff | 0xfec0..=0xfeff, ..] => Some("a private address"),
        [0xfe80..=0xfebf, ..] => Some("a link-local address"),
        [0xff00..=0xffff, ..] => Some("a multicast address"),
        // Only this range is allocated to the public internet so far.
        [0x2000..=0x3fff, ..] => None,
        _ => Some("an address for special use"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REFUSED: [&str; 44] = [
        "http://127.0.0.1/",
        "http://127.8.9.1:8080/",
        "http://2130706433/",
        "http://0x7f.1/",
        "http://0177.0.0.1/",
        "http://127.1/",
        "http://0.0.0.0/",
        "http://0/",
        "http://10.1.2.3/",
        "http://172.16.0.1/",
        "http://172.31.255.254/",
        "https://192.168.0.1/",
        "http://169.254.169.254/latest/meta-data/",
        "http://100.64.0.1/",
        "http://100.127.255.255/",
        "http://192.0.0.8/",
        "http://192.0.2.1/",
        "http://198.18.0.1/",
        "http://198.51.100.1/",
        "http://203.0.113.9/",
        "http://224.0.0.1/",
        "http://239.255.255.250/",
        "http://240.0.0.1/",
        "http://255.255.255.255/",
        "http://[::]/",
        "http://[::1]/",
        "http://[::ffff:127.0.0.1]/",
        "http://[::ffff:10.0.0.1]/",
        "http://[::ffff:a9fe:a9fe]/",
        "http://[::127.0.0.1]/",
        "http://[64:ff9b::7f00:1]/",
        "http://[64:ff9b:1::1]/",
        "http://[2002:7f00:1::]/",
        "http://[2002:a9fe:a9fe::1]/",
        "http://[2001::1]/",
        "http://[2001:db8::1]/",
        "http://[fc00::1]/",
        "http://[fd12:3456::1]/",
        "http://[fe80::1]/",
        "http://[fec0::1]/",
        "http://[ff02::1]/",
        "http://[100::1]/",
        "http://１２７.0.0.1/",
        "http://[::ffff:0:127.0.0.1]/",
    ];

    #[test]
    fn what_is_not_on_the_open_internet_is_refused_in_every_notation() {
        let guard = Guard::default();
        for url in REFUSED {
            let error = guard.check_url(url).expect_err(url);
            assert!(error.contains("notify.allow_private_targets"), "{url}: {error}");
        }
    }

    #[test]
    fn the_open_internet_is_let_through() {
        let guard = Guard::default();
        for url in [
            "https://93.184.216.34/hook",
            "http://172.15.0.1/",
            "http://172.32.0.1/",
            "http://100.63.0.1/",
            "http://100.128.0.1/",
            "http://192.0.1.1/",
            "http://[2606:2800:220:1::1]:8443/",
            "http://[2002:5db8:d822::1]/",
            "http://[64:ff9b::5db8:d822]/",
            "https://hooks.example.org/a?b=c",
        ] {
            guard.check_url(url).expect(url);
        }
    }

    #[test]
    fn other_schemes_and_names_in_the_url_are_refused() {
        let guard = Guard::default();
        for (url, reason) in [
            ("ftp://example.org/", "scheme ftp"),
            ("file:///etc/passwd", "scheme file"),
            ("gopher://example.org/", "scheme gopher"),
            ("https://user@example.org/", "user name"),
            ("https://:secret@example.org/", "user name"),
            ("example.org/hook", "not a valid URL"),
            ("", "not a valid URL"),
            ("http://", "not a valid URL"),
        ] {
            let error = guard.check_url(url).expect_err(url);
            assert!(error.contains(reason), "{url}: {error}");
        }
    }

    #[test]
    fn a_private_target_is_let_through_where_it_is_allowed_and_nowhere_else() {
        let allowed = ["10.0.0.0/8", "192.168.1.7", "127.0.0.1:9999", "[::1]:80", "fd00::/8"].map(str::to_owned);
        let guard = Guard::new(&allowed).unwrap();
        for url in [
            "http://10.250.0.1/",
            "http://[::ffff:10.0.0.1]/",
            "https://192.168.1.7:8443/",
            "http://127.0.0.1:9999/hook",
            "http://[::1]/",
            "http://[fd00::5]/",
        ] {
            guard.check_url(url).expect(url);
        }
        for url in ["http://172.16.0.1/", "http://192.168.1.8/", "http://127.0.0.1:9998/", "http://[::1]:81/"] {
            assert!(guard.check_url(url).is_err(), "{url}");
        }
        assert_eq!(Guard::new(&["intranet".to_owned()]).unwrap_err(), "intranet");
        assert!(Guard::new(&["10.0.0.0/33".to_owned()]).is_err());
    }

    #[tokio::test]
    async fn a_name_is_judged_by_the_address_it_leads_to() {
        let closed = Guard::default();
        let error = closed.check_new_url("http://localhost:9/").await.unwrap_err();
        assert!(error.contains("loopback"), "{error}");
        let resolver = GuardedResolver::new(Arc::new(closed), 9);
        let error = resolver.resolve("localhost".parse().unwrap()).await.err().unwrap().to_string();
        assert!(error.contains("loopback"), "{error}");

        let open = Guard::new(&["127.0.0.1:9".to_owned(), "::1".to_owned()]).unwrap();
        open.check_new_url("http://localhost:9/").await.unwrap();
        let resolver = GuardedResolver::new(Arc::new(open), 9);
        assert!(resolver.resolve("localhost".parse().unwrap()).await.unwrap().count() > 0);
    }
}
