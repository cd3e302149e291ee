//! Which requests the service accepts before there is a token, and when it refuses to start.

use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::{Command, Stdio};

use serde_json::{json, Value};

use crate::access::world::{first_token, program, World};
use crate::helpers::{command, created, problem, refusal, Service};

const LIST: &str = "/v1/structures";

/// A service on an address that other machines could reach (none does).
fn public(data_dir: &Path) -> Command {
    let mut command = Command::new(crate::helpers::program());
    command.args(["serve", "--listen", "0.0.0.0:0", "--data-dir"]).arg(data_dir);
    command.env("MODALWATCH__LOG__LEVEL", "warn").env_remove("MODALWATCH_ADMIN_TOKEN_FILE");
    command
}

#[tokio::test]
async fn a_public_address_without_tokens_is_refused_with_the_way_to_make_one() {
    let folder = tempfile::tempdir().unwrap();
    let text = refusal(&mut public(folder.path()));
    assert!(text.contains("modalwatch token create --name me --scope admin --data-dir"), "{text}");

    let behind_proxy = refusal(command(folder.path()).env("MODALWATCH__HTTP__TRUSTED_PROXIES", "[\"127.0.0.1\"]"));
    assert!(behind_proxy.contains("http.trusted_proxies"), "{behind_proxy}");
    let no_network = refusal(command(folder.path()).env("MODALWATCH__HTTP__TRUSTED_PROXIES", "[\"proxy.lan\"]"));
    assert!(no_network.contains("\"proxy.lan\" is neither an address"), "{no_network}");

    let token = first_token(folder.path());
    let service = Service::spawn(&mut public(folder.path()));
    let url = format!("http://127.0.0.1:{}{LIST}", service.address().rsplit(':').next().unwrap());
    let ask = |token: Option<&str>| {
        let request = service.client.get(&url);
        token.map_or(request.try_clone().unwrap(), |token| request.bearer_auth(token)).send()
    };
    problem(ask(None).await.unwrap(), 401, "unauthorized").await;
    assert_eq!(ask(Some(&token)).await.unwrap().status(), 200);
}

#[tokio::test]
async fn an_insecure_public_service_says_so_loudly() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = public(folder.path());
    command.env("MODALWATCH__ACCESS__INSECURE_PUBLIC", "true");
    let log = folder.path().join("log");
    let mut child = command.stdout(Stdio::piped()).stderr(std::fs::File::create(&log).unwrap()).spawn().unwrap();
    let mut line = String::new();
    std::io::BufRead::read_line(&mut std::io::BufReader::new(child.stdout.as_mut().unwrap()), &mut line).unwrap();
    let port = line.trim().rsplit(':').next().unwrap().to_owned();
    let client = modalwatch::notify::client_builder().build().unwrap();
    let get = async |path: &str| client.get(format!("http://127.0.0.1:{port}{path}")).send().await.unwrap();
    let ready: Value = get("/readyz").await.json().await.unwrap();
    let list = get(LIST).await.status();
    child.kill().unwrap();
    child.wait().unwrap();
    assert_eq!(list, 200);
    assert!(ready["findings"][0]["code"] == "insecure", "{ready}");
    let log = std::fs::read_to_string(log).unwrap();
    assert!(log.contains("WARN") && log.contains("INSECURE"), "{log}");
}

#[tokio::test]
async fn the_admin_token_file_opens_a_service_without_other_tokens() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("admin");
    let data = folder.path().join("data");
    let made = program(&["token", "file", file.to_str().unwrap()], &data);
    assert!(made.status.success() && !data.exists(), "{made:?}");
    let token = std::fs::read_to_string(&file).unwrap();
    let token = token.trim();
    assert_eq!(std::fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o600);

    // By its own variable, and by the setting.
    for (name, listen) in
        [("MODALWATCH_ADMIN_TOKEN_FILE", public(&data)), ("MODALWATCH__ACCESS__ADMIN_TOKEN_FILE", command(&data))]
    {
        let mut command = listen;
        let service = Service::spawn(command.env(name, &file));
        let url = format!("http://127.0.0.1:{}", service.address().rsplit(':').next().unwrap());
        let ask = |path: &str| service.client.get(format!("{url}{path}"));
        problem(ask(LIST).send().await.unwrap(), 401, "unauthorized").await;
        assert_eq!(ask(LIST).bearer_auth(token).send().await.unwrap().status(), 200);
        // With the file, the first stored token may have any scope.
        let body = json!({ "name": "gateway", "scopes": ["ingest"] });
        let create = service.client.post(format!("{url}/v1/tokens")).bearer_auth(token).json(&body);
        created(create.send().await.unwrap()).await;
        let audit: Value = ask("/v1/audit").bearer_auth(token).send().await.unwrap().json().await.unwrap();
        assert_eq!(audit["items"][0]["actor_name"], "admin token file", "{audit}");
    }

    let refused = |mode: u32, content: &str| {
        std::fs::write(&file, content).unwrap();
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(mode)).unwrap();
        refusal(command(&data).env("MODALWATCH_ADMIN_TOKEN_FILE", &file))
    };
    let readable = refused(0o644, token);
    assert!(readable.contains("chmod 600") && !readable.contains(token), "{readable}");
    let other = refused(0o600, "hunter2");
    assert!(other.contains("contains no token") && !other.contains("hunter2"), "{other}");
    let missing = refusal(command(&data).env("MODALWATCH_ADMIN_TOKEN_FILE", "/no/such/file"));
    assert!(missing.contains("/no/such/file"), "{missing}");
}

