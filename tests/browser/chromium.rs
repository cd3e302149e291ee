//! Headless Chromium over the DevTools protocol: the part of a client that these tests need.

use std::io::{BufRead as _, BufReader};
use std::net::TcpStream;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{json, Value};
use tempfile::TempDir;
use tungstenite::{Message, WebSocket};

/// Maximum time to wait for a condition on a page.
const PATIENCE: Duration = Duration::from_mins(1);

/// A browser with one page; it is ended when this value is dropped.
pub struct Page {
    child: Child,
    socket: WebSocket<TcpStream>,
    session: String,
    last_id: u64,
    complaints: Vec<String>,
    _profile: TempDir,
}

impl Page {
    /// Starts a browser with an empty page.
    pub fn open() -> Self {
        Self::open_with(&[])
    }

    /// As [`Self::open`], with further arguments.
    pub fn open_with(arguments: &[&str]) -> Self {
        let profile = tempfile::tempdir().unwrap();
        let mut command = Command::new("chromium");
        command.args(["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"]);
        command.args(["--remote-debugging-port=0", "--disable-background-networking", "--disable-component-update"]);
        command.args(arguments);
        command.arg(format!("--user-data-dir={}", profile.path().display())).arg("about:blank");
        // A browser that is killed leaves its socket behind.
        command.env("TMPDIR", profile.path());
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let url = lines.find_map(|line| Some(line.ok()?.strip_prefix("DevTools listening on ")?.to_owned())).unwrap();
        // Its further output must be read; otherwise the pipe fills and the browser blocks.
        std::thread::spawn(move || lines.for_each(drop));

        let address = url.trim_start_matches("ws://").split('/').next().unwrap();
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let (socket, _) = tungstenite::client(url.as_str(), stream).unwrap();
        let (session, complaints) = (String::new(), Vec::new());
        let mut page = Self { child, socket, session, last_id: 0, complaints, _profile: profile };
        let target = page.call("Target.createTarget", &json!({ "url": "about:blank" }));
        let attach = json!({ "targetId": target["targetId"], "flatten": true });
        page.call("Target.attachToTarget", &attach)["sessionId"].as_str().unwrap().clone_into(&mut page.session);
        for domain in ["Runtime.enable", "Log.enable", "Page.enable"] {
            page.call(domain, &json!({}));
        }
        page
    }

    /// Calls a method of the protocol; errors of the page that arrive meanwhile are kept.
    pub fn call(&mut self, method: &str, params: &Value) -> Value {
        self.try_call(method, params).unwrap_or_else(|error| panic!("{method}: {error}"))
    }

    /// As [`Self::call`]; a refusal is returned.
    fn try_call(&mut self, method: &str, params: &Value) -> Result<Value, Value> {
        self.last_id += 1;
        let mut command = json!({ "id": self.last_id, "method": method, "params": params });
        if !self.session.is_empty() {
            command["sessionId"] = json!(self.session);
        }
        self.socket.send(Message::text(command.to_string())).unwrap();
        loop {
            let Message::Text(text) = self.socket.read().unwrap() else { continue };
            let message: Value = serde_json::from_str(&text).unwrap();
            if message["id"] == self.last_id {
                let error = &message["error"];
                return if error.is_null() { Ok(message["result"].clone()) } else { Err(error.clone()) };
            }
            self.hear(&message);
        }
    }

    fn hear(&mut self, event: &Value) {
        let params = &event["params"];
        let complaint = match event["method"].as_str() {
            Some("Runtime.exceptionThrown") => Some(&params["exceptionDetails"]),
            Some("Runtime.consoleAPICalled") if params["type"] == "error" || params["type"] == "warning" => {
                Some(&params["args"])
            }
            // Violations of the content security policy arrive here.
            Some("Log.entryAdded") if params["entry"]["level"] == "error" => Some(&params["entry"]),
            _ => None,
        };
        self.complaints.extend(complaint.map(Value::to_string));
    }

    /// Errors of the page since the last call.
    pub fn complaints(&mut self) -> Vec<String> {
        self.evaluate("1");
        std::mem::take(&mut self.complaints)
    }

    /// As [`Self::complaints`], after a change of version, model or reference, by which batches wait to be assessed again: a page that asks
    /// for the detail of one just then is answered 409, and says that it waits.
    pub fn complaints_beside_a_change(&mut self) -> Vec<String> {
        let is_of_change = |complaint: &String| complaint.contains("409 (Conflict)") && complaint.contains("/detail\"");
        self.complaints().into_iter().filter(|complaint| !is_of_change(complaint)).collect()
    }

    /// Value of a JavaScript expression; a promise is awaited.
    pub fn evaluate(&mut self, expression: &str) -> Value {
        self.try_evaluate(expression).unwrap_or_else(|error| panic!("{expression}: {error}"))
    }

