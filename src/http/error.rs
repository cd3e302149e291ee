//! Errors of handlers and the HTTP status and problem body (`application/problem+json`, RFC 9457) of each.

use axum::http::{header, HeaderName, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use tracing::error;

use super::problem::{BulkAnswer, ProblemBody, PROBLEM_JSON};
use super::request_id::current_id;
use crate::measurement::check::Problem;
use crate::measurement::json::JsonError;
use crate::monitor;

/// Value of `Retry-After` when the queue is full, seconds. The service assesses some hundred batches per second.
const RETRY_AFTER_SECONDS: u32 = 1;

/// Value of `Retry-After` when too many computations for readers wait, seconds.
const RETRY_AFTER_READERS_SECONDS: u32 = 5;

/// Value of `Retry-After` when the disk fails, seconds.
const RETRY_AFTER_DISK_SECONDS: u32 = 30;

/// An answer that reports a problem.
#[derive(Debug)]
pub struct ApiError {
    status: StatusCode,
    code: &'static str,
    detail: String,
    errors: Vec<Problem>,
    retry_after_s: Option<u32>,
    headers: Vec<(HeaderName, HeaderValue)>,
    done: Option<Box<BulkAnswer>>,
}

impl ApiError {
    /// 503 for a stored text that is not the JSON that it should be.
    pub fn unreadable(what: &'static str, cause: &serde_json::Error) -> Self {
        crate::monitor::stored::Error::Row { what, detail: cause.to_string() }.into()
    }

    /// A problem with a stable code and a detail for people.
    pub fn new(status: StatusCode, code: &'static str, detail: impl Into<String>) -> Self {
        let (detail, errors, headers) = (detail.into(), Vec::new(), Vec::new());
        Self { status, code, detail, errors, retry_after_s: None, headers, done: None }
    }

    /// Adds a `Retry-After` header.
    pub fn with_retry_after(self, seconds: u32) -> Self {
        Self { retry_after_s: Some(seconds), ..self }
    }

    /// Adds a header.
    pub fn with_header(mut self, name: HeaderName, value: HeaderValue) -> Self {
        self.headers.push((name, value));
        self
    }

    /// 422: the request was readable, but its content is invalid.
    pub fn invalid(code: &'static str, detail: impl Into<String>, errors: Vec<Problem>) -> Self {
        Self { errors, ..Self::new(StatusCode::UNPROCESSABLE_ENTITY, code, detail) }
    }

    /// 422 for one field.
    pub fn invalid_field(pointer: impl Into<String>, message: impl Into<String>) -> Self {
        let (pointer, message) = (pointer.into(), message.into());
        Self::invalid("invalid", format!("{pointer}: {message}"), vec![Problem { pointer, message }])
    }

    /// 422 for a list of problems. The first one becomes the detail.
    pub fn invalid_input(problems: Vec<Problem>) -> Self {
        let detail = problems.first().map_or_else(String::new, |p| format!("{}: {}", p.pointer, p.message));
        Self::invalid("invalid", detail, problems)
    }

    /// 503 with a `Retry-After` header.
    pub fn unavailable(code: &'static str, detail: impl Into<String>, retry_after_s: u32) -> Self {
        Self { retry_after_s: Some(retry_after_s), ..Self::new(StatusCode::SERVICE_UNAVAILABLE, code, detail) }
    }

    /// Adds the outcome of the lines that were processed before this problem.
    pub fn after(self, done: BulkAnswer) -> Self {
        Self { done: Some(Box::new(done)), ..self }
    }

    /// Value of `Retry-After`, seconds.
    pub const fn retry_after_s(&self) -> Option<u32> {
        self.retry_after_s
    }

    /// HTTP status of the answer.
    pub const fn status(&self) -> StatusCode {
        self.status
    }

    /// Whether a request with many batches ends with this problem of one of them, because the problem is not that of the batch: an error of
    /// the service, an exceeded rate limit, or a token that is not valid any more.
    pub fn ends_the_request(&self) -> bool {
        let of_the_client = [StatusCode::TOO_MANY_REQUESTS, StatusCode::UNAUTHORIZED];
        self.status.is_server_error() || of_the_client.contains(&self.status)
    }

    /// Sets the location of all errors in the request.
    pub fn at(mut self, pointer: &str) -> Self {
        for problem in &mut self.errors {
            pointer.clone_into(&mut problem.pointer);
        }
        self
    }

    /// Body of the answer.
    pub fn into_body(self) -> ProblemBody {
        ProblemBody {
            title: self.status.canonical_reason().unwrap_or("Error"),
            status: self.status.as_u16(),
            detail: self.detail,
            code: self.code,
            errors: self.errors,
            request_id: current_id(),
            done: self.done,
        }
    }

    /// 500. The cause is logged here, once, and not shown to the client.
    pub fn internal(cause: &dyn std::fmt::Display) -> Self {
        error!(cause = %cause, "Answering 500: {cause}");
        Self::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            "internal",
            "internal error; the log has its cause under this request id",
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
            E::NotAssessed { .. } => Self::new(StatusCode::CONFLICT, "not_assessed", detail),
            E::VersionChanged(_) => Self::new(StatusCode::CONFLICT, "version_changed", detail),
            E::NoStepBack(_) => Self::new(StatusCode::CONFLICT, "no_step_back", detail),
            E::NoModel { .. } | E::NoEarlierModel { .. } => Self::new(StatusCode::CONFLICT, "no_model", detail),
            E::StructureInUse(_) => Self::new(StatusCode::CONFLICT, "structure_in_use", detail),
            E::QueueFull(_) => Self::unavailable("queue_full", detail, RETRY_AFTER_SECONDS),
            E::TooManyReaders(_) => Self::unavailable("too_many_computations", detail, RETRY_AFTER_READERS_SECONDS),
            E::Store(error) => error.into(),
            E::DefinitionRefused { .. } => Self::new(StatusCode::CONFLICT, "definition_refused", detail),
            E::Definition(_) | E::Panicked => Self::internal(&detail),
        }
    }
}

