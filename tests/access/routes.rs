//! Each route is requested with each kind of token and compared with a table of the scope that it should need.
//!
//! The routes are found in the sources and requested from the running program: a route without a row here fails the
//! test.

use std::collections::BTreeSet;
use std::path::Path;

use reqwest::Method;
use serde_json::{json, Value};

use crate::access::world::World;
use crate::helpers::{created, measurements, problem, repository};

/// What a route needs.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Needs {
    Nothing,
    Read,
    Ingest,
    Admin,
}
use Needs::{Admin, Ingest, Nothing, Read};

/// What a route is about: one structure (also by a diagnosis, training or job), a filtered list, or the whole service.
#[derive(Debug, Clone, Copy, PartialEq)]
enum About {
    Structure,
    List,
    Service,
}
use About::{List, Service, Structure};

const TABLE: [(&str, &str, Needs, About); 81] = [
    ("GET", "/v1/structures", Read, List),
    ("GET", "/v1/structures/{}", Read, Structure),
    ("PUT", "/v1/structures/{}", Admin, Structure),
    ("GET", "/v1/structures/{}/drawing.svg", Read, Structure),
    ("POST", "/v1/structures/{}/batches", Ingest, Structure),
    ("POST", "/v1/structures/{}/tables/preview", Ingest, Structure),
    ("GET", "/v1/structures/{}/batches/{}", Read, Structure),
    ("GET", "/v1/structures/{}/history", Read, Structure),
    ("PUT", "/v1/structures/{}/reference", Admin, Structure),
    ("POST", "/v1/structures/{}/reference", Admin, Structure),
    ("POST", "/v1/structures/{}/reference/extend", Admin, Structure),
    ("GET", "/v1/structures/{}/references", Read, Structure),
    ("POST", "/v1/structures/{}/baseline", Admin, Structure),
    ("GET", "/v1/structures/{}/exceedances", Read, Structure),
    ("GET", "/v1/structures/{}/alarms", Read, Structure),
    ("POST", "/v1/structures/{}/alarms/{}/acknowledgement", Admin, Structure),
    ("POST", "/v1/structures/{}/alarms/{}/comments", Admin, Structure),
    ("PUT", "/v1/structures/{}/alarms/{}/assignee", Admin, Structure),
    ("POST", "/v1/structures/{}/alarms/{}/closing", Admin, Structure),
    ("POST", "/v1/structures/{}/alarms/{}/reopening", Admin, Structure),
    ("GET", "/v1/structures/{}/notes", Read, Structure),
    ("POST", "/v1/structures/{}/notes", Admin, Structure),
    ("DELETE", "/v1/structures/{}/notes/{}", Admin, Structure),
    ("GET", "/v1/structures/{}/charts", Read, Structure),
    ("GET", "/v1/structures/{}/maintenance", Read, Structure),
    ("POST", "/v1/structures/{}/maintenance", Admin, Structure),
    ("GET", "/v1/structures/{}/identifiability", Read, Structure),
    ("GET", "/v1/structures/{}/diagnoses", Read, Structure),
    ("POST", "/v1/structures/{}/diagnoses", Admin, Structure),
    ("DELETE", "/v1/structures/{}/extension", Admin, Structure),
    ("GET", "/v1/diagnoses/{}", Read, Structure),
    ("GET", "/v1/diagnoses/{}/report", Read, Structure),
    ("POST", "/v1/diagnoses/{}/extension", Admin, Structure),
    ("GET", "/v1/structures/{}/trainings", Read, Structure),
    ("POST", "/v1/structures/{}/trainings", Admin, Structure),
    ("GET", "/v1/trainings/{}", Read, Structure),
    ("DELETE", "/v1/jobs/{}", Admin, Structure),
    ("POST", "/v1/jobs/{}/first", Admin, Structure),
    ("GET", "/v1/tokens", Admin, Service),
    ("POST", "/v1/tokens", Admin, Service),
    ("DELETE", "/v1/tokens/{}", Admin, Service),
    ("POST", "/v1/tokens/{}/rotation", Admin, Service),
    ("GET", "/v1/audit", Admin, Service),
    ("GET", "/metrics", Read, Service),
    ("GET", "/healthz", Nothing, Service),
    ("GET", "/readyz", Nothing, Service),
    ("GET", "/version", Nothing, Service),
    // The dashboard with its files, and the documentation.
    ("GET", "/v1/overview", Read, List),
    ("GET", "/v1/jobs", Read, List),
    ("GET", "/v1/events", Read, List),
    ("GET", "/v1/structures/{}/series", Read, Structure),
    ("GET", "/v1/structures/{}/report", Read, Structure),
    ("GET", "/v1/structures/{}/batches/{}/detail", Read, Structure),
    ("GET", "/v1/structures/{}/measurements", Read, Structure),
    ("GET", "/v1/structures/{}/export", Read, Structure),
    ("POST", "/v1/structures/{}/model/reload", Admin, Structure),
    ("DELETE", "/v1/structures/{}", Admin, Structure),
    ("GET", "/v1/backups", Admin, Service),
    ("POST", "/v1/backups", Admin, Service),
    ("GET", "/v1/retention", Admin, Service),
    ("GET", "/v1/webhooks", Admin, Service),
    ("POST", "/v1/webhooks", Admin, Service),
    ("GET", "/v1/webhooks/{}", Admin, Service),
    ("PUT", "/v1/webhooks/{}", Admin, Service),
    ("DELETE", "/v1/webhooks/{}", Admin, Service),
    ("POST", "/v1/webhooks/{}/test", Admin, Service),
    ("POST", "/v1/webhooks/{}/secret", Admin, Service),
    ("GET", "/v1/webhooks/{}/deliveries", Admin, Service),
    ("POST", "/v1/webhooks/{}/deliveries/{}/retry", Admin, Service),
    ("GET", "/v1/quarantine", Admin, Service),
    ("GET", "/v1/quarantine/{}", Admin, Service),
    ("DELETE", "/v1/quarantine/{}", Admin, Service),
    ("GET", "/openapi.json", Nothing, Service),
    ("GET", "/docs", Nothing, Service),
    ("GET", "/docs/", Nothing, Service),
    ("GET", "/docs/{}", Nothing, Service),
    ("GET", "/docs/api-explorer", Nothing, Service),
    ("GET", "/docs/api-explorer/", Nothing, Service),
    ("GET", "/docs/api-explorer/{}", Nothing, Service),
    ("GET", "/", Nothing, Service),
    ("GET", "/assets/{}", Nothing, Service),
];

