//! The views in Firefox, by `WebDriver` `BiDi`: the part of a client that these tests need.

use std::io::{BufRead as _, BufReader};
use std::net::TcpStream;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{json, Value};
use tempfile::TempDir;
use tungstenite::{Message, WebSocket};

use crate::dashboard::at;
use crate::helpers::{created, measurements, repository, spawn, Service};
use crate::needs;

const PATIENCE: Duration = Duration::from_mins(1);

struct Firefox {
    child: Child,
    socket: WebSocket<TcpStream>,
    context: String,
    last_id: u64,
    complaints: Vec<String>,
    _profile: TempDir,
}

impl Firefox {
    /// With `light` or `dark` as the colours that the system prefers.
    fn open(program: &std::path::Path, theme: &str) -> Self {
        let profile = tempfile::tempdir().unwrap();
        // 0 is dark, 1 is light.
        let colours = u8::from(theme == "light");
        let preference = format!("user_pref(\"layout.css.prefers-color-scheme.content-override\", {colours});\n");
        std::fs::write(profile.path().join("user.js"), preference).unwrap();
        let mut command = Command::new(program);
        command.args(["--headless", "--no-remote", "--remote-debugging-port=0", "--profile"]).arg(profile.path());
        command.env("HOME", profile.path()).arg("about:blank");
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let url =
            lines.find_map(|line| Some(line.ok()?.split_once("WebDriver BiDi listening on ")?.1.to_owned())).unwrap();
        std::thread::spawn(move || lines.for_each(drop));
        let stream = TcpStream::connect(url.trim_start_matches("ws://")).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let (socket, _) = tungstenite::client(format!("{url}/session"), stream).unwrap();
        let (context, complaints) = (String::new(), Vec::new());
        let mut page = Self { child, socket, context, last_id: 0, complaints, _profile: profile };
        page.call("session.new", &json!({ "capabilities": {} }));
        page.call("session.subscribe", &json!({ "events": ["log.entryAdded"] }));
        let tree = page.call("browsingContext.getTree", &json!({}));
        tree["contexts"][0]["context"].as_str().unwrap().clone_into(&mut page.context);
        page
    }

    fn call(&mut self, method: &str, params: &Value) -> Value {
        self.last_id += 1;
        let command = json!({ "id": self.last_id, "method": method, "params": params });
        self.socket.send(Message::text(command.to_string())).unwrap();
        loop {
            let Message::Text(text) = self.socket.read().unwrap() else { continue };
            let message: Value = serde_json::from_str(&text).unwrap();
            if message["id"] == self.last_id {
                assert_eq!(message["type"], "success", "{method}: {message}");
                return message["result"].clone();
            }
            let entry = &message["params"];
            if message["method"] == "log.entryAdded" && (entry["level"] == "error" || entry["level"] == "warn") {
                self.complaints.push(entry["text"].to_string());
            }
        }
    }

    /// Value of a JavaScript expression as JSON; a promise is awaited.
    fn evaluate(&mut self, expression: &str) -> Value {
        let expression = format!("Promise.resolve({expression}).then((value) => JSON.stringify(value ?? null))");
        let target = json!({ "context": self.context });
        let params = json!({ "expression": expression, "target": target, "awaitPromise": true });
        let outcome = self.call("script.evaluate", &params);
        assert_eq!(outcome["type"], "success", "{}: {outcome}", expression.chars().take(200).collect::<String>());
        serde_json::from_str(outcome["result"]["value"].as_str().unwrap()).unwrap()
    }