impl From<monitor::IngestError> for ApiError {
    fn from(error: monitor::IngestError) -> Self {
        use monitor::IngestError as E;
        let detail = error.to_string();
        match error {
            E::KeyConflict { .. } => Self::invalid("idempotency_key_reused", detail, Vec::new()),
            E::MeasurementConflict { ordinal, .. } => {
                let pointer = format!("/measurements/{ordinal}");
                Self::invalid("measurement_exists", detail.clone(), vec![Problem { pointer, message: detail }])
            }
            E::Monitor(error) => error.into(),
        }
    }
}

impl From<monitor::JobError> for ApiError {
    fn from(error: monitor::JobError) -> Self {
        use monitor::JobError as E;
        let detail = error.to_string();
        match error {
            E::UnknownDiagnosis(_) => Self::new(StatusCode::NOT_FOUND, "unknown_diagnosis", detail),
            E::UnknownTraining(_) => Self::new(StatusCode::NOT_FOUND, "unknown_training", detail),
            E::UnknownJob(_) => Self::new(StatusCode::NOT_FOUND, "unknown_job", detail),
            E::NotWaiting(_) => Self::new(StatusCode::CONFLICT, "job_not_waiting", detail),
            E::ResultIsStored(_) => Self::new(StatusCode::CONFLICT, "job_has_ended", detail),
            E::TooManyJobs(_) => Self::unavailable("too_many_jobs", detail, RETRY_AFTER_SECONDS),
            E::TrainingRuns { .. } => Self::new(StatusCode::CONFLICT, "training_runs", detail),
            E::RepeatedBatch(_) => Self::invalid("unusable_baseline", detail, Vec::new()),
            E::TooManyMeasurements { .. } => Self::invalid("too_many_measurements", detail, Vec::new()),
            E::NoExtension { .. } => Self::new(StatusCode::CONFLICT, "no_extension", detail),
            E::Monitor(error) => error.into(),
        }
    }
}

impl From<monitor::DeleteError> for ApiError {
    fn from(error: monitor::DeleteError) -> Self {
        let detail = error.to_string();
        match error {
            monitor::DeleteError::HasJobs { .. } => Self::new(StatusCode::CONFLICT, "structure_has_jobs", detail),
            monitor::DeleteError::Monitor(error) => error.into(),
        }
    }
}

