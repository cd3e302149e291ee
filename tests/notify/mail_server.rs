//! A small SMTP server that records the mails and answers as configured.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};

use tokio::io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::{TcpListener, TcpStream};

use crate::notify::eventually;

/// A mail as it was sent.
#[derive(Debug, Clone)]
pub struct Mail {
    pub recipients: Vec<String>,
    /// Header and text, with the lines of the protocol.
    pub data: String,
    /// Answer to the mail, such as 250.
    pub answered: u16,
}

impl Mail {
    /// The header with its continued lines joined.
    fn head(&self) -> String {
        self.data.split("\n\n").next().unwrap().replace("\n ", " ")
    }

    /// Values of a header field.
    pub fn field(&self, name: &str) -> Vec<String> {
        let head = self.head();
        head.lines().filter_map(|line| Some(line.strip_prefix(name)?.strip_prefix(": ")?.to_owned())).collect()
    }

    /// The text after the header, with quoted-printable line ends joined.
    pub fn text(&self) -> String {
        let (_, text) = self.data.split_once("\n\n").unwrap();
        text.replace("=\n", "")
    }
}

#[derive(Clone)]
pub struct MailServer {
    pub address: SocketAddr,
    mails: Arc<Mutex<Vec<Mail>>>,
    /// Answers to the next mails; 250 afterwards.
    answers: Arc<Mutex<Vec<u16>>>,
}

impl MailServer {
    pub async fn start(answers: &[u16]) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let answers = Arc::new(Mutex::new(answers.iter().rev().copied().collect()));
        let server = Self { address: listener.local_addr().unwrap(), mails: Arc::default(), answers };
        let accepting = server.clone();
        tokio::spawn(async move {
            while let Ok((stream, _)) = listener.accept().await {
                let server = accepting.clone();
                // A client that ends the connection early ends this task with an error.
                tokio::spawn(async move { server.serve(stream).await });
            }
        });
        server
    }

    async fn serve(&self, stream: TcpStream) -> std::io::Result<()> {
        let mut stream = BufReader::new(stream);
        let mut recipients = Vec::new();
        stream.write_all(b"220 test\r\n").await?;
        loop {
            let mut line = String::new();
            if stream.read_line(&mut line).await? == 0 {
                return Ok(());
            }
            let verb = line.split([' ', ':']).next().unwrap_or_default().trim().to_ascii_uppercase();
            match verb.as_str() {
                "EHLO" => stream.write_all(b"250-test\r\n250 8BITMIME\r\n").await?,
                "RCPT" => {
                    recipients.push(line.trim().to_owned());
                    stream.write_all(b"250 ok\r\n").await?;
                }
                "DATA" => {
                    stream.write_all(b"354 go on\r\n").await?;
                    let mut data = String::new();
                    loop {
                        let mut line = String::new();
                        stream.read_line(&mut line).await?;
                        if line == ".\r\n" {
                            break;
                        }
                        data += line.strip_prefix('.').unwrap_or(&line);
                    }
                    let answered = self.answers.lock().unwrap().pop().unwrap_or(250);
                    let recipients = std::mem::take(&mut recipients);
                    let data = data.replace("\r\n", "\n");
                    self.mails.lock().unwrap().push(Mail { recipients, data, answered });
                    stream.write_all(format!("{answered} answer\r\n").as_bytes()).await?;
                }
                "QUIT" => {
                    stream.write_all(b"221 bye\r\n").await?;
                    return Ok(());
                }
                _ => stream.write_all(b"250 ok\r\n").await?,
            }
        }
    }

    pub fn all(&self) -> Vec<Mail> {
        self.mails.lock().unwrap().clone()
    }

    pub fn taken(&self) -> Vec<Mail> {
        self.all().into_iter().filter(|mail| mail.answered == 250).collect()
    }

    /// Waits until so many mails were accepted.
    pub async fn wait_for(&self, count: usize) -> Vec<Mail> {
        eventually("mails", async || Some(self.taken()).filter(|taken| taken.len() >= count)).await
    }
}
