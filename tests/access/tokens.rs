//! The life of a token.

use reqwest::Method;
use serde_json::{json, Value};

use crate::access::world::{eventually, id_of, program, World};
use crate::helpers::{created, problem, Service};

const LIST: &str = "/v1/structures";

#[tokio::test]
async fn a_token_is_shown_once_and_listed_without_its_secret() {
    let world = World::start();
    let body = json!({ "name": "gateway", "scopes": ["read", "ingest"], "structures": ["bridge-7"],
                       "expires_at": "2126-01-01T00:00:00+01:00" });
    let response = world.post("/v1/tokens", &world.admin, &body).await;
    let location = response.headers()["location"].to_str().unwrap().to_owned();
    assert_eq!(response.headers()["cache-control"], "no-store");
    let made = created(response).await;
    let token = made["token"].as_str().unwrap();
    assert_eq!(location, format!("/v1/tokens/{}", id_of(token)));
    assert_eq!(made["scopes"], json!(["ingest", "read"]));
    assert_eq!(made["expires_at"], "2125-12-31T23:00:00Z");

    let list = world.read("/v1/tokens", &world.admin).await;
    let items = list["items"].as_array().unwrap();
    assert_eq!(items.len(), 2);
    assert_eq!((&items[0]["name"], &items[1]["structures"]), (&json!("first"), &json!(["bridge-7"])));
    assert_eq!((&items[1]["state"], items[1].get("token")), (&json!("active"), None));
    let secret = token.rsplit('_').next().unwrap();
    assert!(!list.to_string().contains(secret));
}

#[tokio::test]
async fn mistakes_in_a_new_token_are_reported() {
    let world = World::start();
    let pointer = async |body: Value| {
        let refused = problem(world.post("/v1/tokens", &world.admin, &body).await, 422, "invalid").await;
        refused["errors"][0]["pointer"].as_str().unwrap().to_owned()
    };
    assert_eq!(pointer(json!({ "name": "", "scopes": ["read"] })).await, "/name");
    assert_eq!(pointer(json!({ "name": "x", "scopes": [] })).await, "/scopes");
    assert_eq!(pointer(json!({ "name": "x", "scopes": ["root"] })).await, "/scopes/0");
    assert_eq!(pointer(json!({ "name": "x", "scopes": ["read"], "structures": [] })).await, "/structures");
    assert_eq!(pointer(json!({ "name": "x", "scopes": ["read"], "structures": ["a", "A/B"] })).await, "/structures/1");
    for sources in [json!([]), json!(["a b"])] {
        assert_eq!(pointer(json!({ "name": "x", "scopes": ["ingest"], "sources": sources })).await, "/sources");
    }
    for scopes in [json!(["read"]), json!(["ingest", "admin"])] {
        assert_eq!(pointer(json!({ "name": "x", "scopes": scopes, "sources": ["a"] })).await, "/sources");
    }
    let past = json!({ "name": "x", "scopes": ["read"], "expires_at": "2020-01-01T00:00:00Z" });
    assert_eq!(pointer(past).await, "/expires_at");
    assert_eq!(pointer(json!({ "name": world.admin, "scopes": ["read"] })).await, "/name");
}

#[tokio::test]
async fn a_rotated_secret_is_good_during_the_overlap_and_not_after() {
    let world = World::start();
    let old = world.token(&["read"], &[]).await;
    let rotate = async |overlap_s: u32| {
        let path = format!("/v1/tokens/{}/rotation", id_of(&old));
        let body = created(world.post(&path, &world.admin, &json!({ "overlap_s": overlap_s })).await).await;
        body["token"].as_str().unwrap().to_owned()
    };
    let new = rotate(3_600).await;
    assert_eq!(id_of(&new), id_of(&old));
    for token in [&old, &new] {
        assert_eq!(world.get(LIST, token).await.status(), 200);
    }
    let newest = rotate(0).await;
    // The secret before the previous one is unknown; the previous one is refused as expired.
    problem(world.get(LIST, &old).await, 401, "unauthorized").await;
    let over = world.get(LIST, &new).await;
    assert!(over.headers()["www-authenticate"].to_str().unwrap().contains("error=\"invalid_token\""));
    problem(over, 401, "token_expired").await;
    assert_eq!(world.get(LIST, &newest).await.status(), 200);

    let path = format!("/v1/tokens/{}/rotation", id_of(&old));
    let refused = world.post(&path, &world.admin, &json!({ "overlap_s": 99_999_999 })).await;
    problem(refused, 422, "invalid").await;
    let unknown = world.post("/v1/tokens/0123456789abcdef/rotation", &world.admin, &json!({})).await;
    problem(unknown, 404, "unknown_token").await;
}

#[tokio::test]
async fn a_token_expires_by_itself() {
    let world = World::start();
    let soon = jiff::Timestamp::now() + std::time::Duration::from_secs(4);
    let body = json!({ "name": "short", "scopes": ["read"], "expires_at": soon.to_string() });
    let made = created(world.post("/v1/tokens", &world.admin, &body).await).await;
    let token = made["token"].as_str().unwrap();
    eventually(&world, LIST, token, 401, "token_expired").await;
    let rotation = format!("/v1/tokens/{}/rotation", id_of(token));
    problem(world.post(&rotation, &world.admin, &json!({})).await, 409, "token_not_active").await;
}