/// The structure of the limited tokens.
const OWN: &str = "three-dof";
const OTHER: &str = "ruler-frame-4dof";

/// All text in quotes in the sources of `src/http` that could be a route, with `{}` for each parameter.
fn candidates(folder: &Path, found: &mut BTreeSet<String>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            candidates(&path, found);
            continue;
        }
        let text = std::fs::read_to_string(&path).unwrap();
        for quoted in text.split('"').filter(|quoted| quoted.starts_with('/') && quoted.len() < 200) {
            let plain = |c: char| c.is_ascii_alphanumeric() || "/_-.{}*".contains(c);
            if quoted.chars().all(plain) {
                let segments = quoted.split('/').map(|s| if s.starts_with('{') { "{}" } else { s });
                found.insert(segments.collect::<Vec<_>>().join("/"));
            }
        }
    }
}

/// A path of a pattern that names `structure`; all other parameters name nothing that exists.
fn path_of(pattern: &str, structure: &str, diagnosis: &str) -> String {
    // The routes of a training or job are asked for the diagnosis: what matters here is the structure that its id leads to.
    let of_job = ["/v1/diagnoses/", "/v1/trainings/", "/v1/jobs/"].iter().any(|start| pattern.starts_with(start));
    let first = if of_job { diagnosis } else { structure };
    pattern.replacen("{}", first, 1).replace("{}", "1")
}

/// Methods that a path supports, from the `Allow` header of the answer to an unsupported one.
async fn methods(world: &World, path: &str) -> Vec<String> {
    let response = world.ask(Method::from_bytes(b"PROBE").unwrap(), path, &world.admin).send().await.unwrap();
    if response.status() == 404 {
        return Vec::new();
    }
    assert_eq!(response.status(), 405, "PROBE {path}");
    let allow = response.headers()["allow"].to_str().unwrap().to_owned();
    allow.split(',').map(str::trim).filter(|method| *method != "HEAD").map(str::to_owned).collect()
}

