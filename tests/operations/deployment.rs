//! The files in `docker/`: what they name exists, and they agree with each other. No container engine runs here.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::helpers::{repository, spawn};

/// A file of the repository without the comments of its own lines.
fn text_of(path: &str) -> String {
    let text = std::fs::read_to_string(repository(path)).unwrap_or_else(|error| panic!("{path}: {error}"));
    text.lines().filter(|line| !line.trim_start().starts_with('#')).flat_map(|line| [line, "\n"]).collect()
}

/// The YAML files of `docker/`, with all that is below.
fn yaml_files() -> Vec<String> {
    let mut folders = vec![repository("docker")];
    let mut found = Vec::new();
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path: PathBuf = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|ending| ending == "yml" || ending == "yaml") {
                found.push(path.strip_prefix(repository("")).unwrap().display().to_string());
            }
        }
    }
    found.sort();
    found
}

/// The words of a text that begin with a prefix.
fn words<'t>(text: &'t str, prefix: &str) -> BTreeSet<&'t str> {
    let part_of_word = |c: char| c.is_ascii_alphanumeric() || c == '_';
    text.split(|c: char| !part_of_word(c)).filter(|word| word.starts_with(prefix)).collect()
}

/// The values behind `key:` in a text, without quotes.
fn values<'t>(text: &'t str, key: &str) -> Vec<&'t str> {
    let key = format!("{key}: ");
    let starts = text
        .match_indices(&key)
        .filter(|(at, _)| text[..*at].chars().next_back().is_none_or(|before| " {-\n".contains(before)));
    starts
        .map(|(at, found)| {
            let rest = &text[at + found.len()..];
            let end = rest.find([',', '}', ']', '\n']).unwrap_or(rest.len());
            rest[..end].trim().trim_matches(['"', '\''])
        })
        .collect()
}

/// The settings of the program as environment variables, also those that are commented out.
fn settings() -> BTreeSet<String> {
    let text = std::fs::read_to_string(repository("src/config.default.toml")).unwrap();
    let mut section = String::new();
    let mut found = BTreeSet::new();
    for line in text.lines() {
        let line = line.trim_start_matches("# ");
        if let Some(name) = line.strip_prefix('[').and_then(|line| line.split_once(']')) {
            section = format!("{}__", name.0.replace('.', "__").to_uppercase());
        } else if let Some((key, _)) = line.split_once(" = ") {
            if key.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_') {
                found.insert(format!("MODALWATCH__{section}{}", key.to_uppercase()));
            }
        }
    }
    found
}

#[test]
fn every_setting_that_a_file_gives_exists() {
    let known = settings();
    assert!(known.contains("MODALWATCH__STORE__TAKEOVER_S") && known.contains("MODALWATCH__STORE__URL"), "{known:?}");
    let mut given = 0;
    for file in yaml_files().into_iter().chain(["docker/Dockerfile".to_owned()]) {
        for name in words(&text_of(&file), "MODALWATCH__") {
            assert!(known.contains(name), "{file} sets {name}, which src/config.default.toml does not have");
            given += 1;
        }
    }
    assert!(given > 12, "{given}");
}

#[test]
fn nodes_proxy_and_prometheus_name_the_same_services_and_ports() {
    let image = text_of("docker/Dockerfile");
    let port = image.lines().find_map(|line| line.strip_prefix("EXPOSE ")).unwrap();
    let user = image.lines().find_map(|line| line.strip_prefix("USER ")).unwrap().split(':').next().unwrap();
    assert!(image.contains(&format!("MODALWATCH__HTTP__LISTEN=0.0.0.0:{port}")), "{image}");

    let compose = text_of("docker/compose.cluster.yaml");
    let blocks: Vec<&str> = compose.split("\n  ").collect();
    let nodes: BTreeSet<String> = blocks
        .windows(3)
        .filter(|block| block[1].trim() == "<<: *modalwatch" && block[2].trim().starts_with("hostname"))
        .map(|block| block[0].trim().trim_end_matches(':').to_owned())
        .collect();
    assert_eq!(nodes.len(), 3, "{blocks:?}");
    assert_eq!(values(&compose, "hostname").into_iter().map(str::to_owned).collect::<BTreeSet<_>>(), nodes);
    for file in ["docker/Caddyfile.cluster", "docker/prometheus/prometheus.cluster.yml"] {
        let text = text_of(file);
        for node in &nodes {
            assert!(text.contains(&format!("{node}:{port}")), "{file} does not name {node}:{port}");
        }
        assert_eq!(text.matches(&format!(":{port}")).count(), nodes.len(), "{file} names more than {nodes:?}");
    }
    for file in ["docker/compose.yaml", "docker/compose.cluster.yaml"] {
        let text = text_of(file);
        assert!(text.contains(&format!("expose: [\"{port}\"]")), "{file}");
        assert!(!text.contains(&format!("{port}:{port}")), "{file} lets others past the proxy");
        // A secret that is used is one that is defined, and is kept out of the repository.
        let (services, defined) = text.split_once("\nsecrets:\n").unwrap();
        let ignored = std::fs::read_to_string(repository(".gitignore")).unwrap();
        for secret in services.split("/run/secrets/").skip(1) {
            let secret: String = secret.chars().take_while(|c| c.is_ascii_lowercase() || *c == '-').collect();
            assert!(services.contains(&format!("- {secret}\n")), "{file}: no service has the secret {secret}");
            assert!(defined.contains(&format!("file: ./{secret}")), "{file}: {secret} is not defined");
            assert!(ignored.contains(&format!("docker/{secret}\n")), ".gitignore does not have docker/{secret}");
        }
        let comments = std::fs::read_to_string(repository(file)).unwrap();
        assert!(comments.contains(&format!("chown {user}")), "{file}: files belong to the user of the image");
    }

    for file in ["docker/kubernetes/nodes.yaml", "docker/kubernetes/workers.yaml"] {
        let text = text_of(file);
        assert_eq!(values(&text, "containerPort"), [port], "{file}");
        assert!(text.contains(&format!("runAsUser: {user}")), "{file}");
    }
}

