//! What every request passes before its handler: who asks, how often, and whether they may.
//!
//! ```text
//!  request → no token in the address → who (token, or nobody on an open service) → how often → may they?
//!          → an entry of the audit, if it changes something → handler → the entry's status → answer
//! ```
//!
//! Without a stored token and without an admin token file the service is *open*: whoever reaches it may do everything.
//! That is only so on a loopback address, for requests that come from this machine directly.

pub mod audit;
mod client;
pub mod headers;
mod limit;
pub mod route;
pub mod tokens;

use std::net::{IpAddr, SocketAddr};
use std::path::Path;
use std::sync::{Arc, RwLock};

use axum::extract::{FromRequestParts, MatchedPath, RawPathParams, Request, State};
use axum::http::request::Parts;
use axum::http::{header, HeaderMap, HeaderValue, StatusCode, Uri};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use axum::RequestExt as _;
use tracing::{info, warn};

use super::error::ApiError;
use super::HttpSettings;
use crate::access::{
    allow, read_admin_token, token_like, About, AccessSettings, Actor, AdminFileError, Denied, Grant, Need, Refused,
    TokenRecord, TokenTable, TokenText,
};
use crate::monitor::Reason;
use crate::quantity::Timestamp;
use crate::store::{self, Store};
use client::{is_local_name, Proxies};
pub use client::{Client, NotANetwork};
use limit::Limits;
pub use limit::RateLimitSettings;

