//! `/openapi.json` and `/docs/api-explorer/`: the OpenAPI document, and the interactive page (Swagger UI) that shows it. Both are part
//! of the program; nothing is fetched from elsewhere.

use std::sync::Arc;

use axum::body::{Body, Bytes};
use axum::extract::Path;
use axum::http::{header, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::Router;
use utoipa::openapi::OpenApi;
use utoipa_swagger_ui::Config;

use super::error::ApiError;

/// Scripts and styles are loaded from this service only, and none may be inline. Swagger UI draws its arrows as `data:` images.
pub(super) const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; \
                      connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// The document as it is sent to a client.
pub fn json(document: &OpenApi) -> String {
    serde_json::to_string(document).expect("a document is plain data")
}

/// The routes that serve the document and the page; the document does not describe them.
pub(super) fn router<S: Clone + Send + Sync + 'static>(document: &OpenApi) -> Router<S> {
    let json = Bytes::from(json(document));
    // The path is relative, so that it also works behind a proxy that adds a prefix. No validator on the internet is
    // used.
    let config = Config::from("../../openapi.json").validator_url("none").try_it_out_enabled(true).use_base_layout();
    let config = Arc::new(config);
    let file = move |name: String| {
        let config = Arc::clone(&config);
        async move { page(&name, config) }
    };
    let index = file.clone();
    let to_folder = || async { (StatusCode::PERMANENT_REDIRECT, [(header::LOCATION, "api-explorer/")]) };
    Router::new()
        .route("/openapi.json", get(move || async move { ([(header::CONTENT_TYPE, "application/json")], json) }))
        .route("/docs/api-explorer", get(to_folder))
        .route("/docs/api-explorer/", get(move || index("index.html".to_owned())))
        .route("/docs/api-explorer/{file}", get(move |Path(name): Path<String>| file(name)))
}

/// Whether the explorer has a file of this name.
pub(super) fn has(name: &str) -> bool {
    let config = Arc::new(Config::from(""));
    utoipa_swagger_ui::serve(name, config).is_ok_and(|file| file.is_some())
}

fn page(name: &str, config: Arc<Config<'static>>) -> Result<Response, ApiError> {
    let unknown = || ApiError::new(StatusCode::NOT_FOUND, "unknown_route", "the API explorer has no such file");
    let found = utoipa_swagger_ui::serve(name, config).map_err(|e| ApiError::internal(&e))?.ok_or_else(unknown)?;
    let mut response = Body::from(found.bytes.into_owned()).into_response();
    let headers = response.headers_mut();
    let content_type = HeaderValue::from_str(&found.content_type).map_err(|e| ApiError::internal(&e))?;
    headers.insert(header::CONTENT_TYPE, content_type);
    if found.gzpipped {
        // The files are stored compressed in the program; every browser accepts gzip.
        headers.insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
    }
    headers.insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY));
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    Ok(response)
}
