//! A real broker, Debian's mosquitto, and a client that publishes to it.

use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use rumqttc::{AsyncClient, Event, MqttOptions, Packet, QoS};
use tempfile::TempDir;

use crate::needs;

pub struct Broker {
    child: Child,
    program: PathBuf,
    pub port: u16,
    folder: TempDir,
}

impl Broker {
    /// A broker on a free port; `None`, and the test is recorded as skipped, where there is no mosquitto.
    pub fn start() -> Option<Self> {
        Self::start_with("")
    }

    /// As [`Broker::start`], with more lines of configuration.
    pub fn start_with(more: &str) -> Option<Self> {
        let program = needs::program("mosquitto")?;
        let folder = tempfile::tempdir().unwrap();
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let config = format!(
            "per_listener_settings true\nmax_queued_messages 0\nlistener {port} 127.0.0.1\nallow_anonymous true\n\
             persistence_location {}/\n{more}",
            folder.path().display()
        );
        std::fs::write(folder.path().join("broker.conf"), config).unwrap();
        let child = run(&program, folder.path());
        let broker = Self { child, program, port, folder };
        broker.wait();
        Some(broker)
    }

    pub fn url(&self) -> String {
        format!("mqtt://127.0.0.1:{}", self.port)
    }

    /// Ends the broker; the messages that it kept for its clients are lost.
    pub fn stop(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Starts it again on the same port.
    pub fn restart(&mut self) {
        self.child = run(&self.program, self.folder.path());
        self.wait();
    }

    fn wait(&self) {
        for _ in 0..200 {
            if TcpStream::connect(("127.0.0.1", self.port)).is_ok() {
                return;
            }
            std::thread::sleep(Duration::from_millis(25));
        }
        panic!("mosquitto does not listen on port {}", self.port);
    }

    /// A broker that keeps the messages of absent clients on disk, and delivers them without waiting for acknowledgements.
    pub fn start_persistent() -> Option<Self> {
        // Started by root, the broker becomes a user that cannot write to the temporary folder, unless it is told to stay root.
        Self::start_with("user root\npersistence true\nmax_inflight_messages 0\n")
    }

    /// Ends the broker in order, so that it writes what it keeps, and starts it again.
    pub fn bounce(&mut self) {
        let pid = rustix::process::Pid::from_child(&self.child);
        rustix::process::kill_process(pid, rustix::process::Signal::TERM).unwrap();
        self.child.wait().unwrap();
        self.restart();
    }

    /// Publishes messages and returns when the broker has them.
    pub async fn publish(&self, messages: &[(&str, Vec<u8>)]) {
        self.publish_as(QoS::AtLeastOnce, messages).await;
    }

    /// As [`Broker::publish`], with a quality of service of 1 or 2.
    pub async fn publish_as(&self, qos: QoS, messages: &[(&str, Vec<u8>)]) {
        let name = format!("gateway-{}", uuid::Uuid::now_v7().simple());
        let mut options = MqttOptions::new(name, "127.0.0.1", self.port);
        options.set_max_packet_size(8 << 20, 8 << 20);
        let (client, mut events) = AsyncClient::new(options, messages.len() + 10);
        for (topic, payload) in messages {
            client.publish(*topic, qos, false, payload.clone()).await.unwrap();
        }
        let mut missing = messages.len();
        while missing > 0 {
            let event = tokio::time::timeout(Duration::from_secs(10), events.poll()).await.unwrap().unwrap();
            missing -= usize::from(matches!(event, Event::Incoming(Packet::PubAck(_) | Packet::PubComp(_))));
        }
    }
}

fn run(program: &Path, folder: &Path) -> Child {
    let mut command = Command::new(program);
    command.arg("-c").arg(folder.join("broker.conf")).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

impl Drop for Broker {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
