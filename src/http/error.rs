//! The one place where errors meet status codes. Bodies are `application/problem+json` (RFC 9457).

use axum::http::{header, HeaderName, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::Serialize;
use tracing::error;
use utoipa::openapi::schema::{Object, ObjectBuilder, Type};
use utoipa::ToSchema;

use super::bulk::BulkAnswer;

use crate::measurement::check::Problem;
use crate::measurement::json::JsonError;
use crate::monitor;

/// Media type of every answer that is not a success.
pub const PROBLEM_JSON: &str = "application/problem+json";

/// Seconds a client is asked to wait when the queue is full: some hundred assessments fit into one.
const RETRY_AFTER_SECONDS: u32 = 1;

/// Seconds a client is asked to wait for a disk.
const RETRY_AFTER_DISK_SECONDS: u32 = 30;

/// Every `code` of a problem, with its status and meaning; the names are part of the API and never change.
pub const CODES: [(&str, StatusCode, &str); 63] = [
    ("malformed_json", StatusCode::BAD_REQUEST, "the body is no JSON"),
    ("not_utf8", StatusCode::BAD_REQUEST, "the body is no UTF-8 text"),
    ("body_unreadable", StatusCode::BAD_REQUEST, "the body broke off"),
    ("token_in_address", StatusCode::BAD_REQUEST, "a token stands in the address; it belongs into Authorization"),
    ("unauthorized", StatusCode::UNAUTHORIZED, "this needs a token"),
    ("token_expired", StatusCode::UNAUTHORIZED, "the token, or its secret before the last rotation, is good no more"),
    ("token_revoked", StatusCode::UNAUTHORIZED, "the token was revoked"),
    ("forbidden_scope", StatusCode::FORBIDDEN, "the token lacks the scope"),
    ("forbidden_structure", StatusCode::FORBIDDEN, "the token is for other structures"),
    (
        "forbidden_origin",
        StatusCode::FORBIDDEN,
        "without tokens only this machine is served, and no page of another site",
    ),
    ("unknown_route", StatusCode::NOT_FOUND, "nothing is at this path"),
    ("unknown_structure", StatusCode::NOT_FOUND, "no structure of this id"),
    ("unknown_batch", StatusCode::NOT_FOUND, "the structure has no such batch"),
    ("unknown_alarm", StatusCode::NOT_FOUND, "the structure has no such alarm"),
    ("unknown_diagnosis", StatusCode::NOT_FOUND, "no diagnosis of this id"),
    ("unknown_token", StatusCode::NOT_FOUND, "no token of this id"),
    ("unknown_webhook", StatusCode::NOT_FOUND, "no webhook of this id"),
    ("unknown_delivery", StatusCode::NOT_FOUND, "the webhook has no such delivery"),
    ("unknown_message", StatusCode::NOT_FOUND, "no quarantined message of this number"),
    ("unknown_asset", StatusCode::NOT_FOUND, "the dashboard has no such file"),
    ("method_not_allowed", StatusCode::METHOD_NOT_ALLOWED, "the path does not take this method; see Allow"),
    ("not_acceptable", StatusCode::NOT_ACCEPTABLE, "this service does not write the format asked for"),
    ("body_timeout", StatusCode::REQUEST_TIMEOUT, "the body came too slowly"),
    ("no_model", StatusCode::CONFLICT, "the structure has no trained baseline in use"),
    ("structure_in_use", StatusCode::CONFLICT, "the structure has batches under another definition"),
    ("no_report", StatusCode::CONFLICT, "the diagnosis has no report yet"),
    ("no_extension", StatusCode::CONFLICT, "the diagnosis cannot be extended"),
    ("version_changed", StatusCode::CONFLICT, "the structure became another version in the meantime"),
    ("no_step_back", StatusCode::CONFLICT, "the structure extends no earlier version"),
    ("not_assessed", StatusCode::CONFLICT, "the batch has no assessment under the trained baseline in use"),
    ("model_refused", StatusCode::CONFLICT, "the new trained baseline was refused; the one before serves"),
    ("definition_refused", StatusCode::CONFLICT, "this version of the program does not take the stored definition"),
    ("backup_running", StatusCode::CONFLICT, "a backup is being made"),
    ("backup_exists", StatusCode::CONFLICT, "there is a backup of this name"),
    ("token_not_active", StatusCode::CONFLICT, "the token was revoked or has expired"),
    ("last_admin_token", StatusCode::CONFLICT, "it is the last token that manages the service"),
    ("too_many_webhooks", StatusCode::CONFLICT, "there are as many webhooks as there may be"),
    ("already_delivered", StatusCode::CONFLICT, "the receiver took the delivery"),
    ("body_too_large", StatusCode::PAYLOAD_TOO_LARGE, "the body is larger than the limit"),
    ("line_too_large", StatusCode::PAYLOAD_TOO_LARGE, "a line of NDJSON is larger than the limit"),
    ("too_many_lines", StatusCode::PAYLOAD_TOO_LARGE, "NDJSON of more lines than the limit"),
    ("unsupported_media_type", StatusCode::UNSUPPORTED_MEDIA_TYPE, "Content-Type is none that is read here"),
    ("unsupported_encoding", StatusCode::UNSUPPORTED_MEDIA_TYPE, "compressed bodies are not read"),
    ("invalid", StatusCode::UNPROCESSABLE_ENTITY, "a value is out of range; `errors` names each"),
    ("invalid_id", StatusCode::UNPROCESSABLE_ENTITY, "an id that no structure can have"),
    ("invalid_structure", StatusCode::UNPROCESSABLE_ENTITY, "the definition of a structure has mistakes"),
    ("idempotency_key_reused", StatusCode::UNPROCESSABLE_ENTITY, "the key belongs to a batch of other content"),
    ("measurement_exists", StatusCode::UNPROCESSABLE_ENTITY, "a measurement is in a batch of other content"),
    ("unusable_baseline", StatusCode::UNPROCESSABLE_ENTITY, "the batches make no undamaged state"),
    ("too_many_measurements", StatusCode::UNPROCESSABLE_ENTITY, "more measurements than one diagnosis takes"),
    ("first_token_must_be_admin", StatusCode::UNPROCESSABLE_ENTITY, "the first token must be able to make others"),
    ("too_many_requests", StatusCode::TOO_MANY_REQUESTS, "more requests than the limit; see Retry-After"),
    (
        "too_many_measurements_a_second",
        StatusCode::TOO_MANY_REQUESTS,
        "more measurements than the limit; see Retry-After",
    ),
    ("too_many_failures", StatusCode::TOO_MANY_REQUESTS, "too many unknown tokens from one address; see Retry-After"),
    ("internal", StatusCode::INTERNAL_SERVER_ERROR, "the log has the cause under the request id"),
    ("queue_full", StatusCode::SERVICE_UNAVAILABLE, "the queue of assessments is full; see Retry-After"),
    ("too_many_streams", StatusCode::SERVICE_UNAVAILABLE, "as many event streams are open as may be"),
    ("stopping", StatusCode::SERVICE_UNAVAILABLE, "the service stops"),
    ("disk_failed", StatusCode::SERVICE_UNAVAILABLE, "the disk failed; nothing was stored"),
    ("read_only", StatusCode::SERVICE_UNAVAILABLE, "the database may only be read; nothing was stored"),
    ("database_busy", StatusCode::SERVICE_UNAVAILABLE, "the database is busy; nothing was stored"),
    ("database_gone", StatusCode::SERVICE_UNAVAILABLE, "the database was deleted or replaced; nothing is acknowledged"),
    ("disk_full", StatusCode::INSUFFICIENT_STORAGE, "the disk is full; nothing was stored"),
];

/// An answer that is not a success.
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

/// A problem (RFC 9457, `application/problem+json`). Without `type` it is the HTTP status that `title` says; programs go
/// by `code`.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Problem)]
pub struct ProblemBody {
    /// Name of the status.
    title: &'static str,
    /// The HTTP status.
    #[schema(minimum = 400, maximum = 599)]
    status: u16,
    /// What happened and what would be right, for people.
    detail: String,
    #[schema(schema_with = code_schema)]
    code: &'static str,
    /// Each mistake with its place.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    errors: Vec<Problem>,
    /// Id of the request, also in the header `X-Request-Id` and in the log.
    #[serde(skip_serializing_if = "Option::is_none")]
    request_id: Option<String>,
    /// Of a request for many batches that stopped on its way: what was done before.
    #[serde(skip_serializing_if = "Option::is_none")]
    done: Option<Box<BulkAnswer>>,
}

fn code_schema() -> Object {
    let meaning =
        |(code, status, meaning): &(&str, StatusCode, &str)| format!("- `{code}` ({}): {meaning}", status.as_u16());
    let meanings: Vec<String> = CODES.iter().map(meaning).collect();
    let codes = CODES.iter().map(|(code, ..)| *code);
    let description = format!("Stable name of the problem:\n\n{}", meanings.join("\n"));
    ObjectBuilder::new().schema_type(Type::String).enum_values(Some(codes)).description(Some(description)).build()
}

impl ApiError {
    /// An error with a stable code and a sentence for people.
    pub fn new(status: StatusCode, code: &'static str, detail: impl Into<String>) -> Self {
        let (detail, errors, headers) = (detail.into(), Vec::new(), Vec::new());
        Self { status, code, detail, errors, retry_after_s: None, headers, done: None }
    }

    /// With `Retry-After`.
    pub fn with_retry_after(self, seconds: u32) -> Self {
        Self { retry_after_s: Some(seconds), ..self }
    }

    /// With a header of its own.
    pub fn with_header(mut self, name: HeaderName, value: HeaderValue) -> Self {
        self.headers.push((name, value));
        self
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

    /// 503: not now; the client may ask again after so many seconds.
    pub fn unavailable(code: &'static str, detail: impl Into<String>, retry_after_s: u32) -> Self {
        Self { retry_after_s: Some(retry_after_s), ..Self::new(StatusCode::SERVICE_UNAVAILABLE, code, detail) }
    }

    /// The same, with what a request for many batches did before it.
    pub fn after(self, done: BulkAnswer) -> Self {
        Self { done: Some(Box::new(done)), ..self }
    }

    /// The status it is answered with.
    pub const fn status(&self) -> StatusCode {
        self.status
    }

    /// Says where in the request the mistakes were found.
    pub fn at(mut self, pointer: &str) -> Self {
        for problem in &mut self.errors {
            pointer.clone_into(&mut problem.pointer);
        }
        self
    }

    /// The body.
    pub fn into_body(self) -> ProblemBody {
        ProblemBody {
            title: self.status.canonical_reason().unwrap_or("Error"),
            status: self.status.as_u16(),
            detail: self.detail,
            code: self.code,
            errors: self.errors,
            request_id: super::request::current_id(),
            done: self.done,
        }
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
            E::NotAssessed { .. } => Self::new(StatusCode::CONFLICT, "not_assessed", detail),
            E::VersionChanged(_) => Self::new(StatusCode::CONFLICT, "version_changed", detail),
            E::NoStepBack(_) => Self::new(StatusCode::CONFLICT, "no_step_back", detail),
            E::NoModel { .. } => Self::new(StatusCode::CONFLICT, "no_model", detail),
            E::StructureInUse(_) => Self::new(StatusCode::CONFLICT, "structure_in_use", detail),
            E::QueueFull(_) => Self::unavailable("queue_full", detail, RETRY_AFTER_SECONDS),
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

impl From<monitor::DeclareError> for ApiError {
    fn from(error: monitor::DeclareError) -> Self {
        match error {
            monitor::DeclareError::Monitor(error) => error.into(),
            unusable => Self::invalid("unusable_baseline", unusable.to_string(), Vec::new()),
        }
    }
}

impl From<monitor::JobError> for ApiError {
    fn from(error: monitor::JobError) -> Self {
        use monitor::JobError as E;
        let detail = error.to_string();
        match error {
            E::UnknownDiagnosis(_) => Self::new(StatusCode::NOT_FOUND, "unknown_diagnosis", detail),
            E::RepeatedBatch(_) => Self::invalid("unusable_baseline", detail, Vec::new()),
            E::TooManyMeasurements { .. } => Self::invalid("too_many_measurements", detail, Vec::new()),
            E::NoExtension { .. } => Self::new(StatusCode::CONFLICT, "no_extension", detail),
            E::Monitor(error) => error.into(),
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

impl From<crate::store::Error> for ApiError {
    /// What the disk refuses is no bug: the client is told to come again, and the log is not filled with causes.
    fn from(error: crate::store::Error) -> Self {
        let Some(cause) = error.disk_cause() else { return Self::internal(&error) };
        let status = match cause {
            "disk_full" => StatusCode::INSUFFICIENT_STORAGE,
            _ => StatusCode::SERVICE_UNAVAILABLE,
        };
        error!(cause = %error, "Answering {status}: {error}");
        let detail = match cause {
            "disk_full" => {
                "the disk is full: this was not done; reading goes on, and writing as soon as there is room; send it again then"
            }
            "disk_failed" => "the disk failed: this was not done, send it again; the log has the cause under this request id",
            "read_only" => "the database may only be read: this was not done",
            "database_gone" => {
                "the database was deleted or replaced while it was open: nothing more is acknowledged; put it back"
            }
            _ => "the database is busy: this was not done, send it again",
        };
        let wait = if cause == "database_busy" { RETRY_AFTER_SECONDS } else { RETRY_AFTER_DISK_SECONDS };
        Self { retry_after_s: Some(wait), ..Self::new(status, cause, detail) }
    }
}

impl From<crate::store::backup::Error> for ApiError {
    fn from(error: crate::store::backup::Error) -> Self {
        use crate::store::backup::Error as E;
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
