//! The OpenAPI document is valid, complete, and agrees with the answers.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde_json::{json, Value};

use crate::helpers::{command, created, eventually, measurements, problem, repository, spawn, Service};

const METHODS: [&str; 5] = ["get", "put", "post", "delete", "patch"];

/// Path, method and operation of each operation.
fn operations(document: &Value) -> Vec<(String, String, Value)> {
    let paths = document["paths"].as_object().unwrap();
    let of = |(path, item): (&String, &Value)| {
        let methods = METHODS.iter().filter(|method| item[**method].is_object());
        methods.map(|method| (path.clone(), (*method).to_owned(), item[*method].clone())).collect::<Vec<_>>()
    };
    paths.iter().flat_map(of).collect()
}

fn references(value: &Value, found: &mut BTreeSet<String>) {
    match value {
        Value::Object(map) => {
            found.extend(map.get("$ref").and_then(Value::as_str).map(str::to_owned));
            map.values().for_each(|value| references(value, found));
        }
        Value::Array(list) => list.iter().for_each(|value| references(value, found)),
        _ => {}
    }
}

/// A validator of a schema inside the document.
fn validator(document: &Value, schema: &Value) -> jsonschema::Validator {
    let mut schema = schema.clone();
    schema["components"] = document["components"].clone();
    jsonschema::draft202012::options().should_validate_formats(true).build(&schema).unwrap()
}

/// The schema that an operation gives for a status and content type.
fn response_schema(document: &Value, path: &str, method: &str, status: u16, content_type: &str) -> Value {
    let response = &document["paths"][path][method]["responses"][status.to_string()];
    let essence = content_type.split(';').next().unwrap();
    let schema = &response["content"][essence]["schema"];
    assert!(schema.is_object(), "{method} {path}: {status} {essence} is not in the document: {response}");
    schema.clone()
}

#[tokio::test]
async fn the_document_is_complete() {
    let (service, _folder) = spawn();
    let document = service.read("/openapi.json").await;
    assert!(document["openapi"].as_str().unwrap().starts_with("3.1"), "{}", document["openapi"]);
    assert_eq!(document["info"]["version"], env!("CARGO_PKG_VERSION"));

    let mut found = BTreeSet::new();
    references(&document, &mut found);
    assert!(found.len() > 30, "{found:?}");
    for reference in &found {
        let target = document.pointer(reference.trim_start_matches('#'));
        assert!(target.is_some(), "{reference} leads nowhere");
    }
    let schemas = document["components"]["schemas"].as_object().unwrap();
    for (name, schema) in schemas {
        validator(&document, schema);
        let used = found.contains(&format!("#/components/schemas/{name}"));
        assert!(used, "{name} is in the document and used nowhere");
    }

    let tags: BTreeSet<&str> =
        document["tags"].as_array().unwrap().iter().map(|t| t["name"].as_str().unwrap()).collect();
    let mut names = BTreeSet::new();
    let operations = operations(&document);
    assert!(operations.len() >= 52, "{}", operations.len());
    for (path, method, operation) in operations {
        let place = format!("{method} {path}: {operation}");
        assert!(
            names.insert(operation["operationId"].as_str().unwrap().to_owned()),
            "another operation has the same id: {place}"
        );
        for text in ["summary", "description"] {
            assert!(operation[text].as_str().is_some_and(|t| !t.is_empty()), "{text}: {place}");
        }
        assert!(operation["tags"].as_array().unwrap().iter().all(|t| tags.contains(t.as_str().unwrap())), "{place}");
        let in_path: BTreeSet<&str> = path.split(['{', '}']).skip(1).step_by(2).collect();
        let parameters = operation["parameters"].as_array().cloned().unwrap_or_default();
        let described = parameters.iter().filter(|p| p["in"] == "path").map(|p| p["name"].as_str().unwrap());
        assert_eq!(described.collect::<BTreeSet<_>>(), in_path, "{place}");
        for parameter in &parameters {
            assert!(parameter["description"].as_str().is_some_and(|d| d.len() > 5), "{parameter}: {place}");
        }
        let responses = operation["responses"].as_object().unwrap();
        assert!(responses.keys().any(|status| status.starts_with('2')), "{place}");
        let takes = !in_path.is_empty() || operation["requestBody"].is_object();
        assert!(!takes || responses.keys().any(|status| status.starts_with('4')), "{place}");
        for (status, response) in responses {
            assert!(response["headers"]["X-Request-Id"].is_object(), "{status}: {place}");
            let readiness = path == "/readyz" && status == "503";
            if !status.starts_with('2') && !readiness {
                let schema = &response["content"]["application/problem+json"]["schema"]["$ref"];
                assert_eq!(schema, "#/components/schemas/Problem", "{status}: {place}");
            }
        }
        for (content_type, content) in operation["requestBody"]["content"].as_object().into_iter().flatten() {
            assert!(!examples(content).is_empty(), "no example of {content_type}: {place}");
        }
    }
}

