//! The scope that each route needs. It follows from rules, so that a new route does not become open to everybody by
//! mistake.

use axum::http::Method;

use crate::access::{Need, Scope};

/// Routes that need no token. They reveal nothing about any structure.
const OPEN: [&str; 6] = ["/", "/healthz", "/readyz", "/version", "/openapi.json", "/docs"];
/// The open route whose findings are explained to those who may read everything.
pub const READINESS: &str = "/readyz";
/// Open routes by which supervisors watch the service: without a rate limit, and answered when all connections are in use.
pub const PROBES: [&str; 2] = ["/healthz", READINESS];
/// Paths of files that need no token.
const OPEN_FOLDERS: [&str; 2] = ["/assets/", "/docs/"];
/// Methods that change something.
const CHANGES: [Method; 4] = [Method::POST, Method::PUT, Method::PATCH, Method::DELETE];
/// Routes that accept batches, and the preview of a table of batches.
const INGEST: [&str; 2] = ["/v1/structures/{id}/batches", "/v1/structures/{id}/tables/preview"];
/// Collections below `/v1` that concern the service itself. Reading them needs the scope admin too.
const SERVICE: [&str; 6] = ["tokens", "audit", "webhooks", "backups", "quarantine", "retention"];
/// Lists over all structures. Their handlers omit what the token may not see.
const FILTERED: [&str; 4] = ["/v1/structures", "/v1/overview", "/v1/jobs", "/v1/events"];

/// Changes that take rights away, make room or end something. They are made, and recorded, also while less space is free than
/// `store.min_free_bytes`, where everything that adds data is refused: nobody must keep a token by filling the disk with it.
///
/// What they need of the last bytes is bounded. All of them need the scope admin, so that a token that may only post or read cannot have an
/// entry of the audit written. An entry has about a kilobyte at most, and below the minimum a client may have 60 of them a minute (`limit`),
/// those of refused requests included: for the 64 MiB of the default it would need half a day.
const TAKE_AWAY: [(Method, &str); 8] = [
    (Method::DELETE, "/v1/tokens/{id}"),
    (Method::POST, "/v1/tokens/{id}/rotation"),
    (Method::DELETE, "/v1/structures/{id}"),
    (Method::DELETE, "/v1/structures/{id}/notes/{note}"),
    (Method::DELETE, "/v1/jobs/{id}"),
    (Method::DELETE, "/v1/webhooks/{id}"),
    (Method::POST, "/v1/webhooks/{id}/secret"),
    (Method::DELETE, "/v1/quarantine/{message}"),
];

/// What a route is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Subject {
    /// The structure named by the first path parameter.
    Structure,
    /// The structure of the diagnosis or training named by the first path parameter.
    Job,
    /// A list that the handler filters.
    Filtered,
    /// The whole service.
    Service,
}

/// Scope that a route needs, and what it is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Class {
    /// The scope that a token needs, if any.
    pub need: Need,
    /// What the route is about.
    pub about: Subject,
}

/// Class of a route by method and pattern. An unknown path needs no token, because it is answered with 404.
pub fn classify(method: &Method, pattern: Option<&str>) -> Class {
    let Some(pattern) = pattern else {
        return Class { need: Need::Nothing, about: Subject::Service };
    };
    let reads = method == Method::GET || method == Method::HEAD;
    let open = OPEN.contains(&pattern) || OPEN_FOLDERS.iter().any(|folder| pattern.starts_with(folder));
    let mut segments = pattern.trim_start_matches('/').split('/');
    let (version, collection, id) = (segments.next(), segments.next(), segments.next());
    let in_service = version == Some("v1") && collection.is_some_and(|c| SERVICE.contains(&c));
    // Open routes support only GET; other methods are answered 405 rather than 401. `tests/access` has a table of all
    // routes and their methods, so that a route that changes something cannot become open unnoticed.
    let need = if open {
        Need::Nothing
    } else if reads && !in_service && (version == Some("v1") || pattern == "/metrics") {
        Need::Scope(Scope::Read)
    } else if method == Method::POST && INGEST.contains(&pattern) {
        Need::Scope(Scope::Ingest)
    } else {
        Need::Scope(Scope::Admin)
    };
    let about = match (version, collection, id) {
        (Some("v1"), Some("structures"), Some(id)) if id.starts_with('{') => Subject::Structure,
        (Some("v1"), Some("diagnoses" | "trainings" | "jobs"), Some(id)) if id.starts_with('{') => Subject::Job,
        _ if reads && FILTERED.contains(&pattern) => Subject::Filtered,
        _ => Subject::Service,
    };
    Class { need, about }
}

/// Whether a request of this class is recorded in the audit.
pub fn is_change(method: &Method, class: Class) -> bool {
    class.need == Need::Scope(Scope::Admin) && CHANGES.contains(method)
}

/// Whether a request takes something away, and is served below the minimum of free space as well.
pub fn takes_away(method: &Method, pattern: &str) -> bool {
    TAKE_AWAY.iter().any(|(of, route)| of == method && *route == pattern)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_served_below_the_floor_is_a_change_of_an_admin() {
        for (method, pattern) in &TAKE_AWAY {
            let class = classify(method, Some(pattern));
            assert!(is_change(method, class), "{method} {pattern}");
        }
    }

    #[test]
    fn a_route_without_a_rule_needs_a_token() {
        let admin = Need::Scope(Scope::Admin);
        let need = |method: Method, pattern| classify(&method, Some(pattern)).need;
        assert_eq!(need(Method::GET, "/secret"), admin);
        assert_eq!(need(Method::POST, "/v1/anything"), admin);
        assert_eq!(need(Method::GET, "/v1/anything"), Need::Scope(Scope::Read));
        assert_eq!(classify(&Method::GET, Some("/v1/anything")).about, Subject::Service);
        assert_eq!(need(Method::GET, "/docsecret"), admin);
        assert_eq!(need(Method::GET, "/v1/webhooks/{id}"), admin);
        assert_eq!(need(Method::from_bytes(b"PROPFIND").unwrap(), "/v1/structures"), admin);
    }
}
