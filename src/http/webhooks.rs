//! `/v1/webhooks`: receivers of alarm events, and the deliveries to them.

use axum::body::Body;
use axum::extract::State;
use axum::http::{header, HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::openapi::schema::{Array, ArrayBuilder, ObjectBuilder, Type};
use utoipa::{IntoParams, ToSchema};

use super::error::ApiError;
use super::openapi::{BodyRefused, Conflict, DeliveryPath, Invalid, Unknown, WebhookPath};
use super::request::{json_body, page_cursor, page_limit, structure_id, ApiPath, ApiQuery};
use super::shared::Shared;
use crate::alarm::ALARM_KINDS;
use crate::clock;
use crate::measurement::check::Problem;
use crate::monitor::stored::{Delivery, DeliveryState, EventFilter, WebhookRecord};
use crate::notify::{new_secret, EVENT_KINDS};
use crate::quantity::{shown, StructureId, Timestamp};

/// Maximum number of webhooks: each may need a connection.
const MOST_WEBHOOKS: usize = 100;

/// Query of the deliveries.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct DeliveryQuery {
    /// Only deliveries in this state; `dead` means that the service has given up.
    #[param(pattern = "^(pending|delivered|dead)$")]
    state: Option<String>,
    /// Maximum number of items. Default 100.
    #[param(value_type = Option<u32>, minimum = 1, maximum = 1000)]
    limit: Option<String>,
    /// `next` of the previous page.
    #[param(pattern = "^[0-9]{1,18}$")]
    cursor: Option<String>,
}

/// A webhook: its URL and the events that it receives.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = WebhookInput)]
struct WebhookBody {
    /// URL to which messages are posted: `http` or `https`, without user name and password. An address that is not on
    /// the public internet is refused unless `notify.allow_private_targets` contains it.
    #[schema(max_length = 2000, pattern = "^https?://[^/?#@]+([/?#].*)?$", examples("https://example.com/alarms"))]
    url: String,
    #[serde(default)]
    #[schema(schema_with = event_kinds)]
    events: Vec<String>,
    #[serde(default)]
    #[schema(schema_with = alarm_kinds)]
    alarm_kinds: Vec<String>,
    /// Ids of structures. Default: all.
    #[serde(default)]
    structures: Vec<String>,
    /// Whether events are sent. Default `true`.
    #[serde(default = "yes")]
    #[schema(default = true)]
    enabled: bool,
}

fn yes() -> bool {
    true
}