#[tokio::test]
async fn without_a_token_only_this_machine_is_served_and_the_first_token_closes_the_service() {
    let folder = tempfile::tempdir().unwrap();
    let service = Service::start(folder.path());
    assert_eq!(service.get(LIST).send().await.unwrap().status(), 200);
    let with = |name: &'static str, value: &'static str| service.get(LIST).header(name, value).send();
    for header in ["x-forwarded-for", "forwarded", "x-real-ip", "via"] {
        problem(with(header, "203.0.113.9").await.unwrap(), 401, "unauthorized").await;
    }
    problem(with("host", "evil.example").await.unwrap(), 403, "forbidden_origin").await;
    problem(with("origin", "https://evil.example").await.unwrap(), 403, "forbidden_origin").await;
    for origin in ["null", "null.example", "http://evil", "chrome-extension://abc", "http://localhost:3000"] {
        problem(with("origin", origin).await.unwrap(), 403, "forbidden_origin").await;
    }
    for host in ["evil", "[::1].evil.example"] {
        problem(with("host", host).await.unwrap(), 403, "forbidden_origin").await;
    }
    problem(with("sec-fetch-site", "cross-site").await.unwrap(), 403, "forbidden_origin").await;
    let own = format!("http://{}", service.address());
    assert_eq!(service.get(LIST).header("origin", own).send().await.unwrap().status(), 200);
    assert_eq!(with("sec-fetch-site", "same-origin").await.unwrap().status(), 200);
    // As nginx asks with a bare `proxy_pass`.
    let old = service.get(LIST).version(reqwest::Version::HTTP_10).send().await.unwrap();
    problem(old, 401, "unauthorized").await;

    let weak = json!({ "name": "gateway", "scopes": ["ingest"] });
    problem(service.post("/v1/tokens", &weak).await, 422, "first_token_must_be_admin").await;
    let limited = json!({ "name": "x", "scopes": ["admin"], "structures": ["three-dof"] });
    problem(service.post("/v1/tokens", &limited).await, 422, "first_token_must_be_admin").await;
    assert_eq!(service.get(LIST).send().await.unwrap().status(), 200);
    let first = created(service.post("/v1/tokens", &json!({ "name": "me", "scopes": ["admin"] })).await).await;
    problem(service.get(LIST).send().await.unwrap(), 401, "unauthorized").await;
    let admin = first["token"].as_str().unwrap();
    let list =
        |name: &'static str, value: &'static str| service.get(LIST).bearer_auth(admin).header(name, value).send();
    assert_eq!(list("x-forwarded-for", "203.0.113.9").await.unwrap().status(), 200);
    assert_eq!(list("host", "shm.example").await.unwrap().status(), 200);
}

#[tokio::test]
async fn findings_name_structures_only_to_those_who_may_read_all_of_them() {
    let models = tempfile::tempdir().unwrap();
    let model = models.path().join("secret-bridge");
    std::fs::create_dir(&model).unwrap();
    std::fs::write(model.join("structure.toml"), "}{").unwrap();
    let world = World::with(|command| command.arg("--models").arg(models.path()));
    let reader = world.token(&["read"], &[]).await;
    let limited = world.token(&["read"], &["three-dof"]).await;
    let sender = world.token(&["ingest"], &[]).await;
    let ask = |token: Option<&str>| {
        let request = world.service.get("/readyz");
        token.map_or(request.try_clone().unwrap(), |token| request.bearer_auth(token)).send()
    };
    for (token, explained) in [
        (None, false),
        (Some("mw_unknown"), false),
        (Some(limited.as_str()), false),
        (Some(sender.as_str()), false),
        (Some(reader.as_str()), true),
        (Some(world.admin.as_str()), true),
    ] {
        let answer = ask(token).await.unwrap();
        assert_eq!(answer.status(), 200, "a supervisor needs no token, and a wrong one changes nothing");
        let text = answer.text().await.unwrap();
        assert_eq!(text.contains("secret-bridge"), explained, "{token:?}: {text}");
        // That something is degraded is said to everybody.
        assert!(text.contains("\"code\":\"model_refused\""), "{text}");
    }
}