#[test]
fn the_manifests_agree_and_every_container_is_confined() {
    let folder = "docker/kubernetes";
    let read = |file: &str| text_of(&format!("{folder}/{file}"));
    let kustomization = read("kustomization.yaml");
    let resources: Vec<&str> = kustomization
        .lines()
        .filter_map(|line| line.strip_prefix("  - "))
        .filter(|name| Path::new(name).extension().is_some_and(|kind| kind == "yaml"))
        .collect();
    assert!(resources.len() > 3, "{resources:?}");
    let version = format!("newTag: {}", env!("CARGO_PKG_VERSION"));
    assert!(kustomization.contains(&version), "the tag is not the version of the program");
    let secret = read("secret.example.yaml");
    let settings = read("settings.yaml");
    let all: Vec<(&str, String)> =
        resources.into_iter().chain(["schema-job.yaml"]).map(|file| (file, read(file))).collect();
    let mut containers = 0;
    for (file, text) in &all {
        let images = values(text, "image").len();
        containers += images;
        for confined in [
            "readOnlyRootFilesystem: true",
            "allowPrivilegeEscalation: false",
            "capabilities: {drop: [ALL]}",
            "runAsNonRoot: true",
            "seccompProfile: {type: RuntimeDefault}",
            "automountServiceAccountToken: false",
        ] {
            assert_eq!(text.matches(confined).count(), images, "{file}: {confined}");
        }
        // What a container reads of the secret and of the settings is there.
        for key in text.split("secretKeyRef: {").skip(1).chain(text.split("items: [{").skip(1)) {
            let key = values(key, "key")[0];
            assert!(secret.contains(&format!("\n  {key}: ")), "{file}: secret.example.yaml has no {key}");
        }
        assert_eq!(text.matches("configMapRef: {name: modalwatch}").count(), images, "{file}");
        // Each volume that is mounted is there, and each file of the settings is in one.
        let mounted = text.matches("mountPath:").count();
        assert!(images == 0 || mounted > 0, "{file}");
    }
    assert_eq!(containers, 3);
    let mounts: Vec<&str> = all.iter().flat_map(|(_, text)| values(text, "mountPath")).collect();
    for path in settings.split("/etc/modalwatch/").skip(1) {
        let path: String = path.chars().take_while(|c| c.is_ascii_alphanumeric() || "./-".contains(*c)).collect();
        let mounted = mounts.iter().any(|mount| format!("/etc/modalwatch/{path}").starts_with(mount));
        assert!(mounted, "/etc/modalwatch/{path} of settings.yaml is mounted nowhere: {mounts:?}");
    }
    // What selects pods selects those that the templates make.
    let components: BTreeSet<&str> =
        all.iter().flat_map(|(_, text)| values(text, "app.kubernetes.io/component")).collect();
    assert_eq!(components, BTreeSet::from(["node", "schema", "worker"]));
    assert!(read("workers.yaml")
        .contains("scaleTargetRef: {apiVersion: apps/v1, kind: Deployment, name: modalwatch-worker}"));
}

#[tokio::test]
async fn probes_and_proxies_ask_for_paths_and_metrics_that_exist() {
    let (service, _folder) = spawn();
    for file in ["docker/kubernetes/nodes.yaml", "docker/kubernetes/workers.yaml"] {
        let text = text_of(file);
        let paths = values(&text, "httpGet: {path");
        assert!(paths.len() > 1, "{file}: {paths:?}");
        for path in paths {
            let status = service.get(path).send().await.unwrap().status();
            assert_eq!(status, 200, "{file} asks for {path}");
        }
    }
    for file in ["docker/Caddyfile.cluster"] {
        let text = text_of(file);
        let path = text.split("health_uri ").nth(1).unwrap().split_whitespace().next().unwrap();
        assert_eq!(service.get(path).send().await.unwrap().status(), 200, "{file} asks for {path}");
    }
    let metrics = service.get("/metrics").send().await.unwrap().text().await.unwrap();
    for (file, least) in [
        ("docker/prometheus/alerts.cluster.yml", 3),
        ("docker/kubernetes/workers.yaml", 1),
        ("docker/kubernetes/metrics-adapter.yaml", 1),
    ] {
        let text = text_of(file);
        let named = words(&text, "modalwatch_");
        assert!(named.len() >= least, "{file}: {named:?}");
        for name in named {
            assert!(
                metrics.lines().any(|line| line.starts_with(name)),
                "{file} names {name}, which /metrics does not have"
            );
        }
    }
}
