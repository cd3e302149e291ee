//! The answers before the service has read its structures: it is alive, and not ready yet.

use axum::http::StatusCode;
use axum::response::{IntoResponse as _, Response};
use axum::Json;
use serde_json::json;

use super::error::ApiError;

/// Value of `Retry-After`, seconds.
const RETRY_AFTER_S: u32 = 2;

/// The answer to a request for `path`.
pub fn answer(path: &str) -> Response {
    let message = "the service is starting: it reads its structures and trained models";
    match path {
        "/healthz" => Json(json!({ "status": "alive" })).into_response(),
        "/readyz" => {
            let body = json!({
                "ready": false,
                "reasons": [{ "code": "starting", "message": message }],
                "findings": [],
                "role": "starting",
                "baselines_in_use": 0,
                "baselines_refused": [],
                "free_places_in_queue": 0,
            });
            (StatusCode::SERVICE_UNAVAILABLE, Json(body)).into_response()
        }
        _ => ApiError::unavailable("starting", message, RETRY_AFTER_S).into_response(),
    }
}