#[tokio::test]
async fn a_revoked_token_is_refused_at_once_and_after_a_restart() {
    let mut world = World::start();
    let token = world.token(&["read"], &[]).await;
    assert_eq!(world.get(LIST, &token).await.status(), 200);
    let path = format!("/v1/tokens/{}", id_of(&token));
    for _ in 0..2 {
        let revoked = world.ask(Method::DELETE, &path, &world.admin).send().await.unwrap();
        assert_eq!(revoked.status(), 200);
        let body: Value = revoked.json().await.unwrap();
        assert_eq!(body["state"], "revoked");
    }
    problem(world.get(LIST, &token).await, 401, "token_revoked").await;
    world.service.kill();
    world.service = Service::start(world.folder.path());
    problem(world.get(LIST, &token).await, 401, "token_revoked").await;

    let last = format!("/v1/tokens/{}", id_of(&world.admin));
    let refused = world.ask(Method::DELETE, &last, &world.admin).send().await.unwrap();
    problem(refused, 409, "last_admin_token").await;
    let other = world.token(&["admin"], &[]).await;
    assert_eq!(world.ask(Method::DELETE, &last, &other).send().await.unwrap().status(), 200);
}

#[tokio::test]
async fn an_unknown_token_is_refused() {
    let world = World::start();
    let other_secret = {
        let mut token = world.admin.clone();
        let last = if token.pop() == Some('0') { 'g' } else { '0' };
        token.push(last);
        token
    };
    for token in ["", "mw_", "secret", &other_secret, &world.admin[..40], &world.admin.replace("mw_", "xx_")] {
        problem(world.get(LIST, token).await, 401, "unauthorized").await;
    }
    let with = |value: String| world.service.get(LIST).header("authorization", value).send();
    problem(with("Basic dXNlcjpwYXNz".to_owned()).await.unwrap(), 401, "unauthorized").await;
    problem(with(world.admin.clone()).await.unwrap(), 401, "unauthorized").await;
    assert_eq!(
        with(format!("bearer {}", world.admin)).await.unwrap().status(),
        200,
        "the scheme is not case-sensitive"
    );
    let twice = world.ask(Method::GET, LIST, &world.admin).header("authorization", format!("Bearer {}", world.admin));
    problem(twice.send().await.unwrap(), 401, "unauthorized").await;
}

#[tokio::test]
async fn a_token_in_the_address_is_refused_with_the_way_to_do_it() {
    let world = World::start();
    let admin = &world.admin;
    for path in [
        format!("{LIST}?token={admin}"),
        format!("{LIST}?limit=1&ACCESS_TOKEN=abc"),
        format!("{LIST}?x={admin}"),
        format!("{LIST}/{admin}"),
        format!("/healthz?access_token={admin}"),
    ] {
        let refused = problem(world.get(&path, admin).await, 400, "token_in_address").await;
        let detail = refused["detail"].as_str().unwrap();
        assert!(detail.contains("Authorization: Bearer") && !refused.to_string().contains(admin.as_str()), "{detail}");
    }
}

#[tokio::test]
async fn tokens_are_managed_offline_and_a_running_service_is_asked_instead() {
    let folder = tempfile::tempdir().unwrap();
    let run = |arguments: &[&str]| {
        let output = program(arguments, folder.path());
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
        (output.status.success(), text(output.stdout), text(output.stderr))
    };
    let (_, admin, _) = run(&["token", "create", "--name", "me", "--scope", "admin"]);
    let create = "token create --name gate --scope ingest --scope read --structure three-dof --source gateway-1";
    let (_, gate, _) = run(&create.split(' ').collect::<Vec<_>>());
    let (admin, gate) = (admin.trim(), gate.trim());
    let (_, rotated, _) = run(&["token", "rotate", id_of(gate), "--overlap-s", "0"]);
    let (done, ..) = run(&["token", "revoke", id_of(admin)]);
    assert!(done);
    let (_, list, _) = run(&["token", "list"]);
    for expected in [id_of(admin), "revoked", id_of(gate), "ingest,read", "three-dof", "gateway-1", "never"] {
        assert!(list.contains(expected), "{expected} is missing:\n{list}");
    }
    for (arguments, expected) in [
        (vec!["token", "revoke", "nothing"], "there is no token \"nothing\""),
        (vec!["token", "rotate", id_of(admin)], "revoked: make a new one"),
        (vec!["token", "create", "--name", "x", "--scope", "root"], "not one of ingest, read, admin"),
        (vec!["token", "create", "--name", "x", "--scope", "read", "--structure", "A"], "structure id"),
        (vec!["token", "create", "--name", "x", "--scope", "read", "--source", "a"], "scope ingest"),
        (vec!["token", "create", "--name", "x", "--scope", "read", "--expires-at", "2020-01-01T00:00:00Z"], "future"),
    ] {
        let (done, _, error) = run(&arguments);
        assert!(!done && error.contains(expected), "{arguments:?}: {error}");
    }

    let service = Service::start(folder.path());
    let ask = |token: &str| service.get("/v1/structures/three-dof").bearer_auth(token).send();
    problem(ask(gate).await.unwrap(), 401, "token_expired").await;
    problem(ask(admin).await.unwrap(), 401, "token_revoked").await;
    assert_eq!(ask(rotated.trim()).await.unwrap().status(), 200);
    let (done, _, error) = run(&["token", "list"]);
    assert!(!done && error.contains("POST /v1/tokens"), "{error}");
}