    fn wait_for(&mut self, expression: &str) {
        let started = Instant::now();
        while self.evaluate(&format!("Boolean({expression})")) != true {
            let complaints = &self.complaints;
            assert!(started.elapsed() < PATIENCE, "{expression} did not become true: {complaints:?}");
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    fn visit(&mut self, url: &str, width: u32) {
        let context = self.context.clone();
        let viewport = json!({ "width": width, "height": 900 });
        self.call("browsingContext.setViewport", &json!({ "context": context, "viewport": viewport }));
        for url in ["about:blank", url] {
            let params = json!({ "context": context, "url": url, "wait": "complete" });
            self.call("browsingContext.navigate", &params);
        }
        self.wait_for("document.querySelector('main .view')");
    }
}

impl Drop for Firefox {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The views, with what must be there when a view is complete.
const VIEWS: [(&str, &str); 8] = [
    ("#/", "table.fleet tbody tr"),
    ("#/structures/three-dof", "[data-figure=control] canvas"),
    ("#/structures/three-dof?section=tracks", "[data-figure=tracks] canvas"),
    ("#/structures/three-dof?section=batch", "[data-figure=density-k1] canvas"),
    ("#/structures/three-dof?section=model", "#model table"),
    ("#/structures/three-dof?section=upload", "#upload .drop"),
    ("#/compare?a=three-dof/k1&b=three-dof/k2", "[data-figure=compare] canvas"),
    ("#/structures/three-dof/report", ".report"),
];

#[tokio::test(flavor = "multi_thread")]
async fn firefox_shows_every_view_without_errors_and_accessibly() {
    let Some(program) = needs::program("firefox") else { return };
    let (service, _folder) = spawn();
    let mut ids = Vec::new();
    for day in 0..6 {
        let k2 = if day < 3 { 5.0 } else { 4.5 };
        ids.push(
            service.post_batch("three-dof", &measurements([4.0, k2, 6.0], 20, day * 86_400)).await["batch"].clone(),
        );
        if day == 2 {
            created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": ids })).await).await;
        }
    }
    let file = repository("target/browser/node_modules/axe-core/axe.min.js");
    let axe = needs::installed(&file).then(|| std::fs::read_to_string(file).unwrap());
    // Chromium shows every view in both themes at both widths; here each theme has one.
    for (theme, width) in [("dark", 1400), ("light", 400)] {
        let mut page = Firefox::open(&program, theme);
        for (view, complete) in VIEWS {
            let seen = format!("{view}, {theme}, {width} px");
            page.visit(&at(&service, view), width);
            page.wait_for(&format!("document.querySelector('{complete}')"));
            assert_eq!(page.evaluate("innerWidth"), json!(width), "{seen}");
            let dark = page.evaluate("matchMedia('(prefers-color-scheme: dark)').matches");
            assert_eq!(dark, json!(theme == "dark"), "{seen}");
            let over = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth");
            assert_eq!(over, json!(0), "{seen}: the page scrolls sideways");
            if let Some(axe) = &axe {
                page.evaluate(&format!("(() => {{ {axe}; }})()"));
                let found = page.evaluate(
                    "axe.run(document).then(({ violations }) => violations.map((v) => [v.impact, v.id, v.nodes.map((n) => n.html)]))",
                );
                assert_eq!(found, json!([]), "axe: {seen}");
            }
        }
        assert_eq!(page.complaints, Vec::<String>::new(), "{theme}");
    }
    a_picture_is_saved(&service, &program);
}

/// A figure is saved as a picture, which takes other parts of the browser than showing it.
fn a_picture_is_saved(service: &Service, program: &std::path::Path) {
    let mut page = Firefox::open(program, "light");
    page.visit(&at(service, VIEWS[1].0), 1400);
    page.wait_for("document.querySelector('[data-figure=control] canvas')");
    let file = "(async () => { const { createObjectURL } = URL; let kept = null;
        URL.createObjectURL = (blob) => ((kept = blob), createObjectURL.call(URL, blob));
        document.querySelector('[data-figure=control] [data-format=png]').click();
        for (let i = 0; i < 200 && !kept; i += 1) await new Promise((r) => setTimeout(r, 50));
        return kept && [kept.type, kept.size]; })()";
    let file = page.evaluate(file);
    assert_eq!(file[0], "image/png", "{file}");
    assert!(file[1].as_u64().unwrap() > 5_000, "{file}");
    assert_eq!(page.complaints, Vec::<String>::new());
}