/// Schema of a list of these words.
fn list_of(words: &[&'static str], description: &str) -> Array {
    let word = ObjectBuilder::new().schema_type(Type::String).enum_values(Some(words.iter().copied())).build();
    ArrayBuilder::new().items(word).description(Some(description)).build()
}

fn event_kinds() -> Array {
    list_of(&EVENT_KINDS, "Kinds of events. Default: all.")
}

fn alarm_kinds() -> Array {
    list_of(&ALARM_KINDS, "Kinds of alarms. Default: all.")
}

/// Webhooks, oldest first.
#[derive(Debug, Serialize, ToSchema)]
struct WebhookList {
    items: Vec<WebhookItem>,
}

/// A webhook. Its secret is contained only in answers that create one.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Webhook)]
struct WebhookItem {
    webhook: String,
    url: String,
    /// Empty means all.
    events: Vec<String>,
    /// Empty means all.
    alarm_kinds: Vec<String>,
    /// Empty means all.
    structures: Vec<String>,
    enabled: bool,
    created_at: Timestamp,
    updated_at: Timestamp,
    /// Until when messages are also signed with the previous secret.
    #[schema(required)]
    previous_secret_until: Option<Timestamp>,
    #[serde(skip_serializing_if = "Option::is_none")]
    secret: Option<String>,
}

/// Delivery of a message to a webhook.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Delivery)]
struct DeliveryItem {
    delivery: i64,
    message: String,
    event: String,
    structure: StructureId,
    alarm: i64,
    /// `pending`, `delivered` or `dead`.
    state: &'static str,
    attempts: u32,
    created_at: Timestamp,
    #[schema(required)]
    next_attempt_at: Option<Timestamp>,
    #[schema(required)]
    last_attempt_at: Option<Timestamp>,
    #[schema(required)]
    last_status: Option<u16>,
    #[schema(required)]
    last_error: Option<String>,
}

/// Deliveries, newest first.
#[derive(Debug, Serialize, ToSchema)]
struct DeliveryPage {
    webhook: String,
    items: Vec<DeliveryItem>,
    #[schema(required)]
    next: Option<String>,
}

/// Result of a test message.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = WebhookTest)]
struct TestAnswer {
    webhook: String,
    delivered: bool,
    #[schema(required)]
    status: Option<u16>,
    latency_ms: f64,
    #[schema(required)]
    error: Option<String>,
}

impl From<WebhookRecord> for WebhookItem {
    fn from(w: WebhookRecord) -> Self {
        let now = clock::now();
        Self {
            webhook: w.id,
            url: w.url,
            events: w.filter.events,
            alarm_kinds: w.filter.alarm_kinds,
            structures: w.filter.structures,
            enabled: w.enabled,
            created_at: w.created_at,
            updated_at: w.updated_at,
            previous_secret_until: w.previous_secret.map(|(_, until)| until).filter(|until| *until > now),
            secret: None,
        }
    }
}

impl From<Delivery> for DeliveryItem {
    fn from(d: Delivery) -> Self {
        Self {
            delivery: d.id,
            message: d.event.message_id,
            event: d.event.kind,
            structure: d.event.structure,
            alarm: d.event.alarm,
            state: d.state.as_str(),
            attempts: d.attempts,
            created_at: d.event.created_at,
            next_attempt_at: (d.state == DeliveryState::Pending).then_some(d.next_at),
            last_attempt_at: d.last_at,
            last_status: d.last_status,
            last_error: d.last_error,
        }
    }
}

/// `GET /v1/webhooks`: all webhooks, oldest first.
///
/// # Errors
/// 500.
#[utoipa::path(
    get, path = "/v1/webhooks", tag = "webhooks", operation_id = "list_webhooks",
    summary = "All webhooks", description = "All webhooks without their secrets, oldest first.",
    responses((status = 200, description = "The webhooks", body = WebhookList))
)]
pub async fn list(State(shared): State<Shared>) -> Result<Response, ApiError> {
    let items: Vec<WebhookItem> = shared.monitor.webhooks().list().await?.into_iter().map(Into::into).collect();
    Ok(Json(WebhookList { items }).into_response())
}

/// `POST /v1/webhooks`: 201 with the secret, which cannot be read again.
///
/// # Errors
/// 400, 415, 422 for the body, 409 if the maximum number of webhooks exists.
#[utoipa::path(
    post, path = "/v1/webhooks", tag = "webhooks", operation_id = "create_webhook",
    summary = "Create a webhook",
    description = "Messages are signed according to Standard Webhooks. The secret is contained only in this answer and in that of a \
                   rotation.",
    request_body(content = WebhookBody, example = json!({"url": "https://example.com/alarms", "structures": ["three-dof"]})),
    responses(
        (status = 201, description = "The webhook with its secret", body = WebhookItem,
         headers(("Location" = String, description = "Path of the webhook"))),
        BodyRefused, Conflict
    )
)]
pub async fn create(State(shared): State<Shared>, headers: HeaderMap, body: Body) -> Result<Response, ApiError> {
    let body: WebhookBody = json_body(&headers, body, shared.limits).await?;
    check(&shared, &body).await?;
    let now = clock::now();
    let record = WebhookRecord {
        id: uuid::Uuid::now_v7().to_string(),
        url: body.url,
        secret: new_secret().map_err(|e| ApiError::internal(&e))?,
        previous_secret: None,
        filter: EventFilter { events: body.events, alarm_kinds: body.alarm_kinds, structures: body.structures },
        enabled: body.enabled,
        created_at: now,
        updated_at: now,
    };
    if !shared.monitor.webhooks().insert_webhook(record.clone(), MOST_WEBHOOKS).await? {
        let detail = format!("there are already {MOST_WEBHOOKS} webhooks: delete one first");
        return Err(ApiError::new(StatusCode::CONFLICT, "too_many_webhooks", detail));
    }
    let (location, secret) = (format!("/v1/webhooks/{}", record.id), record.secret.reveal().to_owned());
    let item = WebhookItem { secret: Some(secret), ..record.into() };
    Ok((StatusCode::CREATED, [(header::LOCATION, location)], Json(item)).into_response())
}

/// `GET /v1/webhooks/{id}`.
///
/// # Errors
/// 404.
#[utoipa::path(
    get, path = "/v1/webhooks/{id}", tag = "webhooks", operation_id = "read_webhook",
    summary = "A webhook", description = "Without its secret.",
    params(WebhookPath),
    responses((status = 200, description = "The webhook", body = WebhookItem), Unknown)
)]
pub async fn read(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    Ok(Json(WebhookItem::from(webhook(&shared, &id).await?)).into_response())
}

