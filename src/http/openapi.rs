//! The API document (OpenAPI 3.1), made from the lines that make the router: what is not annotated does not compile, and what
//! is not in the router is not in the document.
//!
//! # How a route is added
//!
//! 1. Write the handler and put `#[utoipa::path(...)]` above it: method, path, `tag` (one of [`Base`]), the parameters
//!    ([`StructurePath`] and its like for the path, the `IntoParams` of the query), the request body with an example of each
//!    content type, and every response. The name of the function becomes the `operationId`, unless two modules have one of
//!    that name: then give `operation_id`. The first line of its doc comment is the summary, the rest the description; end it
//!    before `# Errors` with `summary`/`description` of the attribute where it says more than a client needs.
//! 2. Successes are `(status = 200, description = "…", body = Type)` with a type that derives `ToSchema`; `Option` fields that
//!    are always sent get `#[schema(required)]`. What is not a success is one of the sets below ([`Unknown`], [`Invalid`],
//!    [`BodyRefused`], [`Conflict`], [`Busy`]), all of them `application/problem+json`. 500 and the header `X-Request-Id` are
//!    added to every operation by [`complete`]; so is what a layer in front of the handlers answers, such as 401 and 403, and
//!    the scope that a token must have, by `access::route`.
//! 3. Put it into `http::api` as `.routes(routes!(module::handler))`; handlers of one path go into one `routes!`. A new `code`
//!    of a problem goes into `error::CODES`.
//!
//! Plain `.route` is for [`super::docs`], which serves this document and the page that shows it, and for the files of the
//! dashboard. `tests/api/openapi.rs`
//! looks after all of this, and `tests/schemathesis.sh` sets document and service against each other.

use std::collections::BTreeMap;

use axum::http::Method;
use utoipa::openapi::path::Operation;
use utoipa::openapi::schema::{Object, ObjectBuilder, Type};
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityRequirement, SecurityScheme};
use utoipa::openapi::{ContentBuilder, HeaderBuilder, OpenApi, Ref, RefOr, Response, ResponseBuilder};
use utoipa::{IntoParams, IntoResponses};

use super::access::route::classify;
use super::error::{ProblemBody, PROBLEM_JSON};
use crate::access::Need;

/// What the document says beside its operations.
#[derive(utoipa::OpenApi)]
#[openapi(
    info(
        title = "modalwatch",
        description = "Watches structures through their natural frequencies: measured frequencies go in by batches; out come \
                       stiffnesses with their spread, probabilities of damage, and alarms.\n\n\
                       Units stand in the names of fields. Times are RFC 3339: with an offset in requests, UTC in answers. A \
                       number that is none is `null`. Everything but a success is `application/problem+json` with a stable \
                       `code`. Posting the same batch again is safe: it is known by structure, source and time, or by the \
                       client's own key.\n\n\
                       A service with tokens asks for one: `Authorization: Bearer mw_…`, of the scope that the operation \
                       names; `admin` includes the others. One without any serves this machine only, and needs none."
    ),
    tags(
        (name = "structures", description = "Structures, their simulation and trained baseline"),
        (name = "batches", description = "Measurements in and out"),
        (name = "results", description = "What the batches say over time, against the undamaged state"),
        (name = "alarms", description = "Alarms, the charts behind them, maintenance"),
        (name = "access", description = "Tokens, and who changed what"),
        (name = "webhooks", description = "Who is told of alarms"),
        (name = "diagnoses", description = "What the simulation gets wrong, and its extension"),
        (name = "operations", description = "For those who run the service")
    ),
    components(schemas(ProblemBody))
)]
pub struct Base;

/// Path of a structure.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "only its description is used: handlers check the text themselves, with our own errors")]
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

/// Path of a diagnosis.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "as in StructurePath")]
pub struct DiagnosisPath {
    /// Id of the diagnosis.
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

/// Path of a message to a webhook.
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

/// A set of responses that are problems.
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
    /// Something that the path names is not there.
    Unknown {
        "404": "`unknown_structure`, `unknown_batch`, `unknown_alarm` and so on: it is not here."
    }
    /// A value of path or query that cannot be.
    Invalid {
        "422": "`invalid`, `invalid_id`: a value of path or query is out of range; `errors` names it."
    }
    /// A body that was not taken.
    BodyRefused {
        "400": "`malformed_json`, `not_utf8`, `body_unreadable`: the body cannot be read.",
        "408": "`body_timeout`: the body came too slowly.",
        "413": "`body_too_large`; for NDJSON also `too_many_lines`, with what was done before in `done`.",
        "415": "`unsupported_media_type`, `unsupported_encoding`.",
        "422": "It was read, but a value is out of range or does not fit what is stored; `errors` names each.",
    }
    /// It does not fit the present state.
    Conflict {
        "409": "It does not fit the present state; `code` says which."
    }
    /// The queue is full.
    Busy {
        "503": "`queue_full`: try again after the seconds of `Retry-After`."
    }
    /// No more streams.
    StreamBusy {
        "503": "`too_many_streams`, `stopping`: try again after the seconds of `Retry-After`."
    }
    /// A format that is not written.
    NotAcceptable {
        "406": "`not_acceptable`: this service does not write the format asked for."
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

/// Adds what holds for every operation: what the layers before the handlers answer, and what a token must be good for.
pub fn complete(document: &mut OpenApi) {
    let scheme = HttpBuilder::new()
        .scheme(HttpAuthScheme::Bearer)
        .description(Some(
            "A token, made by `modalwatch token create` or `POST /v1/tokens`; without any stored, none is needed.",
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
    also(responses, "400", "`token_in_address`: a token stands in the address.");
    also(responses, "429", "`too_many_requests` and its like: try again after the seconds of `Retry-After`.");
    also(responses, "500", "`internal`: an error of the service; its log has the cause under the request id.");
    if path.starts_with("/v1/") {
        also(
            responses,
            "503",
            "`database_busy`, `disk_failed`, `read_only`, `database_gone`: it cannot be read or stored now.",
        );
        if method != Method::GET {
            also(responses, "507", "`disk_full`: there is no room to store it.");
        }
    }
    match classify(method, Some(path)).need {
        // Nobody is asked.
        Need::Nothing => operation.security = Some(Vec::new()),
        Need::Scope(scope) => {
            also(responses, "401", "`unauthorized`, `token_expired`, `token_revoked`: it needs a token.");
            let missing = format!(
                "`forbidden_scope`: it needs the scope `{scope}`; `forbidden_structure`: the token is for other structures; \
                 `forbidden_origin`."
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

/// A problem that the operation can answer as well.
fn also(responses: &mut BTreeMap<String, RefOr<Response>>, status: &str, description: &str) {
    match responses.get_mut(status) {
        Some(RefOr::T(there)) => there.description = format!("{} {description}", there.description),
        Some(RefOr::Ref(_)) => {}
        None => {
            responses.insert(status.to_owned(), problem(status, description).into());
        }
    }
}
