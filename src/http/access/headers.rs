//! Security headers of every answer. A header that the handler sets is kept.

use axum::extract::Request;
use axum::http::{header, HeaderMap, HeaderName, HeaderValue};
use axum::middleware::Next;
use axum::response::Response;

/// Content security policy of pages that do not set one: only files of this service.
const PAGE_POLICY: &str = "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; \
     object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
/// Content security policy of all other answers: a browser that shows them loads and runs nothing.
const DATA_POLICY: &str = "default-src 'none'; frame-ancestors 'none'";

/// Headers of every answer.
const ALWAYS: [(HeaderName, &str); 5] = [
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::REFERRER_POLICY, "no-referrer"),
    (header::X_FRAME_OPTIONS, "DENY"),
    (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
];

/// Middleware that adds the headers. (`Strict-Transport-Security` belongs to the proxy that terminates TLS.)
pub async fn secure(request: Request, next: Next) -> Response {
    let api = request.uri().path().starts_with("/v1");
    let mut response = next.run(request).await;
    let headers = response.headers_mut();
    for (name, value) in ALWAYS {
        unless_set(headers, name, value);
    }
    let content_type = headers.get(header::CONTENT_TYPE).map(HeaderValue::as_bytes).unwrap_or_default();
    let policy = if content_type.starts_with(b"text/html") { PAGE_POLICY } else { DATA_POLICY };
    unless_set(headers, header::CONTENT_SECURITY_POLICY, policy);
    if api {
        unless_set(headers, header::CACHE_CONTROL, "no-store");
    }
    response
}

fn unless_set(headers: &mut HeaderMap, name: HeaderName, value: &'static str) {
    headers.entry(name).or_insert(HeaderValue::from_static(value));
}

#[cfg(test)]
mod tests {
    use axum::body::Body;
    use axum::response::Html;
    use axum::routing::get;
    use axum::{middleware, Router};
    use tower::Service as _;

    use super::*;

    #[tokio::test]
    async fn what_a_handler_sets_stays_and_pages_load_only_files_of_this_service() {
        const OWN: [(HeaderName, &str); 2] = [
            (header::CONTENT_SECURITY_POLICY, "default-src 'none'; img-src data:"),
            (header::CACHE_CONTROL, "max-age=60"),
        ];
        let mut router = Router::new()
            .route("/v1/own", get(|| async { (OWN, Html("x")) }))
            .route("/page", get(|| async { Html("x") }))
            .layer(middleware::from_fn(secure));
        let mut headers = async |path: &str| {
            let request = Request::builder().uri(path).body(Body::empty()).unwrap();
            router.call(request).await.unwrap().headers().clone()
        };
        let own = headers("/v1/own").await;
        for (name, value) in OWN {
            assert_eq!(own.get_all(&name).iter().collect::<Vec<_>>(), [value], "{name}");
        }
        assert_eq!(headers("/page").await[header::CONTENT_SECURITY_POLICY], PAGE_POLICY);
    }
}
