//! `modalwatch post`: sends a table of measurements to a running service, which cuts it into batches.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context as _;
use clap::Args;
use reqwest::{Method, RequestBuilder, StatusCode, Url};
use serde_json::Value;

use super::remote::{pause_before_another, LocationArgs, Service};
use crate::quantity::StructureId;

/// Largest number of attempts when the service is busy. Posting again is safe: nothing is stored twice.
const ATTEMPTS: usize = 20;

/// Time to wait before the next attempt if the service does not name one.
const PAUSE: Duration = Duration::from_secs(1);

/// Largest number of refused rows and batches that are printed.
const PRINTED: usize = 20;

/// Post a table of measurements (CSV) to a running service.
#[derive(Debug, Args)]
pub struct PostArgs {
    /// The table
    file: PathBuf,
    /// Id of the structure
    #[arg(long)]
    structure: String,
    /// Cut the table into batches: 1d, 6h or 30min for one each such interval, gap:2h for a new one after each pause of two hours,
    /// none for a single one; required for a table that spans more than 48 h
    #[arg(long)]
    split: Option<String>,
    /// Zone of times without an offset, such as Europe/Berlin or +01:00
    #[arg(long, allow_hyphen_values = true)]
    zone: Option<String>,
    /// Order of dates such as 03/04/2026: dmy or mdy
    #[arg(long)]
    date_order: Option<String>,
    /// Decimal sign: point or comma
    #[arg(long)]
    decimal: Option<String>,
    /// Unit of frequencies whose header states none: Hz, mHz, kHz or rad/s
    #[arg(long)]
    unit: Option<String>,
    /// Unit of times that are numbers: seconds, milliseconds, serial-days or decimal-year
    #[arg(long)]
    time_unit: Option<String>,
    /// What a column is, such as 'f1=Erste Biegung', 'time=Zeitpunkt' or 'f1=#3' for the third column; may be repeated
    #[arg(long = "column", value_name = "TARGET=COLUMN")]
    columns: Vec<String>,
    /// A column that is not read, by name or number (#3); may be repeated
    #[arg(long)]
    ignore: Vec<String>,
    /// Instrument, gateway or campaign
    #[arg(long)]
    source: Option<String>,
    /// Key by which the service recognises this table if it is posted again; without one, by its content
    #[arg(long)]
    idempotency_key: Option<String>,
    /// Refuse the whole table if a row cannot be used; only with --split
    #[arg(long, requires = "split")]
    strict: bool,
    /// Only say what would be made of the table, and store nothing
    #[arg(long)]
    preview: bool,
    /// Print the answer of the service as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    location: LocationArgs,
}

/// Posts a table and prints what the service understood and stored.
///
/// # Errors
/// A file that cannot be read, a service that cannot be reached, a table that it refuses, or a batch that it refuses.
pub async fn post(args: &PostArgs) -> anyhow::Result<()> {
    let service = args.location.service(&args.location.read()?)?;
    let bytes = tokio::fs::read(&args.file).await.with_context(|| format!("cannot read {}", args.file.display()))?;
    let structure = StructureId::parse(&args.structure)?;
    let path = if args.preview { "tables/preview" } else { "batches" };
    let path = format!("/v1/structures/{structure}/{path}{}", args.query()?);
    let request = || {
        let request = service.request(Method::POST, &path).header("content-type", "text/csv").body(bytes.clone());
        match args.idempotency_key.as_deref().filter(|_| !args.preview) {
            Some(key) => request.header("idempotency-key", key),
            None => request,
        }
    };
    let answer = patiently(&service, request).await.with_context(|| args.file.display().to_string())?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&answer)?);
    }
    let say = |text: &str| {
        if !args.json {
            println!("{text}");
        }
    };
    if args.preview {
        say(&understood(&answer["understood"]));
        let (batches, needs) = (answer["batches"].as_array(), answer["problems"].as_array());
        for batch in batches.into_iter().flatten().take(PRINTED) {
            say(&format!(
                "  {} to {}: {} measurements",
                text(&batch["from"]),
                text(&batch["to"]),
                batch["measurements"]
            ));
        }
        let needs: Vec<String> = needs.into_iter().flatten().map(problem).collect();
        anyhow::ensure!(needs.is_empty(), "the table cannot be stored like this:\n  {}", needs.join("\n  "));
        return Ok(());
    }
    if answer["items"].is_null() {
        say(&understood(&answer["table"]));
        say(&format!("batch {} is {}", text(&answer["batch"]), text(&answer["state"])));
        return Ok(());
    }
    say(&understood(&answer["table"]));
    say(&format!(
        "{} batches stored, {} already there, {} refused",
        answer["stored"], answer["replayed"], answer["refused"]
    ));
    let items = answer["items"].as_array();
    let refused: Vec<&Value> = items.into_iter().flatten().filter(|item| item["problem"].is_object()).collect();
    let lines = refused.iter().take(PRINTED).map(|item| {
        format!("  batch from {} (line {}): {}", text(&item["from"]), item["line"], text(&item["problem"]["detail"]))
    });
    let lines: Vec<String> = lines.collect();
    anyhow::ensure!(refused.is_empty(), "batches refused: {}\n{}", refused.len(), lines.join("\n"));
    Ok(())
}

