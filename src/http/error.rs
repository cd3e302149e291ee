//! The one place where errors meet status codes. Bodies are `application/problem+json` (RFC 9457).

use axum::http::{header, StatusCode};
use axum::response::{IntoResponse, Response};
use problem_details::ProblemDetails;
use serde::Serialize;
use tracing::error;

use crate::measurement::check::Problem;
use crate::monitor;

/// Seconds a client is asked to wait when the queue is full: some hundred assessments fit into one.
const RETRY_AFTER_SECONDS: u32 = 1;

/// An answer that is not a success.
#[derive(Debug)]
pub struct ApiError {
    status: StatusCode,
    code: &'static str,
    detail: String,
    errors: Vec<Problem>,
    retry_after_s: Option<u32>,
}

/// Members beyond RFC 9457.
#[derive(Debug, Serialize)]
struct Extensions {
    code: &'static str,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    errors: Vec<Problem>,
    #[serde(skip_serializing_if = "Option::is_none")]
    request_id: Option<String>,
}

impl ApiError {
    /// An error with a stable code and a sentence for people.
    pub fn new(status: StatusCode, code: &'static str, detail: impl Into<String>) -> Self {
        Self { status, code, detail: detail.into(), errors: Vec::new(), retry_after_s: None }
    }

    /// 422: it was read, but is not what this API takes.
    pub fn invalid(code: &'static str, detail: impl Into<String>, errors: Vec<Problem>) -> Self {
        Self { errors, ..Self::new(StatusCode::UNPROCESSABLE_ENTITY, code, detail) }
    }

    /// 422 for one field.
    pub fn invalid_field(pointer: impl Into<String>, message: impl Into<String>) -> Self {
        let (pointer, message) = (pointer.into(), message.into());
        Self::invalid("invalid", format!("{pointer}: {message}"), vec![Problem { pointer, message }])
    }

    /// 422 for a list of problems, the first of which becomes the detail.
    pub fn invalid_input(problems: Vec<Problem>) -> Self {
        let detail = problems.first().map_or_else(String::new, |p| format!("{}: {}", p.pointer, p.message));
        Self::invalid("invalid", detail, problems)
    }

    /// 500: logged once, here, with its cause; the client learns nothing internal.
    pub fn internal(cause: &dyn std::fmt::Display) -> Self {
        error!(cause = %cause, "Answering 500: {cause}");
        Self::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            "internal",
            "internal error; the log has the cause under this request id",
        )
    }
}

impl From<monitor::Error> for ApiError {
    fn from(error: monitor::Error) -> Self {
        use monitor::Error as E;
        let detail = error.to_string();
        match error {
            E::UnknownStructure(_) => Self::new(StatusCode::NOT_FOUND, "unknown_structure", detail),
            E::UnknownBatch { .. } => Self::new(StatusCode::NOT_FOUND, "unknown_batch", detail),
            E::UnknownDiagnosis(_) => Self::new(StatusCode::NOT_FOUND, "unknown_diagnosis", detail),
            E::TooManyMeasurements { .. } => Self::invalid("too_many_measurements", detail, Vec::new()),
            E::NoExtension { .. } => Self::new(StatusCode::CONFLICT, "no_extension", detail),
            E::VersionChanged(_) => Self::new(StatusCode::CONFLICT, "version_changed", detail),
            E::NoStepBack(_) => Self::new(StatusCode::CONFLICT, "no_step_back", detail),
            E::NoModel { .. } => Self::new(StatusCode::CONFLICT, "no_model", detail),
            E::StructureInUse(_) => Self::new(StatusCode::CONFLICT, "structure_in_use", detail),
            E::KeyConflict { .. } => Self::invalid("idempotency_key_reused", detail, Vec::new()),
            E::MeasurementConflict { ordinal, .. } => {
                let pointer = format!("/measurements/{ordinal}");
                Self::invalid("measurement_exists", detail.clone(), vec![Problem { pointer, message: detail }])
            }
            E::RepeatedBatch(_) | E::Undamaged(_) | E::Assess { .. } | E::UnfitForUndamaged { .. } => {
                Self::invalid("unusable_baseline", detail, Vec::new())
            }
            E::QueueFull(_) => Self {
                retry_after_s: Some(RETRY_AFTER_SECONDS),
                ..Self::new(StatusCode::SERVICE_UNAVAILABLE, "queue_full", detail)
            },
            E::Store(_) | E::StoredDefinition(_) | E::Panicked => Self::internal(&detail),
        }
    }
}

impl From<crate::store::Error> for ApiError {
    fn from(error: crate::store::Error) -> Self {
        Self::internal(&error)
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let problem =
            ProblemDetails::from_status_code(self.status).with_detail(self.detail).with_extensions(Extensions {
                code: self.code,
                errors: self.errors,
                request_id: super::request::current_id(),
            });
        let mut response = problem.into_response();
        if let Some(seconds) = self.retry_after_s {
            response.headers_mut().insert(header::RETRY_AFTER, seconds.into());
        }
        response
    }
}
