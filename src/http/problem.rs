//! Problems (RFC 9457) and the answer to many batches, which contain each other.

use axum::http::StatusCode;
use serde::Serialize;
use utoipa::openapi::schema::{Object, ObjectBuilder, Type};
use utoipa::ToSchema;

use crate::assessment::BatchState;
use crate::measurement::check::Problem;
use crate::measurement::table::understood::Understood;
use crate::quantity::Timestamp;

/// Media type of every answer that reports a problem.
pub const PROBLEM_JSON: &str = "application/problem+json";

/// Every `code` of a problem with its status and meaning. The codes are part of the API and never change.
pub const CODES: [(&str, StatusCode, &str); 89] = [
    ("malformed_json", StatusCode::BAD_REQUEST, "the body is not valid JSON"),
    ("not_utf8", StatusCode::BAD_REQUEST, "the body is not UTF-8 text"),
    ("body_unreadable", StatusCode::BAD_REQUEST, "the connection broke before the end of the body"),
    ("token_in_address", StatusCode::BAD_REQUEST, "the URL contains a token; send it in the Authorization header"),
    ("unauthorized", StatusCode::UNAUTHORIZED, "this request needs a token"),
    ("token_expired", StatusCode::UNAUTHORIZED, "the token, or its secret from before the last rotation, has expired"),
    ("token_revoked", StatusCode::UNAUTHORIZED, "the token was revoked"),
    ("forbidden_scope", StatusCode::FORBIDDEN, "the token does not have the required scope"),
    ("forbidden_structure", StatusCode::FORBIDDEN, "the token is limited to other structures"),
    ("forbidden_source", StatusCode::FORBIDDEN, "the token is limited to other sources"),
    (
        "forbidden_origin",
        StatusCode::FORBIDDEN,
        "without tokens the service answers only this machine, and no pages of other web sites",
    ),
    ("client_left", StatusCode::BAD_REQUEST, "the client left before its request was done, and nothing was changed"),
    ("unknown_route", StatusCode::NOT_FOUND, "this path does not exist"),
    ("unknown_structure", StatusCode::NOT_FOUND, "there is no structure with this id"),
    ("unknown_batch", StatusCode::NOT_FOUND, "the structure has no such batch"),
    ("unknown_alarm", StatusCode::NOT_FOUND, "the structure has no such alarm"),
    ("unknown_note", StatusCode::NOT_FOUND, "the structure has no such note"),
    ("unknown_diagnosis", StatusCode::NOT_FOUND, "there is no diagnosis with this id"),
    ("unknown_training", StatusCode::NOT_FOUND, "there is no training with this id"),
    ("unknown_job", StatusCode::NOT_FOUND, "no job with this id runs or waits"),
    ("unknown_token", StatusCode::NOT_FOUND, "there is no token with this id"),
    ("unknown_webhook", StatusCode::NOT_FOUND, "there is no webhook with this id"),
    ("unknown_delivery", StatusCode::NOT_FOUND, "the webhook has no such delivery"),
    ("unknown_message", StatusCode::NOT_FOUND, "there is no quarantined message with this number"),
    ("unknown_asset", StatusCode::NOT_FOUND, "the dashboard has no such file"),
    (
        "method_not_allowed",
        StatusCode::METHOD_NOT_ALLOWED,
        "the path does not support this method; see the Allow header",
    ),
    ("not_acceptable", StatusCode::NOT_ACCEPTABLE, "the service cannot write the requested format"),
    ("body_timeout", StatusCode::REQUEST_TIMEOUT, "the body did not arrive in time"),
    ("no_model", StatusCode::CONFLICT, "the structure, or its version that was asked for, has no trained model"),
    ("structure_in_use", StatusCode::CONFLICT, "the structure has batches under another definition"),
    ("no_report", StatusCode::CONFLICT, "the diagnosis has no report yet"),
    ("no_extension", StatusCode::CONFLICT, "the structure cannot be extended by this diagnosis"),
    ("training_runs", StatusCode::CONFLICT, "a training of the structure runs or waits"),
    ("job_not_waiting", StatusCode::CONFLICT, "the job runs already"),
    ("job_has_ended", StatusCode::CONFLICT, "the job has ended: its result is being stored"),
    ("version_changed", StatusCode::CONFLICT, "the structure was changed to another version in the meantime"),
    ("no_step_back", StatusCode::CONFLICT, "the present version of the structure is not an extension"),
    ("not_assessed", StatusCode::CONFLICT, "the batch has no assessment by the trained model in use"),
    ("model_refused", StatusCode::CONFLICT, "the new trained model was refused; the previous one stays in use"),
    ("definition_refused", StatusCode::CONFLICT, "this version of the program does not accept the stored definition"),
    ("backup_running", StatusCode::CONFLICT, "a backup is being made"),
    ("backup_exists", StatusCode::CONFLICT, "a backup with this name exists"),
    ("token_not_active", StatusCode::CONFLICT, "the token was revoked or has expired"),
    ("last_admin_token", StatusCode::CONFLICT, "this is the last token that can manage the service"),
    ("too_many_webhooks", StatusCode::CONFLICT, "the maximum number of webhooks exists"),
    ("no_webhook_secret", StatusCode::CONFLICT, "the webhook was restored without its secret and needs a new one"),
    ("structure_has_jobs", StatusCode::CONFLICT, "jobs of the structure run or wait; cancel them before it is deleted"),
    ("alarm_closed", StatusCode::CONFLICT, "a person has closed the alarm already"),
    ("alarm_not_closed", StatusCode::CONFLICT, "no person has closed the alarm"),
    ("alarm_changed", StatusCode::CONFLICT, "the alarm was assigned, closed or reopened in the meantime"),
    ("too_many_actions", StatusCode::CONFLICT, "the maximum number of actions on the alarm is reached"),
    ("too_many_notes", StatusCode::CONFLICT, "the maximum number of notes exists"),
    ("already_delivered", StatusCode::CONFLICT, "the receiver has accepted the delivery"),
    ("body_too_large", StatusCode::PAYLOAD_TOO_LARGE, "the body is larger than the limit"),
    ("line_too_large", StatusCode::PAYLOAD_TOO_LARGE, "a line of NDJSON is larger than the limit"),
    ("too_many_lines", StatusCode::PAYLOAD_TOO_LARGE, "the NDJSON has more lines than the limit"),
    ("unsupported_media_type", StatusCode::UNSUPPORTED_MEDIA_TYPE, "the media type in Content-Type is not supported"),
    ("unsupported_encoding", StatusCode::UNSUPPORTED_MEDIA_TYPE, "compressed bodies are not supported"),
    ("invalid", StatusCode::UNPROCESSABLE_ENTITY, "a value is invalid; `errors` lists each one"),
    ("invalid_id", StatusCode::UNPROCESSABLE_ENTITY, "the text is not a valid structure id"),
    ("invalid_structure", StatusCode::UNPROCESSABLE_ENTITY, "the definition of the structure has errors"),
    ("idempotency_key_reused", StatusCode::UNPROCESSABLE_ENTITY, "the key belongs to a batch with other content"),
    (
        "measurement_exists",
        StatusCode::UNPROCESSABLE_ENTITY,
        "a measurement is already stored in a batch with other content",
    ),
    ("unusable_baseline", StatusCode::UNPROCESSABLE_ENTITY, "the batches cannot be used as the undamaged reference"),
    ("lasting_change", StatusCode::UNPROCESSABLE_ENTITY, "the batches of an extension show a lasting change"),
    (
        "too_many_measurements",
        StatusCode::UNPROCESSABLE_ENTITY,
        "the batches have more measurements than one diagnosis can use",
    ),
    ("first_token_must_be_admin", StatusCode::UNPROCESSABLE_ENTITY, "the first token must be able to create others"),
    ("too_many_requests", StatusCode::TOO_MANY_REQUESTS, "the limit of requests is exceeded; see Retry-After"),
    (
        "too_many_measurements_a_second",
        StatusCode::TOO_MANY_REQUESTS,
        "the limit of measurements is exceeded; see Retry-After",
    ),
    (
        "too_many_failures",
        StatusCode::TOO_MANY_REQUESTS,
        "too many failed authentications from one address; see Retry-After",
    ),
    ("internal", StatusCode::INTERNAL_SERVER_ERROR, "an internal error; the log has its cause under the request id"),
    (
        "stored_data_unreadable",
        StatusCode::SERVICE_UNAVAILABLE,
        "stored data that are needed cannot be read; `modalwatch doctor` names them",
    ),
    ("queue_full", StatusCode::SERVICE_UNAVAILABLE, "the queue of assessments is full; see Retry-After"),
    ("too_many_tables", StatusCode::SERVICE_UNAVAILABLE, "other tables are read and stored; see Retry-After"),
    (
        "too_many_jobs",
        StatusCode::SERVICE_UNAVAILABLE,
        "as many diagnoses, extensions and trainings as possible run or wait; see Retry-After",
    ),
    (
        "too_many_computations",
        StatusCode::SERVICE_UNAVAILABLE,
        "too many computations for readers wait; see Retry-After",
    ),
    ("too_many_connections", StatusCode::SERVICE_UNAVAILABLE, "all connections are in use; see Retry-After"),
    (
        "too_many_structures",
        StatusCode::SERVICE_UNAVAILABLE,
        "too many definitions wait to be checked; see Retry-After",
    ),
    (
        "too_many_streams",
        StatusCode::SERVICE_UNAVAILABLE,
        "the maximum number of event streams is open, in all or by this token",
    ),
    ("starting", StatusCode::SERVICE_UNAVAILABLE, "the service is starting"),
    ("stopping", StatusCode::SERVICE_UNAVAILABLE, "the service is stopping"),
    (
        "no_service",
        StatusCode::SERVICE_UNAVAILABLE,
        "no node serves the database, or this one cannot reach it; nothing was changed; see Retry-After",
    ),
    (
        "service_lost",
        StatusCode::SERVICE_UNAVAILABLE,
        "the serving node ended during the request; whether a change was stored is not known, and a batch can be repeated safely",
    ),
    ("disk_failed", StatusCode::SERVICE_UNAVAILABLE, "the disk failed; whether a change was stored is not known"),
    ("read_only", StatusCode::SERVICE_UNAVAILABLE, "the database is read-only; nothing can be stored"),
    (
        "database_busy",
        StatusCode::SERVICE_UNAVAILABLE,
        "the database is busy; whether a change was stored is not known",
    ),
    (
        "database_unreachable",
        StatusCode::SERVICE_UNAVAILABLE,
        "the database server does not answer; whether a change was stored is not known",
    ),
    ("database_gone", StatusCode::SERVICE_UNAVAILABLE, "the database was deleted or replaced; nothing can be stored"),
    ("disk_full", StatusCode::INSUFFICIENT_STORAGE, "the disk is full; whether a change was stored is not known"),
];