/// The text of each file of `src/http`, without comments and unit tests, by its path in the folder.
fn sources() -> BTreeMap<String, String> {
    fn walk(folder: &Path, prefix: &str, found: &mut BTreeMap<String, String>) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = format!("{prefix}{}", path.file_name().unwrap().to_str().unwrap());
            if path.is_dir() {
                walk(&path, &format!("{name}/"), found);
                continue;
            }
            let text = std::fs::read_to_string(&path).unwrap();
            let code = text.split("#[cfg(test)]\nmod tests {").next().unwrap();
            let code = code.lines().filter(|line| !line.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n");
            found.insert(name, code);
        }
    }
    let mut found = BTreeMap::new();
    walk(&repository("src/http"), "", &mut found);
    found
}

/// Router and document agree, provided that every route is added through the document.
#[test]
fn every_route_is_added_with_its_description() {
    let mut plain = BTreeMap::new();
    for (name, code) in sources() {
        let count =
            [".route(", ".route_service(", ".nest("].iter().map(|call| code.matches(call).count()).sum::<usize>();
        if count > 0 {
            plain.insert(name, count);
        }
    }
    // The documentation, the OpenAPI document and its page are not in that document; `/` and `/assets` are the files of the dashboard. A
    // standby answers the three probes itself, which are in the document as those of the service, and passes every other path on.
    let expected = [("docs.rs", 3), ("explorer.rs", 4), ("mod.rs", 2), ("standby.rs", 5)];
    let expected = BTreeMap::from(expected.map(|(file, count)| (file.to_owned(), count)));
    assert_eq!(plain, expected, "routes go into `http::api` by `routes!`");
}

/// Every code that the sources can answer is in the document.
#[tokio::test]
async fn every_code_of_a_problem_is_listed() {
    let (service, _folder) = spawn();
    let document = service.read("/openapi.json").await;
    let schema = &document["components"]["schemas"]["Problem"]["properties"]["code"];
    let listed: BTreeSet<&str> = schema["enum"].as_array().unwrap().iter().map(|c| c.as_str().unwrap()).collect();
    let mut sources = sources();
    // The codes of what a disk refuses.
    sources.insert("store error".to_owned(), std::fs::read_to_string(repository("src/store/error.rs")).unwrap());
    let mut sent = BTreeSet::new();
    for (name, text) in sources {
        // `ApiError::new(StatusCode::X, "code", …)` and `invalid("code", …)`, over line breaks too.
        let text = text.split_whitespace().collect::<Vec<_>>().join(" ").replace("( ", "(");
        // Text before a code, and the number of the quoted text after it that is the code.
        let mut calls = vec![("::new(StatusCode::", 1), ("::invalid(\"", 0), ("::unavailable(\"", 0)];
        match name.as_str() {
            "access/control.rs" => calls.push(("=> \"", 0)),
            "access/limit.rs" => calls.push(("Limit::new(\"", 2)),
            "store error" => calls.push(("=> Some(\"", 0)),
            _ => {}
        }
        for (start, quoted) in calls {
            for rest in text.split(start).skip(1) {
                let end = rest.find(';').unwrap_or(rest.len());
                // A code that is a variable is looked for where the variable is set.
                sent.extend(rest[..end].split('"').nth(quoted).map(str::to_owned));
            }
        }
    }
    sent.retain(|code| code.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'_'));
    assert!(sent.len() > 50, "{}: {sent:?}", sent.len());
    let missing: Vec<&String> = sent.iter().filter(|code| !listed.contains(code.as_str())).collect();
    assert!(missing.is_empty(), "{missing:?} belong into problem::CODES");
    let unused: Vec<&&str> = listed.iter().filter(|code| !sent.contains(**code)).collect();
    assert!(unused.is_empty(), "{unused:?} are in problem::CODES, and nothing answers them");
}