    /// As [`Self::evaluate`]; the refusal of the browser is returned.
    fn try_evaluate(&mut self, expression: &str) -> Result<Value, Value> {
        let params = json!({ "expression": expression, "awaitPromise": true, "returnByValue": true });
        let outcome = self.try_call("Runtime.evaluate", &params)?;
        let shown: String = expression.chars().take(200).collect();
        assert!(outcome["exceptionDetails"].is_null(), "{shown}: {}", outcome["exceptionDetails"]);
        Ok(outcome["result"]["value"].clone())
    }

    /// Waits until an expression is true; returns its value.
    pub fn wait_for(&mut self, expression: &str) -> Value {
        self.wait_within(expression, PATIENCE)
    }

    /// Waits until an expression is true, at most for a time such as that of a training.
    pub fn wait_within(&mut self, expression: &str, patience: Duration) -> Value {
        let started = Instant::now();
        loop {
            // An expression that is evaluated just as the page gives way to the next one is lost.
            let is_of_last_page = |error: &Value| error["message"] == "Inspected target navigated or closed";
            let value = self.try_evaluate(expression).unwrap_or_else(|error| {
                assert!(is_of_last_page(&error), "{expression}: {error}");
                Value::Null
            });
            if !matches!(value, Value::Null | Value::Bool(false)) {
                return value;
            }
            if started.elapsed() >= patience {
                let shown = self.evaluate("document.querySelector('main')?.innerText.slice(0, 600)");
                panic!(
                    "{expression} did not become true; errors of the page: {:?}; it shows: {shown}",
                    self.complaints
                );
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Sets the colour scheme and the width of the window.
    pub fn look(&mut self, theme: &str, width: u32) {
        let features = json!([{ "name": "prefers-color-scheme", "value": theme }]);
        self.call("Emulation.setEmulatedMedia", &json!({ "features": features }));
        let metrics = json!({ "width": width, "height": 844, "deviceScaleFactor": 1, "mobile": width < 500 });
        self.call("Emulation.setDeviceMetricsOverride", &metrics);
    }

    /// Loads an address again and waits for the view.
    pub fn visit(&mut self, url: &str) {
        // A change of the hash alone would not reload the page.
        self.call("Page.navigate", &json!({ "url": "about:blank" }));
        self.call("Page.navigate", &json!({ "url": url }));
        self.wait_for("Boolean(document.querySelector('main .view'))");
    }

    /// Presses a key.
    pub fn press(&mut self, key: &str) {
        let code = match key {
            "Tab" => 9,
            "Enter" => 13,
            "Escape" => 27,
            "ArrowRight" => 39,
            other => panic!("no code for {other}"),
        };
        let mut down = json!({ "type": "keyDown", "key": key, "code": key, "windowsVirtualKeyCode": code });
        if key == "Enter" {
            down["text"] = json!("\r");
        }
        self.call("Input.dispatchKeyEvent", &down);
        let up = json!({ "type": "keyUp", "key": key, "code": key, "windowsVirtualKeyCode": code });
        self.call("Input.dispatchKeyEvent", &up);
    }

    /// Drags the mouse across the page, from one point in the window to another.
    pub fn drag(&mut self, from: [f64; 2], to: [f64; 2]) {
        self.begin_drag(from, to);
        self.end_drag(to);
    }

    /// The first half of a drag: the button stays down half-way.
    pub fn begin_drag(&mut self, from: [f64; 2], to: [f64; 2]) {
        let middle = [0, 1].map(|i| 0.5 * (from[i] + to[i]));
        self.mouse(&[("mouseMoved", from, 0), ("mousePressed", from, 1), ("mouseMoved", middle, 1)]);
    }

    /// The second half of a drag.
    pub fn end_drag(&mut self, to: [f64; 2]) {
        self.mouse(&[("mouseMoved", to, 1), ("mouseReleased", to, 0)]);
    }

    fn mouse(&mut self, steps: &[(&str, [f64; 2], i32)]) {
        for &(kind, [x, y], buttons) in steps {
            let button = if kind == "mouseMoved" && buttons == 0 { "none" } else { "left" };
            let clicks = i32::from(kind == "mousePressed" || kind == "mouseReleased");
            let event =
                json!({ "type": kind, "x": x, "y": y, "button": button, "buttons": buttons, "clickCount": clicks });
            self.call("Input.dispatchMouseEvent", &event);
        }
    }

    /// Drags a finger from one point to another.
    pub fn swipe(&mut self, from: [f64; 2], to: [f64; 2]) {
        let middle = [0, 1].map(|i| 0.5 * (from[i] + to[i]));
        for (kind, points) in
            [("touchStart", vec![from]), ("touchMove", vec![middle]), ("touchMove", vec![to]), ("touchEnd", Vec::new())]
        {
            let points: Vec<Value> = points.into_iter().map(|[x, y]| json!({ "x": x, "y": y })).collect();
            self.call("Input.dispatchTouchEvent", &json!({ "type": kind, "touchPoints": points }));
        }
    }

    /// Types into the focused element.
    pub fn type_text(&mut self, text: &str) {
        self.call("Input.insertText", &json!({ "text": text }));
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
