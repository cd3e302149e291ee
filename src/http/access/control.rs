//! Tokens, rate limits and trusted proxies of the service, and the authentication of requests.

use std::net::{IpAddr, SocketAddr};
use std::path::Path;
use std::sync::{Arc, RwLock};

use axum::http::{header, HeaderMap, HeaderValue, StatusCode, Version};
use tracing::{info, warn};

use super::client::{is_local_name, is_same_origin, Client, Key, NotANetwork, Proxies};
use super::limit::Limits;
use crate::access::{
    read_admin_token, AccessSettings, Actor, AdminFileError, Grant, Refused, TokenRecord, TokenTable, TokenText,
};
use crate::clock;
use crate::http::error::ApiError;
use crate::http::settings::HttpSettings;
use crate::monitor::Reason;
use crate::store::{self, Store};

/// What is answered to a request without a token.
const NO_TOKEN: &str = "this request needs a token: send it as Authorization: Bearer mw_…";

/// Why the service does not start.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Everybody could reach the service and change everything.
    #[error(
        "{address} can be reached from other machines, and there is no token: create one with \
         `modalwatch token create --name me --scope admin --data-dir {data_dir}`, or set \
         MODALWATCH_ADMIN_TOKEN_FILE, or listen on 127.0.0.1 (access.insecure_public = true allows this without a token)"
    )]
    PublicWithoutTokens {
        /// Address on which the service would listen.
        address: SocketAddr,
        /// Folder of the database.
        data_dir: String,
    },
    /// Requests come through a proxy, so that the listen address does not restrict who can reach the service.
    #[error(
        "http.trusted_proxies names a proxy, and there is no token: everybody who reaches the proxy could change everything; \
         create one with `modalwatch token create --name me --scope admin --data-dir {data_dir}`"
    )]
    ProxyWithoutTokens {
        /// Folder of the database.
        data_dir: String,
    },
    /// The admin token file cannot be used.
    #[error(transparent)]
    AdminFile(#[from] AdminFileError),
    /// A trusted proxy is not an address or network.
    #[error("http.trusted_proxies: {0}")]
    Proxy(#[from] NotANetwork),
    /// The tokens cannot be read.
    #[error(transparent)]
    Store(#[from] store::Error),
}

/// Tokens, rate limits and audit of the service. Cloning is cheap.
#[derive(Clone)]
pub struct AccessControl(pub(super) Arc<Inner>);

pub(super) struct Inner {
    pub(super) store: Store,
    /// Stored tokens; changed only by `issue`, which changes the store first.
    pub(super) tokens: RwLock<TokenTable>,
    /// The token of the admin token file, if there is one.
    pub(super) file_token: TokenTable,
    /// Held while tokens are changed.
    pub(super) changing: tokio::sync::Mutex<()>,
    pub(super) insecure_public: bool,
    pub(super) proxies: Proxies,
    pub(super) limits: Limits,
}

impl AccessControl {
    /// Reads the tokens and checks whether the service may listen on `address` with them.
    ///
    /// # Errors
    /// [`Error`], with the remedy.
    pub async fn open(
        store: Store,
        settings: &AccessSettings,
        http: &HttpSettings,
        (address, data_dir): (SocketAddr, &Path),
        largest_batch: usize,
    ) -> Result<Self, Error> {
        let tokens: TokenTable = store.tokens().list().await?.into_iter().collect();
        let file_token: TokenTable =
            settings.admin_token_file.as_deref().map(read_admin_token).transpose()?.into_iter().collect();
        let proxies = Proxies::parse(&http.trusted_proxies)?;
        let without = tokens.is_empty() && file_token.is_empty();
        let data_dir = || data_dir.display().to_string();
        if without && settings.insecure_public {
            warn!(%address, "INSECURE: access.insecure_public is set and there is no token: everybody who reaches {address} may change everything");
        } else if without && !address.ip().is_loopback() {
            return Err(Error::PublicWithoutTokens { address, data_dir: data_dir() });
        } else if without && !proxies.is_empty() {
            return Err(Error::ProxyWithoutTokens { data_dir: data_dir() });
        } else if without {
            info!("There is no token: programs on this machine may change everything, others cannot reach the service");
        }
        Ok(Self(Arc::new(Inner {
            store,
            tokens: RwLock::new(tokens),
            file_token,
            changing: tokio::sync::Mutex::default(),
            insecure_public: settings.insecure_public,
            proxies,
            limits: Limits::new(&http.rate_limit, largest_batch),
        })))
    }

    /// Findings for `/readyz`.
    pub fn findings(&self) -> Vec<Reason> {
        if self.is_open() && self.0.insecure_public {
            vec![Reason::new("insecure", "there is no token, and access.insecure_public allows every request")]
        } else {
            Vec::new()
        }
    }

    /// Whether requests need no token.
    pub(super) fn is_open(&self) -> bool {
        self.0.file_token.is_empty() && self.read_tokens(TokenTable::is_empty)
    }

    /// Calls `read` with the stored tokens and returns its result.
    pub fn read_tokens<T>(&self, read: impl FnOnce(&TokenTable) -> T) -> T {
        read(&self.0.tokens.read().expect("no holder of the lock panics"))
    }

    /// The grant of the token that a client presents.
    fn holder(&self, text: &TokenText) -> Result<Grant, Refused> {
        let now = clock::now();
        let from_file = self.0.file_token.authenticate(text, now).map(TokenRecord::grant);
        let stored = self.read_tokens(|tokens| tokens.authenticate(text, now).map(TokenRecord::grant));
        from_file.or(stored)
    }

    /// Looks again at the token of a request that goes on: it may have expired or have been revoked, or its secret may have been replaced.
    /// This costs a hash, so that it can be done before each batch that is taken and each part that is sent.
    ///
    /// # Errors
    /// 401 if the client would not be given its rights any more.
    pub fn look_again(&self, client: &Client) -> Result<(), ApiError> {
        let no_more = |refused: Refused| unauthorized(&refused.to_string(), Some(code_of(&refused)));
        match (client.grant.actor(), &client.presented) {
            (Actor::Token { .. }, Some(text)) => self.holder(text).map(drop).map_err(no_more),
            (Actor::Local | Actor::Nobody, _) if client.grant == Grant::nobody() || self.is_open() => Ok(()),
            _ => Err(unauthorized(NO_TOKEN, None)),
        }
    }

    /// Whether a request has a valid token. A failure is not counted.
    pub fn knows(&self, headers: &HeaderMap) -> bool {
        presented(headers).is_some_and(|text| self.holder(&text).is_ok())
    }

    /// Key under which the connections of an address are counted; `None` for a trusted proxy, whose connections are those of many
    /// clients.
    pub fn connection_key(&self, peer: IpAddr) -> Option<Key> {
        self.0.proxies.connection_key(peer)
    }

    /// Counts the measurements of the next batch against the rate limit of the client, whose token is looked at again: one request may have
    /// many batches, and a body may arrive slowly.
    ///
    /// # Errors
    /// 401 if the token is not valid any more, 429 if the limit is exceeded.
    pub fn take_measurements(&self, client: &Client, count: usize) -> Result<(), ApiError> {
        self.look_again(client)?;
        self.0.limits.take_measurements(&client.key, count)
    }

    pub(super) fn grant(
        &self,
        headers: &HeaderMap,
        version: Version,
        client: Option<IpAddr>,
    ) -> Result<Grant, ApiError> {
        if self.is_open() {
            return if self.0.insecure_public {
                Ok(Grant::local())
            } else {
                directly_from_here(headers, version, client)
            };
        }
        let mut given = headers.get_all(header::AUTHORIZATION).iter();
        let (Some(value), None) = (given.next(), given.next()) else {
            return Err(unauthorized(NO_TOKEN, None));
        };
        let bearer = value.to_str().ok().and_then(|text| text.split_once(' '));
        let Some((_, text)) = bearer.filter(|(scheme, _)| scheme.eq_ignore_ascii_case("bearer")) else {
            return Err(unauthorized("only bearer tokens are accepted: Authorization: Bearer mw_…", None));
        };
        let Ok(text) = TokenText::parse(text.trim()) else {
            return Err(self.failed(client, &Refused::Unknown));
        };
        self.holder(&text).map_err(|refused| self.failed(client, &refused))
    }

    /// 401 for an invalid token, and 429 for an address that tries many of them.
    ///
    /// A valid token is always accepted, also from such an address: many clients may share it.
    fn failed(&self, client: Option<IpAddr>, refused: &Refused) -> ApiError {
        let code = code_of(refused);
        metrics::counter!("modalwatch_authentication_failures_total", "code" => code).increment(1);
        if *refused == Refused::Unknown {
            if let Err(error) = self.0.limits.count_failure(client) {
                return error;
            }
        }
        unauthorized(&refused.to_string(), Some(code))
    }
}

/// The code of a problem.
const fn code_of(refused: &Refused) -> &'static str {
    match refused {
        Refused::Unknown => "unauthorized",
        Refused::Expired(_) | Refused::RotatedOut(_) => "token_expired",
        Refused::Revoked(_) => "token_revoked",
    }
}

/// The token that a request presents, if it has the form of one.
pub(super) fn presented(headers: &HeaderMap) -> Option<TokenText> {
    let (scheme, text) = headers.get(header::AUTHORIZATION)?.to_str().ok()?.split_once(' ')?;
    scheme.eq_ignore_ascii_case("bearer").then(|| TokenText::parse(text.trim()).ok()).flatten()
}

/// Grant of a request to an open service: only for programs on this machine, and not for pages of other web sites in a
/// browser on it, nor for a frame without an origin.
///
/// A proxy that adds no header and speaks HTTP/1.1 cannot be told from a program on this machine; nginx speaks HTTP/1.0 unless it is
/// configured otherwise, which programs of today do not.
fn directly_from_here(headers: &HeaderMap, version: Version, client: Option<IpAddr>) -> Result<Grant, ApiError> {
    // An open service listens on the loopback only, but another node may pass on what it received from elsewhere.
    if client.is_some_and(|address| !address.to_canonical().is_loopback()) {
        let detail = "this request comes from another machine, and without tokens only this machine is served: create a token first (modalwatch token create)";
        return Err(unauthorized(detail, None));
    }
    let forwarded = ["forwarded", "x-forwarded-for", "x-forwarded-host", "x-real-ip", "via"];
    if version < Version::HTTP_11 || forwarded.into_iter().any(|name| headers.contains_key(name)) {
        let detail =
            "this request came through a proxy, or by HTTP/1.0 as from one, and without tokens only this machine is served: create a \
             token first (modalwatch token create)";
        return Err(unauthorized(detail, None));
    }
    let text = |name: &str| headers.get(name).map(|value| value.to_str().unwrap_or("?"));
    // `Host` differs if the page's domain name resolves to this machine (DNS rebinding), `Origin` for any other page; a browser states
    // in `Sec-Fetch-Site` where a request without `Origin` comes from.
    let host = text("host").unwrap_or_default();
    let from_elsewhere = text("sec-fetch-site").is_some_and(|site| !["same-origin", "none"].contains(&site));
    let by_address = text("sec-fetch-mode") == Some("navigate");
    if !is_local_name(host)
        || text("origin").is_some_and(|origin| !is_same_origin(origin, host))
        || (from_elsewhere && !by_address)
    {
        let detail =
            "this request comes from a page of another web site or uses another host name than localhost, and without tokens \
             only this machine is served: create a token first (modalwatch token create)";
        return Err(ApiError::new(StatusCode::FORBIDDEN, "forbidden_origin", detail));
    }
    Ok(Grant::local())
}

fn unauthorized(detail: &str, code: Option<&'static str>) -> ApiError {
    let challenge = match code {
        None => HeaderValue::from_static("Bearer realm=\"modalwatch\""),
        Some(_) => HeaderValue::from_static("Bearer realm=\"modalwatch\", error=\"invalid_token\""),
    };
    ApiError::new(StatusCode::UNAUTHORIZED, code.unwrap_or("unauthorized"), detail)
        .with_header(header::WWW_AUTHENTICATE, challenge)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_open_service_serves_this_machine_only_whoever_passes_the_request_on() {
        let mut headers = HeaderMap::new();
        headers.insert(header::HOST, HeaderValue::from_static("localhost"));
        let grant = |client: &str| directly_from_here(&headers, Version::HTTP_11, Some(client.parse().unwrap()));
        for (client, is_here) in [
            ("127.0.0.1", true),
            ("::1", true),
            ("::ffff:127.0.0.1", true),
            ("192.0.2.1", false),
            ("2001:db8::1", false),
        ] {
            assert_eq!(grant(client).is_ok(), is_here, "{client}");
        }
    }
}