/// Every operation states whether it needs a token, and which scope.
#[tokio::test]
async fn every_operation_says_which_token_it_needs() {
    let (service, _folder) = spawn();
    let document = service.read("/openapi.json").await;
    let scheme = &document["components"]["securitySchemes"]["bearer"];
    assert_eq!((&scheme["type"], &scheme["scheme"]), (&json!("http"), &json!("bearer")));
    let open = ["/healthz", "/readyz", "/version"];
    for (path, method, operation) in operations(&document) {
        let place = format!("{method} {path}: {operation}");
        if open.contains(&path.as_str()) {
            assert_eq!(operation["security"], json!([]), "{place}");
            assert!(operation["responses"]["401"].is_null(), "{place}");
            continue;
        }
        let scope = operation["security"][0]["bearer"][0].as_str().unwrap_or_else(|| panic!("{place}"));
        assert!(["ingest", "read", "admin"].contains(&scope), "{place}");
        for status in ["401", "403", "429"] {
            assert!(operation["responses"][status].is_object(), "{status}: {place}");
        }
    }
    for (path, method, scope) in [
        ("/v1/structures", "get", "read"),
        ("/v1/structures/{id}", "put", "admin"),
        ("/v1/structures/{id}/batches", "post", "ingest"),
        ("/v1/tokens", "get", "admin"),
        ("/metrics", "get", "read"),
    ] {
        assert_eq!(document["paths"][path][method]["security"], json!([{ "bearer": [scope] }]), "{method} {path}");
    }
}

/// The examples of a body, of which OpenAPI allows one or several with names.
fn examples(content: &Value) -> Vec<&Value> {
    let several = content["examples"].as_object().into_iter().flatten().map(|(_, example)| &example["value"]);
    Some(&content["example"]).filter(|example| !example.is_null()).into_iter().chain(several).collect()
}

#[tokio::test]
async fn examples_are_valid() {
    let (service, _folder) = spawn();
    let document = service.read("/openapi.json").await;
    let mut checked = 0;
    for (path, method, operation) in operations(&document) {
        for (content_type, content) in operation["requestBody"]["content"].as_object().into_iter().flatten() {
            if content_type == "application/json" {
                let validator = validator(&document, &content["schema"]);
                for example in examples(content) {
                    assert!(validator.is_valid(example), "{method} {path}: {example}");
                    checked += 1;
                }
            }
        }
    }
    assert!(checked >= 7, "{checked}");
    // The service accepts the examples of a batch and of a structure in every content type.
    for (path, method, at) in [
        ("/v1/structures/{id}/batches", "post", "/v1/structures/three-dof/batches"),
        ("/v1/structures/{id}/tables/preview", "post", "/v1/structures/three-dof/tables/preview"),
        ("/v1/structures/{id}", "put", "/v1/structures/one-mass"),
    ] {
        let content = document["paths"][path][method]["requestBody"]["content"].as_object().unwrap();
        for (content_type, content) in content {
            let example = &content["example"];
            let mut body = example.as_str().map_or_else(|| example.to_string(), str::to_owned);
            let mut sent_as = content_type.clone();
            if content_type == "multipart/form-data" {
                let part = "Content-Disposition: form-data; name=\"file\"; filename=\"table.csv\"";
                body = format!("--x\r\n{part}\r\n\r\n{}\r\n--x--\r\n", example["file"].as_str().unwrap());
                sent_as += "; boundary=x";
            }
            let method = reqwest::Method::from_bytes(method.to_uppercase().as_bytes()).unwrap();
            let request = service.request(method, at).header("content-type", sent_as).body(body);
            let answer = request.send().await.unwrap();
            assert!(answer.status().is_success(), "{content_type}: {}", answer.text().await.unwrap());
            if content_type == "application/x-ndjson" {
                assert_eq!(answer.json::<Value>().await.unwrap()["stored"], 1);
            }
        }
    }
}