/// A diagnosis of [`OWN`].
async fn diagnosis(world: &World) -> String {
    let batch = json!({ "measurements": measurements([4.0, 5.0, 6.0], 8, 0) });
    created(world.post(&format!("/v1/structures/{OWN}/batches"), &world.admin, &batch).await).await;
    let begun = world.post(&format!("/v1/structures/{OWN}/diagnoses"), &world.admin, &json!({})).await;
    assert_eq!(begun.status(), 202);
    let body: Value = begun.json().await.unwrap();
    body["diagnosis"].as_str().unwrap().to_owned()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_route_asks_for_what_the_table_says() {
    let world = World::start();
    let diagnosis = diagnosis(&world).await;
    let mut patterns = BTreeSet::new();
    candidates(&repository("src/http"), &mut patterns);
    let mut routes = Vec::new();
    for pattern in &patterns {
        let path = path_of(pattern, OWN, &diagnosis);
        routes.extend(methods(&world, &path).await.into_iter().map(|method| (method, pattern.clone())));
    }
    assert!(routes.len() >= 29, "only {} routes were found: {routes:?}", routes.len());

    // Scopes of a token, and whether it is limited to a structure.
    let kinds: [(&[&str], Option<&str>); 8] = [
        (&["read"], None),
        (&["ingest"], None),
        (&["admin"], None),
        (&["read"], Some(OWN)),
        (&["ingest"], Some(OWN)),
        (&["admin"], Some(OWN)),
        (&["read", "ingest"], Some(OTHER)),
        (&["admin"], Some(OTHER)),
    ];
    let mut tokens = Vec::new();
    for (scopes, structure) in kinds {
        let structures: Vec<&str> = structure.into_iter().collect();
        tokens.push((scopes, structure, world.token(scopes, &structures).await));
    }
    for (method, pattern) in &routes {
        let row = TABLE.iter().find(|(m, p, ..)| m == method && p == pattern);
        let Some((_, _, needs, about)) = row else {
            panic!("{method} {pattern} has no row in the table: add one, and see http::access::route");
        };
        let path = path_of(pattern, OWN, &diagnosis);
        let method = Method::from_bytes(method.as_bytes()).unwrap();
        let bare = world.service.request(method.clone(), &path).send().await.unwrap();
        if *needs == Nothing {
            assert!(![401, 403].contains(&bare.status().as_u16()), "{method} {pattern}: {}", bare.status());
        } else {
            assert!(bare.headers()["www-authenticate"].to_str().unwrap().starts_with("Bearer"));
            problem(bare, 401, "unauthorized").await;
        }
        for (scopes, structure, token) in &tokens {
            let scope = match needs {
                Nothing => true,
                Read => scopes.contains(&"read") || scopes.contains(&"admin"),
                Ingest => scopes.contains(&"ingest") || scopes.contains(&"admin"),
                Admin => scopes.contains(&"admin"),
            };
            let reaches = *needs == Nothing
                || match (about, structure) {
                    (_, None) | (List, _) => true,
                    (Structure, Some(structure)) => *structure == OWN,
                    (Service, Some(_)) => false,
                };
            let response = world.ask(method.clone(), &path, token).send().await.unwrap();
            let who = format!("{method} {pattern} with {scopes:?} for {structure:?}");
            if scope && reaches {
                assert!(![401, 403, 500].contains(&response.status().as_u16()), "{who}: {}", response.status());
            } else {
                assert_eq!(response.status(), 403, "{who}");
                let code = if scope { "forbidden_structure" } else { "forbidden_scope" };
                problem(response, 403, code).await;
            }
        }
    }
}

#[tokio::test]
async fn a_limited_token_sees_only_its_structures() {
    let world = World::start();
    let ids = async |token: &str| {
        let list = world.read("/v1/structures", token).await;
        let items = list["items"].as_array().unwrap().clone();
        items.iter().map(|item| item["id"].as_str().unwrap().to_owned()).collect::<Vec<_>>()
    };
    let everything = ids(&world.admin).await;
    assert!(everything.len() >= 2, "{everything:?}");
    let limited = world.token(&["read", "ingest"], &[OWN]).await;
    assert_eq!(ids(&limited).await, [OWN]);

    let batch = json!({ "measurements": measurements([4.0, 5.0, 6.0], 3, 0) });
    let own = world.post(&format!("/v1/structures/{OWN}/batches"), &limited, &batch).await;
    created(own).await;
    let other = world.post(&format!("/v1/structures/{OTHER}/batches"), &limited, &batch).await;
    problem(other, 403, "forbidden_structure").await;
    // The same id in other letters is a different path and does not circumvent the check.
    for path in ["/v1/structures/%72uler-frame-4dof", "/v1/structures/three-dof%2F..%2Fruler-frame-4dof"] {
        problem(world.get(path, &limited).await, 403, "forbidden_structure").await;
    }
    assert_eq!(world.get("/v1/structures/%74hree-dof", &limited).await.status(), 200);
}

#[tokio::test]
async fn heads_are_asked_for_tokens_like_gets_and_unknown_paths_are_unknown() {
    let world = World::start();
    let head = world.service.request(Method::HEAD, "/v1/structures").send().await.unwrap();
    assert_eq!(head.status(), 401);
    problem(world.service.get("/v1/nothing").send().await.unwrap(), 404, "unknown_route").await;
    let options = world.service.request(Method::OPTIONS, "/v1/structures").send().await.unwrap();
    problem(options, 401, "unauthorized").await;
}
