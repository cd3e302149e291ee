//! The OpenAPI 3.1 document. It is generated from the same lines as the router: a handler without a description does
//! not compile, and a route that is not in the router is not in the document.
//!
//! # How a route is added
//!
//! 1. Write the handler and put `#[utoipa::path(...)]` above it: method, path, `tag` (one of [`Base`]), the parameters
//!    ([`StructurePath`] and the like for the path, the `IntoParams` of the query), the request body with an example of each
//!    content type, and every response. The name of the function becomes the `operationId`, unless two modules use the same
//!    name: then give `operation_id`. The first line of the doc comment is the summary and the rest the description; set
//!    `summary` and `description` in the attribute if the doc comment is not meant for clients.
//! 2. Successes are `(status = 200, description = "…", body = Type)` with a type that derives `ToSchema`; `Option` fields that
//!    are always sent get `#[schema(required)]`. Problems are one of the sets below ([`Unknown`], [`Invalid`],
//!    [`BodyRefused`], [`Conflict`], [`Busy`]), all of them `application/problem+json`. [`complete`] adds to every operation the
//!    status 500, the header `X-Request-Id`, the answers of the layers before the handlers, such as 401 and 403, and the scope
//!    that a token needs, by `access::route`.
//! 3. Add it to `http::api` as `.routes(routes!(module::handler))`; handlers of one path go into one `routes!`. A new `code`
//!    of a problem goes into `problem::CODES`.
//!
//! Plain `.route` is only for [`super::docs`], which serves this document and the page that shows it, and for the files
//! of the dashboard. `tests/api/openapi.rs` checks these rules, and `tests/schemathesis.sh` tests the service against
//! the document.

use std::collections::BTreeMap;

use axum::http::Method;
use utoipa::openapi::path::Operation;
use utoipa::openapi::schema::{Object, ObjectBuilder, Type};
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityRequirement, SecurityScheme};
use utoipa::openapi::{ContentBuilder, HeaderBuilder, OpenApi, Ref, RefOr, Response, ResponseBuilder};
use utoipa::{IntoParams, IntoResponses};

use super::access::route::classify;
use super::problem::{ProblemBody, PROBLEM_JSON};
use crate::access::{Need, Scope};

/// General part of the document.
#[derive(utoipa::OpenApi)]
#[openapi(
    info(
        title = "modalwatch",
        description = "Structural health monitoring by natural frequencies. Measured frequencies are posted in batches; the results are \
                       stiffnesses with their uncertainty, probabilities of damage, and alarms.\n\n\
                       Field names contain the unit. Times are RFC 3339: with a UTC offset in requests, in UTC in answers. A number \
                       that does not exist is `null`. Every answer except a success is `application/problem+json` with a stable \
                       `code`. Posting the same batch again is safe: it is recognised by structure, source and time, or by a key that \
                       the client chose.\n\n\
                       If the service has tokens, requests need one: `Authorization: Bearer mw_…` with the scope that the operation \
                       names; the scope `admin` includes the others. A service without tokens answers only requests from its own machine."
    ),
    tags(
        (name = "structures", description = "Structures, their simulation and trained model"),
        (name = "batches", description = "Posting and exporting measurements"),
        (name = "results", description = "Results over time, compared with the undamaged reference"),
        (name = "alarms", description = "Alarms, alarm charts, maintenance and notes"),
        (name = "access", description = "Tokens and the audit of changes"),
        (name = "webhooks", description = "Receivers of alarm events"),
        (name = "diagnoses", description = "Diagnoses of systematic errors of the simulation, and extensions by them"),
        (name = "trainings", description = "Training of models by the service"),
        (name = "jobs", description = "Diagnoses, extensions and trainings as jobs: their order and their end"),
        (name = "operations", description = "Operation of the service")
    ),
    components(schemas(ProblemBody))
)]
pub struct Base;

/// Path of a structure.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(
    dead_code,
    reason = "only its description is used: handlers check the text themselves and answer with a problem"
)]
pub struct StructurePath {
    /// Id of the structure.
    #[param(value_type = String, min_length = 1, max_length = 64, pattern = "^[a-z0-9][a-z0-9._-]*$", example = "three-dof")]
    id: String,
}