/// A problem (RFC 9457, `application/problem+json`). It has no `type`; `title` is the name of the HTTP status, and
/// programs should decide by `code`.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Problem)]
pub struct ProblemBody {
    /// Name of the status.
    pub(super) title: &'static str,
    /// The HTTP status.
    #[schema(minimum = 400, maximum = 599)]
    pub(super) status: u16,
    /// What happened and how to correct it, for people.
    pub(super) detail: String,
    #[schema(schema_with = code_schema)]
    pub(super) code: &'static str,
    /// Each error with its location in the request.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(super) errors: Vec<Problem>,
    /// Id of the request, as in the header `X-Request-Id` and in the log.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) request_id: Option<String>,
    /// Only for a request with many batches that stopped early: the outcome of the lines before.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) done: Option<Box<BulkAnswer>>,
}

/// Outcome of each batch of a request with many: the lines of NDJSON, or the parts of a table.
#[derive(Debug, Default, Serialize, ToSchema)]
pub struct BulkAnswer {
    /// One entry for each non-blank line, or for each batch of a table, in order.
    pub(super) items: Vec<BulkItem>,
    /// Number of lines whose batch was stored by this request.
    pub(super) stored: usize,
    /// Number of lines whose batch was already stored.
    pub(super) replayed: usize,
    /// Number of lines that were refused.
    pub(super) refused: usize,
    /// Only for a table: what was understood of it, and the rows that were left out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) table: Option<Box<Understood>>,
}

