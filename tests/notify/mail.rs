//! From an alarm to the mail: once for each recipient, also if the server refuses at first or the service is restarted.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

use serde_json::json;

use crate::helpers::{created, refusal, Service};
use crate::notify::eventually;
use crate::notify::mail_server::{Mail, MailServer};
use crate::notify::metric;
use crate::notify::webhooks::{damage, declare_undamaged, prepared};

/// The command line of a service that mails through a server.
fn mailing(data_dir: &Path, server: &MailServer, settings: &[(&str, &str)]) -> Command {
    let mut command = prepared(data_dir, &[("PUBLIC_URL", "https://shm.example.org")]);
    command.env("MODALWATCH__EMAIL__HOST", "127.0.0.1").env("MODALWATCH__EMAIL__TLS", "none");
    command.env("MODALWATCH__EMAIL__PORT", server.address.port().to_string());
    command.env("MODALWATCH__EMAIL__FROM", "Watch <watch@example.org>");
    command.env("MODALWATCH__EMAIL__RECIPIENTS", "[\"ann@example.org\", \"ben@example.org\"]");
    command.env("MODALWATCH__EMAIL__LEAST_SEVERITY", "slight");
    command.envs(settings.iter().map(|(key, value)| (format!("MODALWATCH__EMAIL__{key}"), *value)));
    command
}

fn ids(mails: &[Mail]) -> BTreeSet<String> {
    mails.iter().map(|mail| mail.field("Message-ID").concat()).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mail_that_is_refused_at_first_arrives_once_for_each_recipient_and_not_again_after_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let server = MailServer::start(&[451, 451]).await;
    let mut service = Service::spawn(&mut mailing(folder.path(), &server, &[]));
    declare_undamaged(&service).await;
    damage(&service).await;
    let failing = eventually("a finding about mails", async || {
        let ready = service.read("/readyz").await;
        let findings = ready["findings"].to_string();
        (findings.contains("mail_failing") || server.taken().len() == 2).then_some(findings)
    });
    failing.await;
    let mails = server.wait_for(2).await;
    let to: BTreeSet<String> = mails.iter().flat_map(|mail| mail.field("To")).collect();
    assert_eq!(to, BTreeSet::from(["ann@example.org".to_owned(), "ben@example.org".to_owned()]));
    assert!(mails.iter().all(|mail| mail.recipients.len() == 1), "one recipient does not see the others: {mails:?}");
    // The refused attempts had the same ids as the accepted ones.
    assert_eq!((server.all().len(), ids(&server.all()), ids(&mails).len()), (4, ids(&mails), 2));
    let text = mails[0].text();
    for part in [
        "Alarm 1 of the structure three-dof was opened.",
        "Severity: ",
        "https://shm.example.org/#/structures/three-dof",
    ] {
        assert!(text.contains(part), "{part} is not in {text}");
    }
    assert!(mails[0].data.contains("Subject: ") && mails[0].data.contains("three-dof"), "{}", mails[0].data);
    eventually("settled mails", async || {
        let delivered = metric(&service, "modalwatch_mail_deliveries_total{outcome=\"delivered\"}").await;
        let pending = metric(&service, "modalwatch_mail_pending").await;
        (delivered > 1.5 && pending < 0.5).then_some(())
    })
    .await;
    let retries = metric(&service, "modalwatch_mail_deliveries_total{outcome=\"retry\"}").await;
    assert!((retries - 2.0).abs() < 0.5, "{retries}");
    service.stop("TERM");

    // After the restart only what is new is sent: the closing is not among the kinds, the end of the alarm is.
    let service = Service::spawn(&mut mailing(folder.path(), &server, &[]));
    let closing = json!({ "reason": "false_alarm", "author": "Ann" });
    created(service.post("/v1/structures/three-dof/alarms/1/closing", &closing).await).await;
    for i in 2..=9 {
        let healthy = crate::helpers::measurements(crate::notify::webhooks::HEALTHY, 20, 100_000 * i);
        service.post_batch("three-dof", &healthy).await;
    }
    let all = server.wait_for(4).await;
    let new: Vec<&Mail> = all[2..].iter().collect();
    assert!(new.iter().all(|mail| mail.text().contains("has ended")), "{new:?}");
    assert_eq!((all.len(), ids(&all).len()), (4, 4));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn alarms_below_the_least_severity_send_no_mail_and_kinds_are_selected() {
    let folder = tempfile::tempdir().unwrap();
    let server = MailServer::start(&[]).await;
    let settings = [("LEAST_SEVERITY", "critical"), ("EVENTS", "[\"alarm.opened\", \"alarm.commented\"]")];
    let mut command = mailing(folder.path(), &server, &settings);
    // No loss is critical: everything is below.
    command.env("MODALWATCH__MONITOR__SEVERITY__CRITICAL_PERCENT", "99");
    let service = Service::spawn(&mut command);
    declare_undamaged(&service).await;
    damage(&service).await;
    eventually("skipped mails", async || {
        let skipped = metric(&service, "modalwatch_mail_deliveries_total{outcome=\"skipped\"}").await;
        (skipped > 1.5).then_some(())
    })
    .await;
    assert!(server.all().is_empty(), "{:?}", server.all());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_comment_cannot_add_a_header_or_end_the_mail_early() {
    let folder = tempfile::tempdir().unwrap();
    let server = MailServer::start(&[]).await;
    let settings = [("EVENTS", "[\"alarm.commented\"]"), ("RECIPIENTS", "[\"ann@example.org\"]")];
    let service = Service::spawn(&mut mailing(folder.path(), &server, &settings));
    declare_undamaged(&service).await;
    damage(&service).await;
    let text = "first\n.\nBcc: all@example.org\n\nRCPT TO:<all@example.org>\nlast";
    let comment = json!({ "text": text, "author": "Ann Bcc: x" });
    created(service.post("/v1/structures/three-dof/alarms/1/comments", &comment).await).await;
    let mail = server.wait_for(1).await.remove(0);
    assert_eq!(
        (mail.recipients.len(), mail.field("Bcc"), mail.field("To")),
        (1, vec![], vec!["ann@example.org".to_owned()])
    );
    assert!(mail.text().contains("first\n.\nBcc: all@example.org") && mail.text().contains("last"), "{}", mail.data);
}

#[test]
fn a_wrong_setting_of_the_mails_is_named_at_the_start() {
    let folder = tempfile::tempdir().unwrap();
    for (key, value, said) in [
        ("RECIPIENTS", "[\"ann\"]", "email.recipients"),
        ("FROM", "nobody", "email.from"),
        ("HOST", "mail.example.org", "email.tls"),
        ("USERNAME", "watch", "email.password_file"),
    ] {
        let mut command = crate::helpers::command(folder.path());
        command.env("MODALWATCH__EMAIL__HOST", "127.0.0.1").env("MODALWATCH__EMAIL__TLS", "none");
        command.env("MODALWATCH__EMAIL__FROM", "watch@example.org");
        command.env("MODALWATCH__EMAIL__RECIPIENTS", "[\"ann@example.org\"]");
        command.env(format!("MODALWATCH__EMAIL__{key}"), value);
        let refused = refusal(&mut command);
        assert!(refused.contains(said), "{key}: {refused}");
    }
}
