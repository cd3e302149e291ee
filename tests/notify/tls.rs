//! Encrypted connections are made only to servers whose certificate is trusted.

use std::net::SocketAddr;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use rumqttc::tokio_rustls::rustls::pki_types::pem::PemObject as _;
use rumqttc::tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rumqttc::tokio_rustls::rustls::ServerConfig;
use rumqttc::tokio_rustls::server::TlsStream;
use rumqttc::tokio_rustls::TlsAcceptor;
use serde_json::{json, Value};
use tokio::net::{TcpListener, TcpStream};

use crate::helpers::{command, measurements, Service};
use crate::needs;
use crate::notify::broker::Broker;
use crate::notify::receiver::{Answer, Receiver};
use crate::notify::webhooks::{prepared, webhook};
use crate::notify::{eventually, metric};

/// Makes `authority.pem` and a certificate of it for localhost, `server.pem` and `server.key`. False, and the test is recorded as
/// skipped, where there is no openssl.
fn certificates(folder: &Path) -> bool {
    let Some(openssl) = needs::program("openssl") else { return false };
    std::fs::write(folder.join("extensions"), "subjectAltName=DNS:localhost\nbasicConstraints=CA:FALSE\n").unwrap();
    let key = "-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes";
    for arguments in [
        format!("req -x509 {key} -days 2 -subj /CN=test-authority -keyout authority.key -out authority.pem"),
        format!("req {key} -subj /CN=localhost -keyout server.key -out server.csr"),
        "x509 -req -in server.csr -CA authority.pem -CAkey authority.key -CAcreateserial -days 2 -extfile extensions \
         -out server.pem"
            .to_owned(),
    ] {
        let output = Command::new(&openssl).args(arguments.split(' ')).current_dir(folder).output().unwrap();
        assert!(output.status.success(), "{arguments}: {}", String::from_utf8_lossy(&output.stderr));
    }
    true
}

struct TlsListener {
    tcp: TcpListener,
    acceptor: TlsAcceptor,
}

impl axum::serve::Listener for TlsListener {
    type Io = TlsStream<TcpStream>;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Self::Io, Self::Addr) {
        loop {
            let (stream, address) = self.tcp.accept().await.unwrap();
            // A client that does not trust the certificate disconnects during the handshake.
            if let Ok(stream) = self.acceptor.accept(stream).await {
                return (stream, address);
            }
        }
    }

    fn local_addr(&self) -> std::io::Result<Self::Addr> {
        self.tcp.local_addr()
    }
}

async fn receiver(folder: &Path) -> Receiver {
    let certificates = CertificateDer::pem_file_iter(folder.join("server.pem")).unwrap();
    let certificates = certificates.collect::<Result<Vec<_>, _>>().unwrap();
    let key = PrivateKeyDer::from_pem_file(folder.join("server.key")).unwrap();
    let config = ServerConfig::builder().with_no_client_auth().with_single_cert(certificates, key).unwrap();
    let tcp = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = tcp.local_addr().unwrap();
    let listener = TlsListener { tcp, acceptor: TlsAcceptor::from(Arc::new(config)) };
    Receiver::serve(listener, address, Answer::Status(204))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_receiver_gets_messages_only_when_its_certificate_is_trusted() {
    let keys = tempfile::tempdir().unwrap();
    if !certificates(keys.path()) {
        return;
    }
    let receiver = receiver(keys.path()).await;
    let address = |host: &str| format!("https://{host}:{}/", receiver.address.port());
    let authority = keys.path().join("authority.pem");
    for (trusted, host, delivered) in
        [(true, "localhost", true), (true, "127.0.0.1", false), (false, "localhost", false)]
    {
        let folder = tempfile::tempdir().unwrap();
        let mut command = prepared(folder.path(), &[]);
        if trusted {
            command.env("SSL_CERT_FILE", &authority);
        }
        let service = Service::spawn(&mut command);
        let hook = webhook(&service, &address(host)).await;
        let path = format!("/v1/webhooks/{}/test", hook["webhook"].as_str().unwrap());
        let answer: Value = service.post(&path, &json!({})).await.json().await.unwrap();
        assert_eq!(answer["delivered"], delivered, "{host}: {answer}");
        assert!(delivered || answer["error"].as_str().unwrap().contains("certificate"), "{host}: {answer}");
    }
    assert_eq!(receiver.all().len(), 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_broker_may_ask_for_a_password_over_an_encrypted_connection() {
    let keys = tempfile::tempdir().unwrap();
    if !certificates(keys.path()) {
        return;
    }
    let Some(mosquitto_passwd) = needs::program("mosquitto_passwd") else { return };
    let mut users = Command::new(mosquitto_passwd);
    let output = users.args(["-b", "-c", "users", "gateway", "a secret"]).current_dir(keys.path()).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let path = |name: &str| keys.path().join(name).display().to_string();
    let more = format!(
        "listener {port} localhost\nallow_anonymous false\npassword_file {}\ncertfile {}\nkeyfile {}\nuser root\n",
        path("users"),
        path("server.pem"),
        path("server.key"),
    );
    let Some(broker) = Broker::start_with(&more) else { return };
    std::fs::write(keys.path().join("password"), "a secret\n").unwrap();
    let start = |folder: &Path, authority: Option<String>| {
        let mut command = command(folder);
        command.env("MODALWATCH__MQTT__URL", format!("mqtts://localhost:{port}"));
        command.env("MODALWATCH__MQTT__USERNAME", "gateway").env("MODALWATCH__MQTT__PASSWORD_FILE", path("password"));
        command.envs(authority.map(|file| ("MODALWATCH__MQTT__CA_FILE", file)));
        Service::spawn(&mut command)
    };
    let folder = tempfile::tempdir().unwrap();
    let service = start(folder.path(), Some(path("authority.pem")));
    let connected = async || (metric(&service, "modalwatch_mqtt_connected").await > 0.5).then_some(());
    eventually("the encrypted connection", connected).await;
    let batch = json!({ "measurements": measurements([4.0, 5.0, 6.0], 2, 0) }).to_string().into_bytes();
    broker.publish(&[("modalwatch/three-dof/batches", batch)]).await;
    let stored = async || {
        let history = service.read("/v1/structures/three-dof/history").await;
        (history["items"].as_array().unwrap().len() == 1).then_some(())
    };
    eventually("the batch", stored).await;

    // Without the authority the broker is not trusted and receives no password.
    let other = tempfile::tempdir().unwrap();
    let stranger = start(other.path(), None);
    eventually("the refused certificate", async || {
        let ready: Value = stranger.get("/readyz").send().await.unwrap().json().await.unwrap();
        let finding =
            ready["findings"].as_array().unwrap().iter().find(|finding| finding["code"] == "mqtt_unavailable");
        finding.is_some_and(|finding| finding["message"].as_str().unwrap().contains("certificate")).then_some(())
    })
    .await;
    assert!(metric(&stranger, "modalwatch_mqtt_connected").await < 0.5);
}