/// Outcome of one line, or of one batch of a table.
#[derive(Debug, Serialize, ToSchema)]
pub struct BulkItem {
    /// Line number in the body, starting at 1; for a batch of a table, that of its first measurement.
    pub(super) line: usize,
    /// Status with which this batch alone would have been answered.
    pub(super) status: u16,
    /// Id of the batch.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) batch: Option<String>,
    /// Processing state of the batch.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) state: Option<BatchState>,
    /// Whether the batch was already stored.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) replayed: Option<bool>,
    /// Path of the batch.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) location: Option<String>,
    /// Only for a table: earliest time of the batch.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) from: Option<Timestamp>,
    /// Only for a table: latest time of the batch.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) to: Option<Timestamp>,
    /// Only for a table: number of measurements.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) measurements: Option<usize>,
    /// Why the line was refused.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(no_recursion)]
    pub(super) problem: Option<Box<ProblemBody>>,
}

fn code_schema() -> Object {
    let meaning =
        |(code, status, meaning): &(&str, StatusCode, &str)| format!("- `{code}` ({}): {meaning}", status.as_u16());
    let meanings: Vec<String> = CODES.iter().map(meaning).collect();
    let codes = CODES.iter().map(|(code, ..)| *code);
    let description = format!("Stable name of the problem:\n\n{}", meanings.join("\n"));
    ObjectBuilder::new().schema_type(Type::String).enum_values(Some(codes)).description(Some(description)).build()
}