/// `PUT /v1/webhooks/{id}`: changes URL, filter or `enabled`. The secret and pending deliveries are kept.
///
/// # Errors
/// 404; 400, 415, 422 for the body; 409 to enable a webhook without a secret.
#[utoipa::path(
    put, path = "/v1/webhooks/{id}", tag = "webhooks", operation_id = "put_webhook",
    summary = "Change a webhook", description = "Changes URL, filter or `enabled`. The secret and pending deliveries are kept. A webhook that \
                   was restored without its secret cannot be enabled before it has a new one.",
    params(WebhookPath),
    request_body(content = WebhookBody, example = json!({"url": "https://example.com/alarms", "enabled": false})),
    responses((status = 200, description = "The webhook", body = WebhookItem), Unknown, BodyRefused, Conflict)
)]
pub async fn put(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let present = webhook(&shared, &id).await?;
    let body: WebhookBody = json_body(&headers, body, shared.limits).await?;
    check(&shared, &body).await?;
    if body.enabled && present.secret.reveal().is_empty() {
        let detail = format!(
            "webhook {id} has no secret, because it was restored from a backup without secrets: give it a new one by POST \
             /v1/webhooks/{id}/secret, tell it to the receiver, and enable the webhook then"
        );
        return Err(ApiError::new(StatusCode::CONFLICT, "no_webhook_secret", detail));
    }
    let filter = EventFilter { events: body.events, alarm_kinds: body.alarm_kinds, structures: body.structures };
    shared.monitor.webhooks().update_webhook(&id, &body.url, filter, body.enabled, clock::now()).await?;
    read(State(shared), ApiPath(id)).await
}

/// `DELETE /v1/webhooks/{id}`: 204. Deletes its deliveries too.
///
/// # Errors
/// 404.
#[utoipa::path(
    delete, path = "/v1/webhooks/{id}", tag = "webhooks", operation_id = "delete_webhook",
    summary = "Delete a webhook", description = "Deletes the webhook and its deliveries.",
    params(WebhookPath),
    responses((status = 204, description = "It was deleted"), Unknown)
)]
pub async fn remove(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    if shared.monitor.webhooks().delete_webhook(&id).await? {
        Ok(StatusCode::NO_CONTENT.into_response())
    } else {
        Err(unknown_webhook(&id))
    }
}

/// `POST /v1/webhooks/{id}/test`: sends one test message immediately and returns the result.
///
/// # Errors
/// 404.
#[utoipa::path(
    post, path = "/v1/webhooks/{id}/test", tag = "webhooks", operation_id = "test_webhook",
    summary = "Test a webhook", description = "Sends one test message immediately and returns the result.",
    params(WebhookPath),
    responses((status = 200, description = "Result of the test", body = TestAnswer), Unknown)
)]
pub async fn test(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let webhook = webhook(&shared, &id).await?;
    let attempt = shared.notifier.test(&webhook).await;
    let answer = TestAnswer {
        webhook: id,
        delivered: attempt.error.is_none(),
        status: attempt.status,
        latency_ms: attempt.took.as_secs_f64() * 1e3,
        error: attempt.error,
    };
    Ok(Json(answer).into_response())
}

/// `POST /v1/webhooks/{id}/secret`: creates a new secret. For some time the previous one signs too, so that receivers
/// can change over.
///
/// # Errors
/// 404.
#[utoipa::path(
    post, path = "/v1/webhooks/{id}/secret", tag = "webhooks", operation_id = "rotate_webhook_secret",
    summary = "Rotate the secret of a webhook", description = "Creates a new secret. For some time the previous one signs too, so that receivers can change over.",
    params(WebhookPath),
    responses((status = 200, description = "The webhook with its new secret", body = WebhookItem), Unknown)
)]
pub async fn rotate(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let (now, secret) = (clock::now(), new_secret().map_err(|e| ApiError::internal(&e))?);
    let until = shared.notifier.overlap_until(now);
    if !shared.monitor.webhooks().rotate_secret(&id, secret.clone(), until, now).await? {
        return Err(unknown_webhook(&id));
    }
    let item = WebhookItem { secret: Some(secret.reveal().to_owned()), ..webhook(&shared, &id).await?.into() };
    Ok(Json(item).into_response())
}