/// Why the service does not start.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Anybody could reach the service and do everything.
    #[error(
        "{address} can be reached from other machines, and there is no token: make one with \
         `modalwatch token create --name me --scope admin --data-dir {data_dir}`, or give \
         MODALWATCH_ADMIN_TOKEN_FILE, or listen on 127.0.0.1 (access.insecure_public = true serves without)"
    )]
    PublicWithoutTokens {
        /// Where it would listen.
        address: SocketAddr,
        /// Folder of the database.
        data_dir: String,
    },
    /// A proxy stands in front, so that the address says nothing.
    #[error(
        "http.trusted_proxies names a proxy, and there is no token: whoever reaches the proxy could do everything; make \
         one with `modalwatch token create --name me --scope admin --data-dir {data_dir}`"
    )]
    ProxyWithoutTokens {
        /// Folder of the database.
        data_dir: String,
    },
    /// The admin token file.
    #[error(transparent)]
    AdminFile(#[from] AdminFileError),
    /// A proxy that is no address.
    #[error("http.trusted_proxies: {0}")]
    Proxy(#[from] NotANetwork),
    /// The tokens cannot be read.
    #[error(transparent)]
    Store(#[from] store::Error),
}

/// Tokens, limits and audit: a cheap handle.
#[derive(Clone)]
pub struct AccessControl(Arc<Inner>);

struct Inner {
    store: Store,
    /// The stored ones; changed only by [`tokens`], which changes the store first.
    tokens: RwLock<TokenTable>,
    /// The one of the admin token file, if there is one.
    file_token: TokenTable,
    /// One change of tokens at a time.
    changing: tokio::sync::Mutex<()>,
    insecure_public: bool,
    proxies: Proxies,
    limits: Limits,
}

impl AccessControl {
    /// Reads the tokens and looks whether the service may listen on `address` with them.
    ///
    /// # Errors
    /// [`Error`], with what to do.
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
            warn!(%address, "INSECURE: access.insecure_public is set and there is no token: whoever reaches {address} may do everything");
        } else if without && !address.ip().is_loopback() {
            return Err(Error::PublicWithoutTokens { address, data_dir: data_dir() });
        } else if without && !proxies.is_empty() {
            return Err(Error::ProxyWithoutTokens { data_dir: data_dir() });
        } else if without {
            info!("There is no token: programs on this machine may do everything, others cannot reach the service");
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

    /// What somebody who runs the service should know, for `/readyz`.
    pub fn findings(&self) -> Vec<Reason> {
        if self.is_open() && self.0.insecure_public {
            vec![Reason::new("insecure", "there is no token, and access.insecure_public lets everybody in")]
        } else {
            Vec::new()
        }
    }

    /// Whether requests need no token.
    fn is_open(&self) -> bool {
        self.0.file_token.is_empty() && self.read_tokens(TokenTable::is_empty)
    }

    fn read_tokens<T>(&self, read: impl FnOnce(&TokenTable) -> T) -> T {
        read(&self.0.tokens.read().expect("no holder of the lock panics"))
    }

    /// Who a token belongs to.
    fn holder(&self, text: &TokenText) -> Result<Grant, Refused> {
        let now = Timestamp::now();
        let from_file = self.0.file_token.authenticate(text, now).map(TokenRecord::grant);
        let stored = self.read_tokens(|tokens| tokens.authenticate(text, now).map(TokenRecord::grant));
        from_file.or(stored)
    }

    /// Whether what a grant was given for still holds: for answers that go on, such as a stream of events.
    pub fn still_holds(&self, grant: &Grant) -> bool {
        let Actor::Token { id, .. } = grant.actor() else {
            return *grant == Grant::nobody() || self.is_open();
        };
        let now = Timestamp::now();
        let active = |tokens: &TokenTable| tokens.records().any(|t| t.id.as_str() == id && t.is_active(now));
        active(&self.0.file_token) || self.read_tokens(active)
    }

    /// Takes measurements out of what a client may send.
    ///
    /// # Errors
    /// 429.
    pub fn take_measurements(&self, client: &Client, count: usize) -> Result<(), ApiError> {
        self.0.limits.take_measurements(&client.key, count)
    }

    fn grant(&self, headers: &HeaderMap, client: Option<IpAddr>) -> Result<Grant, ApiError> {
        if self.is_open() {
            return if self.0.insecure_public { Ok(Grant::local()) } else { directly_from_here(headers) };
        }
        let mut given = headers.get_all(header::AUTHORIZATION).iter();
        let (Some(value), None) = (given.next(), given.next()) else {
            return Err(unauthorized("this needs a token: send it as Authorization: Bearer mw_…", None));
        };
        let bearer = value.to_str().ok().and_then(|text| text.split_once(' '));
        let Some((_, text)) = bearer.filter(|(scheme, _)| scheme.eq_ignore_ascii_case("bearer")) else {
            return Err(unauthorized("only bearer tokens are taken: Authorization: Bearer mw_…", None));
        };
        let Ok(text) = TokenText::parse(text.trim()) else {
            return Err(self.failed(client, &Refused::Unknown));
        };
        self.holder(&text).map_err(|refused| self.failed(client, &refused))
    }

    /// A token that opens nothing: 401, and 429 for an address that tries one after the other.
    ///
    /// A known token always passes, also from such an address: many clients may share it.
    fn failed(&self, client: Option<IpAddr>, refused: &Refused) -> ApiError {
        let code = match refused {
            Refused::Unknown => "unauthorized",
            Refused::Expired(_) | Refused::RotatedOut(_) => "token_expired",
            Refused::Revoked(_) => "token_revoked",
        };
        metrics::counter!("modalwatch_authentication_failures_total", "code" => code).increment(1);
        if *refused == Refused::Unknown {
            if let Err(error) = self.0.limits.count_failure(client) {
                return error;
            }
        }
        unauthorized(&refused.to_string(), Some(code))
    }
}

/// The guard itself: a middleware around every handler.
pub async fn guard(State(access): State<AccessControl>, mut request: Request, next: Next) -> Response {
    match admitted(&access, &mut request).await {
        Ok(None) => next.run(request).await,
        Ok(Some(entry)) => audit::run(&access, entry, request, next).await,
        Err(refusal) => refusal.into_response(),
    }
}

/// Lets a request in, with its [`Grant`] and [`Client`] among its extensions; gives the entry for the audit if it is a change.
async fn admitted(access: &AccessControl, request: &mut Request) -> Result<Option<store::NewAuditEntry>, ApiError> {
    refuse_token_in_address(request.uri())?;
    let address = access.0.proxies.client(request);
    let pattern = request.extensions().get::<MatchedPath>().map(|path| path.as_str().to_owned());
    let class = route::classify(request.method(), pattern.as_deref());
    let grant = match class.need {
        Need::Nothing => Grant::nobody(),
        Need::Scope(_) => access.grant(request.headers(), address)?,
    };
    let client = Client::new(&grant, address);
    access.0.limits.take_request(&client.key)?;

    let structure = structure_of(access, class.about, request).await?;
    let about = match (class.about, &structure) {
        (route::AboutWhat::Structure | route::AboutWhat::Diagnosis, Some(id)) => About::Structure(id),
        (route::AboutWhat::Filtered, _) => About::Filtered,
        _ => About::Service,
    };
    allow(&grant, class.need, about).map_err(forbidden)?;

    let pattern = pattern.filter(|_| route::is_change(request.method(), class));
    let entry = pattern.map(|pattern| audit::entry(&grant, &client, request, &pattern, structure));
    request.extensions_mut().insert(grant);
    request.extensions_mut().insert(client);
    Ok(entry)
}

/// The structure that a request is about, as it came or as the diagnosis has it.
async fn structure_of(
    access: &AccessControl,
    about: route::AboutWhat,
    request: &mut Request,
) -> Result<Option<String>, ApiError> {
    if !matches!(about, route::AboutWhat::Structure | route::AboutWhat::Diagnosis) {
        return Ok(None);
    }
    // A path that is no UTF-8 names no structure; the handler says so.
    let Ok(parameters) = request.extract_parts::<RawPathParams>().await else { return Ok(None) };
    let Some((_, first)) = parameters.iter().next() else { return Ok(None) };
    match about {
        route::AboutWhat::Structure => Ok(Some(first.to_owned())),
        _ => Ok(access.0.store.diagnoses().structure_of_diagnosis(first).await?),
    }
}

/// 400 for a token in the address: it would stand in the logs of proxies and in the history of browsers.
fn refuse_token_in_address(uri: &Uri) -> Result<(), ApiError> {
    let name = |pair: &str| pair.split('=').next().unwrap_or_default().to_ascii_lowercase();
    let named =
        uri.query().is_some_and(|q| q.split('&').any(|p| ["token", "access_token"].contains(&name(p).as_str())));
    if named || token_like(uri.path()) || uri.query().is_some_and(token_like) {
        let detail =
            "a token in the address ends up in logs: send it as Authorization: Bearer mw_…, and rotate this one";
        return Err(ApiError::new(StatusCode::BAD_REQUEST, "token_in_address", detail));
    }
    Ok(())
}

/// On an open service: only programs of this machine, and no page of another site in a browser here.
fn directly_from_here(headers: &HeaderMap) -> Result<Grant, ApiError> {
    let forwarded = ["forwarded", "x-forwarded-for", "x-forwarded-host", "x-real-ip", "via"];
    if forwarded.into_iter().any(|name| headers.contains_key(name)) {
        let detail = "this came through a proxy, and without a token only this machine is served: make a token first \
                      (modalwatch token create)";
        return Err(unauthorized(detail, None));
    }
    let host = |name: header::HeaderName| headers.get(name).map(|value| value.to_str().unwrap_or(".").to_owned());
    // `Host` by a page whose name was pointed at this machine, `Origin` by any other.
    let foreign = host(header::HOST).is_some_and(|host| !is_local_name(&host))
        || host(header::ORIGIN).is_some_and(|origin| !is_local_name(origin.split("//").last().unwrap_or(".")));
    if foreign {
        let detail =
            "this comes from a page of another site or under another name than localhost, and without a token \
                      only this machine is served: make a token first (modalwatch token create)";
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

#[expect(clippy::needless_pass_by_value, reason = "the shape that map_err takes")]
fn forbidden(denied: Denied) -> ApiError {
    let detail = denied.to_string();
    match denied {
        Denied::Scope { needed, .. } => {
            let challenge = format!("Bearer realm=\"modalwatch\", error=\"insufficient_scope\", scope=\"{needed}\"");
            let challenge = HeaderValue::from_str(&challenge).expect("a scope is plain text");
            ApiError::new(StatusCode::FORBIDDEN, "forbidden_scope", detail)
                .with_header(header::WWW_AUTHENTICATE, challenge)
        }
        Denied::Structure { .. } | Denied::WholeService => {
            ApiError::new(StatusCode::FORBIDDEN, "forbidden_structure", detail)
        }
    }
}

/// The grant of the request, for handlers of lists.
impl<S: Send + Sync> FromRequestParts<S> for Grant {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, ApiError> {
        let missing = || ApiError::internal(&"a route is outside the guard");
        parts.extensions.get::<Self>().cloned().ok_or_else(missing)
    }
}
