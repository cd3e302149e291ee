//! A file that a service sends: begun again when the connection breaks, and whole or absent on disk.

use std::io::{Seek as _, Write as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context as _;
use indicatif::{ProgressBar, ProgressStyle};
use reqwest::Method;

use super::remote::{pause_before_another, Service};

/// Largest number of attempts. With several nodes, another one serves some seconds after one has ended.
const ATTEMPTS: usize = 20;

/// Pause before another attempt, unless the service names one.
const PAUSE: Duration = Duration::from_secs(3);

/// Longest time without a byte; a node that hangs keeps its connections open.
const SILENCE: Duration = Duration::from_mins(1);

/// Why an attempt ended early.
enum Broken {
    /// Another one, after a pause, may succeed.
    ForNow(anyhow::Error, Duration),
    /// Another one would end in the same way.
    ForGood(anyhow::Error),
}

/// A temporary file in the folder of a file, renamed to it when it is complete.
pub struct Draft {
    file: std::io::BufWriter<tempfile::NamedTempFile>,
    out: PathBuf,
    bytes: u64,
}

impl Draft {
    /// Begins a file.
    ///
    /// # Errors
    /// A folder that cannot be written.
    pub fn begin(out: &Path) -> anyhow::Result<Self> {
        let folder = out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let file = tempfile::NamedTempFile::new_in(folder);
        let file = file.with_context(|| format!("cannot write {}", out.display()))?;
        Ok(Self { file: std::io::BufWriter::new(file), out: out.to_owned(), bytes: 0 })
    }

    /// Appends to the file.
    ///
    /// # Errors
    /// A disk that takes no more.
    pub fn write(&mut self, bytes: &[u8]) -> anyhow::Result<()> {
        self.bytes += bytes.len() as u64;
        self.file.write_all(bytes).with_context(|| format!("cannot write {}", self.out.display()))
    }

    /// Writes the answer of a service to a path, from its start again if the connection breaks or the service is away for a moment. Progress
    /// is shown in a terminal, and each new beginning is said.
    ///
    /// # Errors
    /// A service that cannot be reached at first, or that refuses; the last failure after many attempts.
    pub async fn download(&mut self, service: &Service, path: &str) -> anyhow::Result<()> {
        let bar = ProgressBar::no_length();
        bar.set_style(ProgressStyle::with_template("{elapsed} {spinner} {bytes} ({bytes_per_sec})")?);
        for attempt in 1.. {
            match self.attempt(service, path, attempt, &bar).await {
                Ok(()) => break,
                Err(Broken::ForNow(failure, pause)) if attempt < ATTEMPTS => {
                    bar.suspend(|| eprintln!("{failure:#}: beginning again in {} s", pause.as_secs()));
                    tokio::time::sleep(pause).await;
                    self.begin_again()?;
                }
                Err(Broken::ForNow(failure, _) | Broken::ForGood(failure)) => return Err(failure),
            }
        }
        bar.finish_and_clear();
        Ok(())
    }

    async fn attempt(
        &mut self,
        service: &Service,
        path: &str,
        attempt: usize,
        bar: &ProgressBar,
    ) -> Result<(), Broken> {
        let for_now = |failure| Broken::ForNow(failure, PAUSE);
        let sent = tokio::time::timeout(SILENCE, service.request(Method::GET, path).send()).await;
        let sent = sent.with_context(|| format!("{} does not answer", service.url())).map_err(for_now)?;
        let sent = sent.with_context(|| format!("{} cannot be reached", service.url()));
        // At first, the address may be wrong.
        let sent = sent.map_err(|failure| if attempt == 1 { Broken::ForGood(failure) } else { for_now(failure) })?;
        let pause = pause_before_another(sent.status(), sent.headers(), PAUSE);
        let refused = |failure| match pause {
            Some(pause) => Broken::ForNow(failure, pause),
            None => Broken::ForGood(failure),
        };
        let mut answer = service.accepted(sent).await.map_err(refused)?;
        bar.set_position(0);
        loop {
            let chunk = tokio::time::timeout(SILENCE, answer.chunk()).await;
            let chunk = chunk.with_context(|| format!("{} sends no more", service.url())).map_err(for_now)?;
            let chunk = chunk.context("the connection broke before the end").map_err(for_now)?;
            let Some(chunk) = chunk else { return Ok(()) };
            self.write(&chunk).map_err(Broken::ForGood)?;
            bar.set_position(self.bytes);
        }
    }

    fn begin_again(&mut self) -> anyhow::Result<()> {
        let failed = || format!("cannot write {}", self.out.display());
        self.file.flush().with_context(failed)?;
        self.file.get_mut().as_file_mut().set_len(0).with_context(failed)?;
        self.file.rewind().with_context(failed)?;
        self.bytes = 0;
        Ok(())
    }

    /// Ends the file, which has its name from now on. Returns its size in bytes.
    ///
    /// # Errors
    /// A disk that takes no more, or a name that cannot be used.
    pub fn finish(self) -> anyhow::Result<u64> {
        let failed = || format!("cannot write {}", self.out.display());
        let file = self.file.into_inner().map_err(std::io::IntoInnerError::into_error).with_context(failed)?;
        file.as_file().sync_all().with_context(failed)?;
        file.persist(&self.out).with_context(failed)?;
        Ok(self.bytes)
    }
}