/// Path of a batch.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "as in StructurePath")]
pub struct BatchPath {
    /// Id of the structure.
    #[param(value_type = String, min_length = 1, max_length = 64, pattern = "^[a-z0-9][a-z0-9._-]*$", example = "three-dof")]
    id: String,
    /// Id of the batch.
    #[param(min_length = 1)]
    batch: String,
}

/// Path of an alarm.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "as in StructurePath")]
pub struct AlarmPath {
    /// Id of the structure.
    #[param(value_type = String, min_length = 1, max_length = 64, pattern = "^[a-z0-9][a-z0-9._-]*$", example = "three-dof")]
    id: String,
    /// Number of the alarm.
    #[param(value_type = i64, minimum = 1)]
    alarm: String,
}

/// Path of a note.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "as in StructurePath")]
pub struct NotePath {
    /// Id of the structure.
    #[param(value_type = String, min_length = 1, max_length = 64, pattern = "^[a-z0-9][a-z0-9._-]*$", example = "three-dof")]
    id: String,
    /// Id of the note.
    #[param(min_length = 1)]
    note: String,
}

/// Path of a diagnosis.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "as in StructurePath")]
pub struct DiagnosisPath {
    /// Id of the diagnosis.
    #[param(min_length = 1)]
    id: String,
}

/// Path of a training.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "as in StructurePath")]
pub struct TrainingPath {
    /// Id of the training.
    #[param(min_length = 1)]
    id: String,
}

/// Path of a job.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "as in StructurePath")]
pub struct JobPath {
    /// Id of the diagnosis or training.
    #[param(min_length = 1)]
    id: String,
}

/// Path of a token.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "as in StructurePath")]
pub struct TokenPath {
    /// Id of the token.
    #[param(min_length = 1)]
    id: String,
}

/// Path of a webhook.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "as in StructurePath")]
pub struct WebhookPath {
    /// Id of the webhook.
    #[param(min_length = 1)]
    id: String,
}

/// Path of a delivery to a webhook.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "as in StructurePath")]
pub struct DeliveryPath {
    /// Id of the webhook.
    #[param(min_length = 1)]
    id: String,
    /// Number of the delivery.
    #[param(value_type = i64, minimum = 1)]
    delivery: String,
}

/// Path of a quarantined message.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "as in StructurePath")]
pub struct MessagePath {
    /// Number of the message.
    #[param(value_type = i64, minimum = 1)]
    message: String,
}

