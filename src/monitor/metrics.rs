//! The metrics of the service: their descriptions, and the figures of the process.

use crate::alarm::ALARM_KINDS;
use crate::store::Engine;

/// Descriptions of the metrics; the unit is at the end of the name.
const MEANINGS: [(&str, &str); 45] = [
    ("modalwatch_alarms_total", "Alarms raised."),
    ("modalwatch_assessment_seconds", "Time of an assessment."),
    ("modalwatch_assessments_failed_total", "Batches that could not be assessed."),
    ("modalwatch_assessments_total", "Batches assessed."),
    ("modalwatch_backups_total", "Backups, by outcome."),
    ("modalwatch_baselines_in_use", "Structures with a trained model in use."),
    ("modalwatch_batches_received_total", "New batches stored."),
    ("modalwatch_build_info", "Program and database; always 1."),
    (
        "modalwatch_computations_delivered_total",
        "Assessments and jobs computed for the service that serves the database.",
    ),
    ("modalwatch_computations_lost_total", "Pieces and jobs that were lost to another worker, or withdrawn."),
    ("modalwatch_connections_refused_total", "Requests that found no free connection."),
    ("modalwatch_database_bytes", "Size of the database file."),
    ("modalwatch_disk_free_bytes", "Free bytes on the volume of the database."),
    ("modalwatch_findings", "Findings of GET /readyz."),
    ("modalwatch_forwarded_requests_total", "Requests that a standby passed on to the serving node, by outcome."),
    ("modalwatch_http_request_seconds", "Time to answer a request."),
    ("modalwatch_http_requests_total", "Requests answered."),
    ("modalwatch_last_backup_timestamp_seconds", "When this process made its last backup; 0 = never."),
    ("modalwatch_mail_dead", "Mails about alarms that were abandoned."),
    ("modalwatch_mail_deliveries_total", "Attempts to send a mail about an alarm, by outcome."),
    ("modalwatch_mail_pending", "Mails about alarms that wait for the server."),
    ("modalwatch_measurements_received_total", "Measurements in new batches."),
    ("modalwatch_model_reloads_total", "Reloads of a trained model, by outcome."),
    ("modalwatch_mqtt_connected", "1 while the broker is connected."),
    ("modalwatch_mqtt_messages_total", "Messages from the broker, by outcome."),
    (
        "modalwatch_mqtt_waiting_messages",
        "Messages from the broker that have arrived and are not stored or in quarantine yet.",
    ),
    ("modalwatch_open_alarms", "Open alarms."),
    ("modalwatch_open_files", "Files open in this process."),
    ("modalwatch_pending_batches", "Batches that wait for their assessment."),
    ("modalwatch_queue_free_places", "Free places in the queue of assessments."),
    ("modalwatch_ready", "1 when batches are taken and assessed."),
    ("modalwatch_resident_memory_bytes", "Memory of this process."),
    ("modalwatch_retention_deleted_batches_total", "Batches deleted by retention."),
    ("modalwatch_serving", "1 for the node that serves, 0 while it stands by."),
    ("modalwatch_slow_readers_total", "Connections ended because their client took no answer."),
    ("modalwatch_structures", "Structures defined."),
    ("modalwatch_unacknowledged_alarms", "Open alarms that nobody has acknowledged."),
    ("modalwatch_unreadable_rows", "Stored rows that could not be read within the last hour."),
    ("modalwatch_uptime_seconds", "Time since the start."),
    ("modalwatch_wal_bytes", "Size of the write-ahead log."),
    ("modalwatch_webhook_dead", "Messages that were abandoned."),
    ("modalwatch_webhook_deliveries_total", "Attempts to deliver a message, by outcome."),
    ("modalwatch_webhook_pending", "Messages that wait for their receiver."),
    ("modalwatch_worker_restarts_total", "Background tasks started again after a panic."),
    ("modalwatch_write_failures_total", "Failed writes, by cause."),
];

/// Declares the metrics that would otherwise appear only with their first event: a rate over a counter that starts at 1 misses that
/// event, and an alert on a missing metric never fires. It must be called after the recorder is installed.
pub fn declare_metrics((engine, version): (Engine, &str)) {
    for (name, meaning) in MEANINGS {
        match name {
            _ if name.ends_with("_total") => metrics::describe_counter!(name, meaning),
            "modalwatch_assessment_seconds" | "modalwatch_http_request_seconds" => {
                metrics::describe_histogram!(name, meaning);
            }
            _ => metrics::describe_gauge!(name, meaning),
        }
    }
    let sqlite_version = if engine == Engine::Sqlite { version } else { "" };
    let labels = [
        ("version", env!("CARGO_PKG_VERSION").to_owned()),
        ("database", format!("{} {version}", engine.as_str())),
        ("sqlite_version", sqlite_version.to_owned()),
    ];
    metrics::gauge!("modalwatch_build_info", &labels).set(1.0);
    metrics::gauge!("modalwatch_serving").set(1.0);
    for name in [
        "modalwatch_batches_received_total",
        "modalwatch_measurements_received_total",
        "modalwatch_assessments_total",
        "modalwatch_assessments_failed_total",
        "modalwatch_retention_deleted_batches_total",
        "modalwatch_connections_refused_total",
        "modalwatch_slow_readers_total",
    ] {
        metrics::counter!(name).increment(0);
    }
    for kind in ALARM_KINDS {
        metrics::counter!("modalwatch_alarms_total", "kind" => kind).increment(0);
    }
    for outcome in ["done", "failed"] {
        metrics::counter!("modalwatch_backups_total", "outcome" => outcome).increment(0);
    }
    for outcome in ["swapped", "unchanged", "refused"] {
        metrics::counter!("modalwatch_model_reloads_total", "outcome" => outcome).increment(0);
    }
    for cause in ["disk_full", "disk_failed", "read_only", "database_busy"] {
        metrics::counter!("modalwatch_write_failures_total", "cause" => cause).increment(0);
    }
    for worker in ["silence", "retention"] {
        metrics::counter!("modalwatch_worker_restarts_total", "worker" => worker).increment(0);
    }
    metrics::gauge!("modalwatch_last_backup_timestamp_seconds").set(0.0);
}

/// Bytes in memory and number of open files, on Linux; 0 elsewhere.
pub(super) fn process_figures() -> (f64, f64) {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let resident = status.lines().find_map(|line| line.strip_prefix("VmRSS:")?.trim().strip_suffix(" kB"));
    let kilobytes: f64 = resident.and_then(|text| text.trim().parse().ok()).unwrap_or(0.0);
    let files = std::fs::read_dir("/proc/self/fd").map_or(0, std::iter::Iterator::count);
    (kilobytes * 1024.0, files as f64)
}
