//! The answer to a request that its token does not allow.

use axum::http::{header, HeaderValue, StatusCode};

use super::route::Subject;
use crate::access::Denied;
use crate::http::error::ApiError;

/// 403 with the reason, for a request about a subject.
pub(super) fn forbidden(denied: &Denied, about: Subject) -> ApiError {
    let detail = match (denied, about) {
        // The client has named a diagnosis or training: it must not learn from it which other structures exist.
        (Denied::Structure { .. }, Subject::Job) => {
            "this token is limited to structures other than that of this diagnosis or training".to_owned()
        }
        _ => denied.to_string(),
    };
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
        Denied::Source { .. } => ApiError::new(StatusCode::FORBIDDEN, "forbidden_source", detail),
    }
}