impl PostArgs {
    /// The options as a query.
    fn query(&self) -> anyhow::Result<String> {
        let joined = |parts: &[String]| (!parts.is_empty()).then(|| parts.join(","));
        let pairs = [
            ("source", self.source.clone()),
            ("split", self.split.clone()),
            ("zone", self.zone.clone()),
            ("date_order", self.date_order.clone()),
            ("decimal", self.decimal.clone()),
            ("unit", self.unit.clone()),
            ("time_unit", self.time_unit.clone()),
            ("columns", joined(&self.columns)),
            ("ignore", joined(&self.ignore)),
            ("strict", self.strict.then(|| "true".to_owned())),
        ];
        // Only the query of this address is used, which escapes the texts.
        let mut address = Url::parse("http://service/")?;
        for (name, value) in pairs {
            if let Some(value) = value {
                address.query_pairs_mut().append_pair(name, &value);
            }
        }
        Ok(address.query().map_or_else(String::new, |query| format!("?{query}")))
    }
}

/// Sends a request again while the service is busy; returns the JSON of its answer.
async fn patiently(service: &Service, request: impl Fn() -> RequestBuilder) -> anyhow::Result<Value> {
    for attempt in 1.. {
        let response = request().send().await.with_context(|| format!("{} cannot be reached", service.url()))?;
        let status = response.status();
        let pause = pause_before_another(status, response.headers(), PAUSE);
        let body = response.text().await?;
        let answer: Value = serde_json::from_str(&body).unwrap_or(Value::String(body));
        if status.is_success() {
            return Ok(answer);
        }
        match pause.filter(|_| attempt < ATTEMPTS) {
            Some(pause) => tokio::time::sleep(pause).await,
            None => anyhow::bail!(refusal(status, &answer)),
        }
    }
    unreachable!("the last attempt returns")
}

/// Why the service refuses a table, one line for each mistake.
fn refusal(status: StatusCode, answer: &Value) -> String {
    let problems: Vec<String> = answer["errors"].as_array().into_iter().flatten().map(problem).collect();
    let hint = if [401, 403].contains(&status.as_u16()) {
        "; set MODALWATCH_TOKEN to a token with the scope ingest"
    } else {
        ""
    };
    if problems.is_empty() {
        let detail = answer["detail"].as_str().or(answer.as_str()).unwrap_or_default();
        return format!("the service answers {status}: {detail}{hint}");
    }
    format!("the table is refused:\n  {}", problems.join("\n  "))
}

/// A problem as one line. An option of the query is named as on the command line.
fn problem(problem: &Value) -> String {
    let (pointer, message) = (text(&problem["pointer"]), text(&problem["message"]));
    match pointer.strip_prefix("query/") {
        Some("columns") => format!("--column: {message}"),
        Some(option) => format!("--{}: {message}", option.replace('_', "-")),
        None if pointer.is_empty() => message,
        None => format!("{pointer}: {message}"),
    }
}

fn text(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

/// What the service understood of a table, as lines.
fn understood(table: &Value) -> String {
    let separator = match table["separator"].as_str() {
        Some("\t") => "a tab".to_owned(),
        other => format!("'{}'", other.unwrap_or_default()),
    };
    let mut lines = vec![format!("cells separated by {separator}, decimal sign '{}'", text(&table["decimal_sign"]))];
    if let Some(zone) = table["zone"].as_str() {
        lines.push(format!("times in the zone {zone}"));
    }
    if let Some(order) = table["date_order"].as_str() {
        lines.push(format!("dates read as {order}"));
    }
    for column in table["columns"].as_array().into_iter().flatten() {
        let target = column["target"].as_str().unwrap_or("not read");
        lines.push(format!("  {:?} -> {target} ({})", text(&column["name"]), text(&column["reason"])));
    }
    lines.push(format!("{} rows: {} accepted, {} refused", table["rows"], table["accepted"], table["refused"]));
    let refused = table["refused_rows"].as_array().map_or(&[][..], Vec::as_slice);
    for row in refused.iter().take(PRINTED) {
        let column = row["column"].as_str().map_or_else(String::new, |name| format!(", column {name}"));
        lines.push(format!("  line {}{column}: {}", row["line"], text(&row["reason"])));
    }
    let more = table["refused"].as_u64().unwrap_or_default().saturating_sub(refused.len().min(PRINTED) as u64);
    if more > 0 {
        lines.push(format!("  and {more} more"));
    }
    lines.push(format!("{} batches", table["batches"]));
    lines.join("\n")
}