/// Requests a path and checks the answer against the document.
async fn check(service: &Service, document: &Value, template: &str, path: &str) -> (u16, Value) {
    let answer = service.get(path).send().await.unwrap();
    let status = answer.status().as_u16();
    let content_type = answer.headers()["content-type"].to_str().unwrap().to_owned();
    let schema = response_schema(document, template, "get", status, &content_type);
    let text = answer.text().await.unwrap();
    let validator = validator(document, &schema);
    // For lines of JSON the schema describes one line.
    let values: Vec<Value> = match content_type.as_str() {
        lines if lines.contains("ndjson") => text.lines().map(|line| serde_json::from_str(line).unwrap()).collect(),
        one if one.contains("json") => vec![serde_json::from_str(&text).unwrap()],
        _ => vec![json!(text)],
    };
    for value in &values {
        let errors: Vec<String> =
            validator.iter_errors(value).map(|e| format!("{} at {}", e, e.instance_path())).collect();
        assert!(errors.is_empty(), "GET {path}: {errors:?}\n{value:#}");
    }
    (status, values.into_iter().next().unwrap_or_default())
}

#[tokio::test]
async fn the_answer_of_each_get_agrees_with_the_document() {
    let (service, _folder) = spawn();
    let document = service.read("/openapi.json").await;
    let mut first = measurements([4.0, 5.0, 6.0], 20, 0);
    first[0]["std_hz"] = json!([0.001, null, 0.002]);
    first[1]["settings"] = json!({ "k1": 4.0 });
    let first = service.post_batch("three-dof", &first).await;
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": [first["batch"]] })).await).await;
    for i in 1..4 {
        service.post_batch("three-dof", &measurements([4.0, 4.2, 6.0], 12, i * 100_000)).await;
    }
    let window = json!({ "from": "2026-01-01T00:00:00Z", "to": "2026-01-01T01:00:00Z", "reason": "a test" });
    created(service.post("/v1/structures/three-dof/maintenance", &window).await).await;
    let alarms = service.read("/v1/structures/three-dof/alarms").await;
    let alarm = alarms["items"][0]["alarm"].as_i64().unwrap_or_else(|| panic!("{alarms}"));
    let path = format!("/v1/structures/three-dof/alarms/{alarm}/acknowledgement");
    assert_eq!(service.post(&path, &json!({ "by": "A. Engineer" })).await.status(), 200);
    let diagnosis = service.post("/v1/structures/three-dof/diagnoses", &json!({})).await;
    assert_eq!(diagnosis.status(), 202);
    let diagnosis: Value = diagnosis.json().await.unwrap();
    let schema = response_schema(&document, "/v1/structures/{id}/diagnoses", "post", 202, "application/json");
    assert!(validator(&document, &schema).is_valid(&diagnosis), "{diagnosis:#}");
    let diagnosis = diagnosis["diagnosis"].as_str().unwrap();
    eventually("the end of the diagnosis", async || {
        (service.read(&format!("/v1/diagnoses/{diagnosis}")).await["state"] != "running").then_some(())
    })
    .await;

    let recipe = json!({ "samples": 1_000, "epochs": 2_000, "units": 1, "rounds": 1 });
    let training = service.post("/v1/structures/three-dof/trainings", &recipe).await;
    assert_eq!(training.status(), 202);
    let training: Value = training.json().await.unwrap();
    let schema = response_schema(&document, "/v1/structures/{id}/trainings", "post", 202, "application/json");
    assert!(validator(&document, &schema).is_valid(&training), "{training:#}");
    let training = training["training"].as_str().unwrap();
    let cancelled = service.request(reqwest::Method::DELETE, &format!("/v1/jobs/{training}")).send().await.unwrap();
    assert_eq!(cancelled.status(), 200);
    eventually("the end of the training", async || {
        (service.read(&format!("/v1/trainings/{training}")).await["state"] == "cancelled").then_some(())
    })
    .await;

    let webhook = json!({ "url": "https://receiver.invalid/alarms", "enabled": false });
    let webhook = created(service.post("/v1/webhooks", &webhook).await).await;
    created(service.post("/v1/backups", &json!({})).await).await;

    let mut asked = BTreeSet::new();
    for (path, _, _) in operations(&document).iter().filter(|(_, method, _)| method == "get") {
        if path == "/v1/events" {
            // The stream does not end.
            let answer = service.get(path).send().await.unwrap();
            let content_type = answer.headers()["content-type"].to_str().unwrap();
            response_schema(&document, path, "get", 200, content_type);
            continue;
        }
        if path == "/v1/quarantine/{message}" {
            // Messages come only from a broker.
            assert_eq!(check(&service, &document, path, "/v1/quarantine/1").await.0, 404);
            continue;
        }
        let concrete = if path.starts_with("/v1/diagnoses") {
            path.replace("{id}", diagnosis)
        } else if path.starts_with("/v1/trainings") {
            path.replace("{id}", training)
        } else if path.starts_with("/v1/webhooks") {
            path.replace("{id}", webhook["webhook"].as_str().unwrap())
        } else {
            path.replace("{id}", "three-dof").replace("{batch}", first["batch"].as_str().unwrap())
        };
        let (status, _) = check(&service, &document, path, &concrete).await;
        assert_eq!(status, 200, "{path}");
        asked.insert(path.clone());
    }
    assert!(asked.len() >= 28, "{asked:?}");
    // Problems and the other formats are described too.
    let structure = "/v1/structures/{id}";
    assert_eq!(check(&service, &document, structure, "/v1/structures/none").await.0, 404);
    assert_eq!(check(&service, &document, structure, "/v1/structures/N%20N").await.0, 422);
    for (template, query) in [("history", "format=csv"), ("measurements", "format=csv")] {
        let template = format!("/v1/structures/{{id}}/{template}");
        let path = format!("{}?{query}", template.replace("{id}", "three-dof"));
        check(&service, &document, &template, &path).await;
    }
}