impl From<monitor::ReloadError> for ApiError {
    fn from(error: monitor::ReloadError) -> Self {
        let detail = error.to_string();
        match error {
            monitor::ReloadError::Refused { .. } => Self::new(StatusCode::CONFLICT, "model_refused", detail),
            monitor::ReloadError::Monitor(error) => error.into(),
        }
    }
}

impl From<monitor::BackupError> for ApiError {
    fn from(error: monitor::BackupError) -> Self {
        let detail = error.to_string();
        match error {
            monitor::BackupError::Running => Self::new(StatusCode::CONFLICT, "backup_running", detail),
            monitor::BackupError::Failed(error) => error.into(),
            monitor::BackupError::Monitor(error) => error.into(),
        }
    }
}

impl From<JsonError> for ApiError {
    fn from(error: JsonError) -> Self {
        match error {
            JsonError::Malformed(detail) => Self::new(StatusCode::BAD_REQUEST, "malformed_json", detail),
            JsonError::Shape(problem) => Self::invalid_field(problem.pointer, problem.message),
        }
    }
}

impl From<crate::monitor::stored::Error> for ApiError {
    /// A disk failure, or a row that is damaged, is not an error of the program: the client is asked to repeat the request, and the answer
    /// is not a 500. It does not say that nothing was stored: the call that failed may be one behind the commit.
    fn from(error: crate::monitor::stored::Error) -> Self {
        if matches!(error, crate::monitor::stored::Error::Row { .. }) {
            error!(cause = %error, "Answering 503: {error}");
            let detail = format!("{error}; run `modalwatch doctor`, and restore a backup if it names this");
            let unreadable = Self::new(StatusCode::SERVICE_UNAVAILABLE, "stored_data_unreadable", detail);
            return Self { retry_after_s: Some(RETRY_AFTER_DISK_SECONDS), ..unreadable };
        }
        let Some(cause) = error.disk_cause() else { return Self::internal(&error) };
        let status = match cause {
            "disk_full" => StatusCode::INSUFFICIENT_STORAGE,
            _ => StatusCode::SERVICE_UNAVAILABLE,
        };
        error!(cause = %error, "Answering {status}: {error}");
        let detail = match cause {
            "disk_full" => {
                "the disk is full: whether a change was stored is not known, and a batch can be repeated safely; reading continues, and \
                 writing resumes when there is space; repeat the request then"
            }
            "disk_failed" => {
                "the disk failed: whether a change was stored is not known, and a batch can be repeated safely; the log has the cause \
                 under this request id"
            }
            "read_only" => "the database is read-only: nothing can be stored",
            "database_gone" => {
                "the database was deleted or replaced while it was open: nothing can be stored until it is restored"
            }
            "database_unreachable" => {
                "the database server does not answer: whether a change was stored is not known; repeat it: a batch is stored once, however often it is sent"
            }
            _ => "the database is busy: whether a change was stored is not known, and a batch can be repeated safely",
        };
        let wait = if matches!(cause, "database_busy" | "database_unreachable") {
            RETRY_AFTER_SECONDS
        } else {
            RETRY_AFTER_DISK_SECONDS
        };
        Self { retry_after_s: Some(wait), ..Self::new(status, cause, detail) }
    }
}

impl From<crate::monitor::stored::backup::Error> for ApiError {
    fn from(error: crate::monitor::stored::backup::Error) -> Self {
        use crate::monitor::stored::backup::Error as E;
        let detail = error.to_string();
        match error {
            E::Name(_) => Self::invalid_field("/name", detail),
            E::Exists(_) => Self::new(StatusCode::CONFLICT, "backup_exists", detail),
            E::NoRoom { .. } => Self::new(StatusCode::INSUFFICIENT_STORAGE, "disk_full", detail),
            E::Store(error) => error.into(),
            _ => Self::internal(&detail),
        }
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let (status, retry_after_s, own) = (self.status, self.retry_after_s, self.headers.clone());
        let mut response = (status, Json(self.into_body())).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(PROBLEM_JSON));
        headers.extend(own);
        if let Some(seconds) = retry_after_s {
            headers.insert(header::RETRY_AFTER, seconds.into());
        }
        response
    }
}