/// `GET /v1/webhooks/{id}/deliveries`: deliveries, newest first; `state=dead` lists those that were given up.
///
/// # Errors
/// 404, 422 for the query.
#[utoipa::path(
    get, path = "/v1/webhooks/{id}/deliveries", tag = "webhooks", operation_id = "list_deliveries",
    summary = "Deliveries of a webhook", description = "Newest first, in pages.",
    params(WebhookPath, DeliveryQuery),
    responses((status = 200, description = "A page", body = DeliveryPage), Unknown, Invalid)
)]
pub async fn deliveries(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<DeliveryQuery>,
) -> Result<Response, ApiError> {
    webhook(&shared, &id).await?;
    let limit = page_limit(query.limit.as_deref())?;
    let state = |text: &str| {
        let found = DeliveryState::ALL.into_iter().find(|state| state.as_str() == text);
        let message = || format!("{} is not one of pending, delivered, dead", shown(text));
        found.ok_or_else(|| ApiError::invalid_field("query/state", message()))
    };
    let state = query.state.as_deref().map(state).transpose()?;
    let before = page_cursor(query.cursor.as_deref())?;
    let found = shared.monitor.outbox().deliveries(&id, state, before, limit).await?;
    let next = (found.len() == limit).then(|| found.last().map(|d| d.id.to_string())).flatten();
    Ok(Json(DeliveryPage { webhook: id, items: found.into_iter().map(Into::into).collect(), next }).into_response())
}

/// `POST /v1/webhooks/{id}/deliveries/{delivery}/retry`: 202. The message is sent immediately, and its schedule of
/// retries starts again.
///
/// # Errors
/// 404, 409 if it was delivered.
#[utoipa::path(
    post, path = "/v1/webhooks/{id}/deliveries/{delivery}/retry", tag = "webhooks", operation_id = "retry_delivery",
    summary = "Send a message again", description = "Sends the message immediately and restarts its schedule of retries.",
    params(DeliveryPath),
    responses((status = 202, description = "It is being sent", body = DeliveryItem), Unknown, Conflict)
)]
pub async fn retry(
    State(shared): State<Shared>,
    ApiPath((id, delivery)): ApiPath<(String, String)>,
) -> Result<Response, ApiError> {
    webhook(&shared, &id).await?;
    let unknown = || {
        let detail = format!("webhook {id} has no delivery {}", shown(&delivery));
        ApiError::new(StatusCode::NOT_FOUND, "unknown_delivery", detail)
    };
    let number: i64 = delivery.parse().map_err(|_| unknown())?;
    let found = shared.monitor.outbox().retry_delivery(&id, number, clock::now()).await?.ok_or_else(unknown)?;
    if found.state == DeliveryState::Delivered {
        let detail = format!("delivery {number} was accepted by the receiver: it cannot be sent again");
        return Err(ApiError::new(StatusCode::CONFLICT, "already_delivered", detail));
    }
    Ok((StatusCode::ACCEPTED, Json(DeliveryItem::from(found))).into_response())
}

async fn webhook(shared: &Shared, id: &str) -> Result<WebhookRecord, ApiError> {
    shared.monitor.webhooks().webhook(id).await?.ok_or_else(|| unknown_webhook(id))
}

fn unknown_webhook(id: &str) -> ApiError {
    ApiError::new(StatusCode::NOT_FOUND, "unknown_webhook", format!("there is no webhook {}", shown(id)))
}

async fn check(shared: &Shared, body: &WebhookBody) -> Result<(), ApiError> {
    let mut problems = Vec::new();
    if let Err(message) = shared.notifier.guard().check_new_url(&body.url).await {
        problems.push(Problem::new("/url", message));
    }
    for (field, values, known) in
        [("events", &body.events, &EVENT_KINDS[..]), ("alarm_kinds", &body.alarm_kinds, &ALARM_KINDS[..])]
    {
        for (index, value) in values.iter().enumerate().filter(|(_, value)| !known.contains(&value.as_str())) {
            let message = format!("{} is not one of {}", shown(value), known.join(", "));
            problems.push(Problem::new(format!("/{field}/{index}"), message));
        }
    }
    for (index, value) in body.structures.iter().enumerate() {
        if structure_id(value).is_ok_and(|id| shared.monitor.structure(&id).is_ok()) {
            continue;
        }
        problems.push(Problem::new(format!("/structures/{index}"), format!("there is no structure {}", shown(value))));
    }
    problems.truncate(20);
    if problems.is_empty() {
        Ok(())
    } else {
        Err(ApiError::invalid_input(problems))
    }
}