#[tokio::test]
async fn a_structure_of_the_service_agrees_with_its_schema() {
    let (service, _folder) = spawn();
    let document = service.read("/openapi.json").await;
    let definition = json!({ "$ref": "#/components/schemas/StructureDefinition" });
    let validator = validator(&document, &definition);
    for id in ["three-dof", "ruler-frame-4dof", "rig"] {
        let given = service.read(&format!("/v1/structures/{id}")).await;
        assert!(validator.is_valid(&given["definition"]), "{id}: {}", given["definition"]);
    }
    assert!(!validator.is_valid(&json!({ "id": "x", "modes": 1, "colour": "red" })));
    assert!(!validator.is_valid(&json!({ "modes": 1 })));
}

/// The service accepts what the document allows, and refuses what it forbids.
#[tokio::test]
async fn the_document_allows_exactly_the_bodies_that_the_service_accepts() {
    let (service, _folder) = spawn();
    let document = service.read("/openapi.json").await;
    let long = |length: usize| "a".repeat(length);
    let url = |length: usize| json!({ "url": format!("https://receiver.invalid/{}", long(length - 25)) });
    let to = |url: &str| json!({ "url": url });
    let of = |field: &str, word: &str| json!({ "url": "https://receiver.invalid/", field: [word] });
    let named = |name: &str| json!({ "name": name, "scopes": ["admin"] });
    let webhooks = [
        to("https://receiver.invalid/"),
        to("http://receiver.invalid:8080/a?b=c"),
        to("ftp://receiver.invalid/"),
        to("receiver.invalid"),
        to("https://me:secret@receiver.invalid/"),
        to(""),
        url(2_000),
        url(2_001),
        of("events", "alarm.opened"),
        of("events", "alarm.reopened"),
        of("events", "alarm.ended"),
        of("events", "alarm.withdrawn"),
        of("events", "alarm.acknowledged"),
        of("events", "alarm.closed"),
        of("events", "org.modalwatch.alarm.opened"),
        of("alarm_kinds", "damage"),
        of("alarm_kinds", "simulation_does_not_fit"),
        of("alarm_kinds", "silence"),
        of("alarm_kinds", "fire"),
    ];
    let backups = ["a", "A1._-", &long(64), &long(65), "", ".hidden", "-a", "a/b", "ä"];
    let backups = backups.map(|name| json!({ "name": name }));
    let limited = |structures: Value| json!({ "name": "gateway", "scopes": ["ingest"], "structures": structures });
    let tokens = [
        named("a"),
        named(&long(100)),
        named(&"ä".repeat(100)),
        named(&long(101)),
        named(""),
        named("two\nlines"),
        json!({ "name": "gateway", "scopes": [] }),
        json!({ "name": "gateway", "scopes": ["write"] }),
        limited(json!(["three-dof"])),
        limited(json!([])),
        limited(json!((0..1_001).map(|i| format!("s{i}")).collect::<Vec<_>>())),
    ];
    let mut bearer = String::new();
    // Tokens come last: the first one closes the service to requests without a token.
    for (path, bodies) in [("/v1/webhooks", &webhooks[..]), ("/v1/backups", &backups), ("/v1/tokens", &tokens)] {
        let schema = &document["paths"][path]["post"]["requestBody"]["content"]["application/json"]["schema"];
        let validator = validator(&document, schema);
        for body in bodies {
            let request = service.request(reqwest::Method::POST, path).json(body).bearer_auth(&bearer);
            let answer = if bearer.is_empty() { service.post(path, body).await } else { request.send().await.unwrap() };
            let (status, text) = (answer.status().as_u16(), answer.text().await.unwrap());
            assert!(status == 201 || status == 422, "{path} {body}: {status} {text}");
            assert_eq!(validator.is_valid(body), status == 201, "{path} {body}: {status} {text}");
            if path == "/v1/tokens" && bearer.is_empty() {
                let made: Value = serde_json::from_str(&text).unwrap();
                made["token"].as_str().unwrap().clone_into(&mut bearer);
            }
        }
    }
}