/// Defines a set of responses that are problems.
macro_rules! problems {
    ($($(#[$doc:meta])* $name:ident { $($status:literal: $description:literal),+ $(,)? })+) => {$(
        $(#[$doc])*
        pub enum $name {}

        impl IntoResponses for $name {
            fn responses() -> BTreeMap<String, RefOr<Response>> {
                [$(($status.to_owned(), problem($status, $description).into())),+].into()
            }
        }
    )+};
}

problems! {
    /// Something in the path does not exist.
    Unknown {
        "404": "`unknown_structure`, `unknown_batch`, `unknown_alarm` and so on: it does not exist."
    }
    /// An invalid value in path or query.
    Invalid {
        "422": "`invalid`, `invalid_id`: a value in path or query is invalid; `errors` names it."
    }
    /// A body that was refused.
    BodyRefused {
        "400": "`malformed_json`, `not_utf8`, `body_unreadable`: the body cannot be read.",
        "408": "`body_timeout`: the body did not arrive in time.",
        "413": "`body_too_large`; for NDJSON also `too_many_lines`, with the outcome of the lines before in `done`.",
        "415": "`unsupported_media_type`, `unsupported_encoding`.",
        "422": "A value is invalid or contradicts what is stored; `errors` lists each one.",
    }
    /// The request conflicts with the present state.
    Conflict {
        "409": "The request conflicts with the present state; `code` says how."
    }
    /// A queue is full.
    Busy {
        "503": "`queue_full` (assessments), `too_many_jobs`, `too_many_tables`: try again after the seconds of `Retry-After`."
    }
    /// Too many computations for readers wait.
    Computed {
        "503": "`too_many_computations`: try again after the seconds of `Retry-After`."
    }
    /// Too many definitions wait to be checked.
    Checked {
        "503": "`too_many_structures`: try again after the seconds of `Retry-After`."
    }
    /// The maximum number of streams is open.
    StreamBusy {
        "503": "`too_many_streams`, `stopping`: try again after the seconds of `Retry-After`."
    }
    /// A format that the service cannot write.
    NotAcceptable {
        "406": "`not_acceptable`: the service cannot write the requested format."
    }
}

fn problem(status: &str, description: &str) -> Response {
    let schema = Ref::from_schema_name("Problem");
    let mut response = ResponseBuilder::new()
        .description(description)
        .content(PROBLEM_JSON, ContentBuilder::new().schema(Some(schema)).build());
    if ["429", "503"].contains(&status) {
        let seconds: Object = ObjectBuilder::new().schema_type(Type::Integer).minimum(Some(1)).build();
        let header = HeaderBuilder::new().schema(Some(seconds)).description(Some("Seconds to wait")).build();
        response = response.header("Retry-After", header);
    }
    response.build()
}

/// Name of the security scheme.
const BEARER: &str = "bearer";

/// Adds what applies to every operation: the answers of the layers before the handlers, and the scope that a token
/// needs.
pub fn complete(document: &mut OpenApi) {
    let scheme = HttpBuilder::new()
        .scheme(HttpAuthScheme::Bearer)
        .description(Some(
            "A token, created by `modalwatch token create` or `POST /v1/tokens`. A service without stored tokens needs none.",
        ))
        .build();
    let components = document.components.get_or_insert_default();
    components.add_security_scheme(BEARER, SecurityScheme::Http(scheme));
    for (path, item) in &mut document.paths.paths {
        let methods = [
            (Method::GET, &mut item.get),
            (Method::PUT, &mut item.put),
            (Method::POST, &mut item.post),
            (Method::DELETE, &mut item.delete),
            (Method::PATCH, &mut item.patch),
        ];
        for (method, operation) in methods {
            if let Some(operation) = operation {
                complete_operation(operation, &method, path);
            }
        }
    }
}

fn complete_operation(operation: &mut Operation, method: &Method, path: &str) {
    let responses = &mut operation.responses.responses;
    also(responses, "400", "`token_in_address`: the URL contains a token.");
    also(responses, "429", "`too_many_requests` and other rate limits: try again after the seconds of `Retry-After`.");
    also(responses, "500", "`internal`: an error of the service; its log has the cause under the request id.");
    if path.starts_with("/v1/") {
        also(
            responses,
            "503",
            "`database_busy`, `database_unreachable`, `disk_failed`, `read_only`, `database_gone`, `stored_data_unreadable`: the data cannot be read or stored \
             at present.",
        );
        if method != Method::GET {
            also(responses, "507", "`disk_full`: there is no space to store the data.");
        }
    }
    match classify(method, Some(path)).need {
        // No token is needed.
        Need::Nothing => operation.security = Some(Vec::new()),
        Need::Scope(scope) => {
            also(
                responses,
                "401",
                "`unauthorized`, `token_expired`, `token_revoked`: the operation needs a valid token.",
            );
            let of_sources = match scope {
                Scope::Ingest => "`forbidden_source`: the token is limited to other sources; ",
                Scope::Read | Scope::Admin => "",
            };
            let missing = format!(
                "`forbidden_scope`: the operation needs the scope `{scope}`; `forbidden_structure`: the token is limited to other structures; \
                 {of_sources}`forbidden_origin`."
            );
            also(responses, "403", &missing);
            operation.security = Some(vec![SecurityRequirement::new(BEARER, [scope.as_str()])]);
        }
    }
    for response in responses.values_mut() {
        if let RefOr::T(response) = response {
            let text: Object = ObjectBuilder::new().schema_type(Type::String).build();
            let header =
                HeaderBuilder::new().schema(Some(text)).description(Some("Id of the request, as in the log")).build();
            response.headers.insert("X-Request-Id".to_owned(), header.into());
        }
    }
}

/// Adds a problem to the responses of an operation.
fn also(responses: &mut BTreeMap<String, RefOr<Response>>, status: &str, description: &str) {
    match responses.get_mut(status) {
        Some(RefOr::T(there)) => there.description = format!("{} {description}", there.description),
        Some(RefOr::Ref(_)) => {}
        None => {
            responses.insert(status.to_owned(), problem(status, description).into());
        }
    }
}
