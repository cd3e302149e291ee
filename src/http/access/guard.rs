//! The middleware around every handler: admits a request, or refuses it with the reason.

use axum::extract::{FromRequestParts, MatchedPath, RawPathParams, Request, State};
use axum::http::request::Parts;
use axum::http::{StatusCode, Uri};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use axum::RequestExt as _;

use super::client::Client;
use super::control::{presented, AccessControl};
use super::denial::forbidden;
use super::{journal, route};
use crate::access::{allow, token_like, About, Grant, Need};
use crate::http::error::ApiError;

/// Middleware around every handler.
pub async fn guard(State(access): State<AccessControl>, mut request: Request, next: Next) -> Response {
    match admitted(&access, &mut request).await {
        Ok(None) => next.run(request).await,
        Ok(Some(change)) => journal::run(&access, change, request, next).await,
        Err(refusal) => refusal.into_response(),
    }
}

/// Admits a request, adding its [`Grant`] and [`Client`] to its extensions; returns the change if it is one.
async fn admitted(access: &AccessControl, request: &mut Request) -> Result<Option<journal::Change>, ApiError> {
    refuse_token_in_address(request.uri())?;
    let address = access.0.proxies.client(request);
    let pattern = request.extensions().get::<MatchedPath>().map(|path| path.as_str().to_owned());
    let class = route::classify(request.method(), pattern.as_deref());
    let grant = match class.need {
        // A supervisor needs no token; whoever presents one may learn the reasons.
        Need::Nothing if pattern.as_deref() == Some(route::READINESS) => {
            access.grant(request.headers(), request.version(), address).unwrap_or_else(|_| Grant::nobody())
        }
        Need::Nothing => Grant::nobody(),
        Need::Scope(_) => access.grant(request.headers(), request.version(), address)?,
    };
    let client = Client::new(&grant, address, presented(request.headers()));
    // A supervisor must not be told that an attacker on its machine asks too often.
    if !pattern.as_deref().is_some_and(|pattern| route::PROBES.contains(&pattern)) {
        access.0.limits.take_request(&client.key)?;
    }

    let structure = structure_of(access, class.about, request).await?;
    let about = match (class.about, &structure) {
        (route::Subject::Structure | route::Subject::Job, Some(id)) => About::Structure(id),
        (route::Subject::Filtered, _) => About::Filtered,
        _ => About::Service,
    };
    allow(&grant, class.need, about).map_err(|denied| forbidden(&denied, class.about))?;

    let pattern = pattern.filter(|_| route::is_change(request.method(), class));
    let change = pattern.map(|pattern| journal::change(access, (&grant, &client), request, &pattern, structure));
    let change = change.transpose()?;
    request.extensions_mut().insert(grant);
    request.extensions_mut().insert(client);
    Ok(change)
}

/// The structure that a request is about, from its path or through the diagnosis in its path.
async fn structure_of(
    access: &AccessControl,
    about: route::Subject,
    request: &mut Request,
) -> Result<Option<String>, ApiError> {
    if !matches!(about, route::Subject::Structure | route::Subject::Job) {
        return Ok(None);
    }
    // A path that is not UTF-8 names no structure; the handler reports it.
    let Ok(parameters) = request.extract_parts::<RawPathParams>().await else { return Ok(None) };
    let Some((_, first)) = parameters.iter().next() else { return Ok(None) };
    match about {
        route::Subject::Structure => Ok(Some(first.to_owned())),
        _ => Ok(access.0.store.diagnoses().structure_of_job(first).await?),
    }
}

/// 400 for a token in the URL: it would be stored in the logs of proxies and in the history of browsers.
fn refuse_token_in_address(uri: &Uri) -> Result<(), ApiError> {
    let name = |pair: &str| pair.split('=').next().unwrap_or_default().to_ascii_lowercase();
    let named =
        uri.query().is_some_and(|q| q.split('&').any(|p| ["token", "access_token"].contains(&name(p).as_str())));
    if named || token_like(uri.path()) || uri.query().is_some_and(token_like) {
        let detail = "a token in the URL ends up in logs: send it as Authorization: Bearer mw_…, and rotate this token";
        return Err(ApiError::new(StatusCode::BAD_REQUEST, "token_in_address", detail));
    }
    Ok(())
}

/// Grant of the request, for handlers of lists.
impl<S: Send + Sync> FromRequestParts<S> for Grant {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, ApiError> {
        let missing = || ApiError::internal(&"a route is outside the guard");
        parts.extensions.get::<Self>().cloned().ok_or_else(missing)
    }
}