#[tokio::test]
async fn the_last_line_of_an_archive_is_the_one_that_the_document_names() {
    let (service, _folder) = spawn();
    let document = service.read("/openapi.json").await;
    let said = document["paths"]["/v1/structures/{id}/export"]["get"]["description"].as_str().unwrap().to_owned();
    let archive = service.get("/v1/structures/three-dof/export").send().await.unwrap().text().await.unwrap();
    let records: Vec<Value> = archive.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let (last, before) = records.split_last().unwrap();
    let named = |record: &Value| said.contains(&format!("`record` is `{}`", record["record"].as_str().unwrap()));
    assert!(named(last) && !before.iter().any(named), "{said}: {last}");
}

#[tokio::test]
async fn the_api_explorer_needs_nothing_from_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let service = Service::spawn(&mut command(folder.path()));
    // reqwest follows the redirect to the folder.
    let page = service.get("/docs/api-explorer").send().await.unwrap();
    assert_eq!(page.status(), 200);
    assert!(page.url().path().ends_with("/docs/api-explorer/"), "{}", page.url());
    let policy = page.headers()["content-security-policy"].to_str().unwrap().to_owned();
    assert!(policy.contains("default-src 'none'") && policy.contains("script-src 'self';"), "{policy}");
    assert!(!policy.contains("unsafe"), "{policy}");
    assert_eq!(page.headers()["content-encoding"], "gzip");
    for (file, content_type) in [
        ("swagger-ui.css", "text/css"),
        ("index.css", "text/css"),
        ("swagger-ui-bundle.js", "text/javascript"),
        ("swagger-ui-standalone-preset.js", "text/javascript"),
        ("swagger-initializer.js", "text/javascript"),
        ("favicon-32x32.png", "image/png"),
    ] {
        let answer = service.get(&format!("/docs/api-explorer/{file}")).send().await.unwrap();
        assert_eq!(answer.status(), 200, "{file}");
        assert!(answer.headers()["content-type"].to_str().unwrap().starts_with(content_type), "{file}");
        assert_eq!(answer.headers()["content-security-policy"], policy, "{file}");
    }
    let script = service.get("/docs/api-explorer/swagger-initializer.js").send().await.unwrap().text().await.unwrap();
    assert!(script.contains("../../openapi.json") && !script.contains("http"), "{script}");
    problem(service.get("/docs/api-explorer/nothing.js").send().await.unwrap(), 404, "unknown_route").await;
}

#[tokio::test]
async fn an_unsupported_method_is_answered_with_the_supported_ones() {
    let (service, _folder) = spawn();
    for (method, path, allowed) in [
        (reqwest::Method::DELETE, "/v1/structures/three-dof/history", "GET,HEAD"),
        (reqwest::Method::GET, "/v1/structures/three-dof/batches", "POST"),
        (reqwest::Method::PATCH, "/healthz", "GET,HEAD"),
        (reqwest::Method::POST, "/openapi.json", "GET,HEAD"),
    ] {
        let answer = service.request(method, path).send().await.unwrap();
        assert_eq!(answer.headers()["allow"], allowed, "{path}");
        problem(answer, 405, "method_not_allowed").await;
    }
}
