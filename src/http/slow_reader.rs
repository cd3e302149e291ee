//! The writing side of a connection: ends a connection whose client takes no bytes of its answers.

use std::future::Future as _;
use std::io;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::sync::Notify;
use tokio::time::Sleep;

/// Bytes that a client must take within the time limit while an answer waits. A client that takes single bytes to stay
/// connected is not a reader.
pub const LEAST_BYTES: usize = 4_096;

/// Whether bytes of an answer wait for the client of a connection.
#[derive(Debug, Default)]
pub struct Backlog {
    waits: AtomicBool,
    taken: Notify,
}

impl Backlog {
    /// Completes when the client has taken all bytes of the answers so far.
    pub async fn taken(&self) {
        while self.waits.load(Ordering::Acquire) {
            let taken = self.taken.notified();
            if !self.waits.load(Ordering::Acquire) {
                return;
            }
            taken.await;
        }
    }

    fn clear(&self) {
        if self.waits.swap(false, Ordering::AcqRel) {
            self.taken.notify_waiters();
        }
    }
}

/// A stream that fails with `TimedOut` when its client takes fewer than [`LEAST_BYTES`] within `limit` while bytes wait for it. A
/// stream without waiting bytes, such as an idle event stream, is never ended.
pub struct TimedWrites<S> {
    stream: S,
    limit: Duration,
    stalled: Option<Stalled>,
    backlog: Arc<Backlog>,
}

/// Bytes wait since the client did not take them at once.
struct Stalled {
    deadline: Pin<Box<Sleep>>,
    taken: usize,
}

impl<S> TimedWrites<S> {
    pub fn new(stream: S, limit: Duration, backlog: Arc<Backlog>) -> Self {
        Self { stream, limit, stalled: None, backlog }
    }

    fn watch(&mut self, context: &mut Context<'_>, written: Poll<io::Result<usize>>) -> Poll<io::Result<usize>> {
        match written {
            Poll::Ready(Ok(count)) => {
                if let Some(stalled) = &mut self.stalled {
                    stalled.taken += count;
                    if stalled.taken >= LEAST_BYTES {
                        self.stalled = None;
                    }
                }
                written
            }
            Poll::Ready(Err(_)) => written,
            Poll::Pending => {
                self.backlog.waits.store(true, Ordering::Release);
                let limit = self.limit;
                let begin = || Stalled { deadline: Box::pin(tokio::time::sleep(limit)), taken: 0 };
                let stalled = self.stalled.get_or_insert_with(begin);
                match stalled.deadline.as_mut().poll(context) {
                    Poll::Ready(()) => {
                        metrics::counter!("modalwatch_slow_readers_total").increment(1);
                        let message = "the client did not take its answer in time";
                        Poll::Ready(Err(io::Error::new(io::ErrorKind::TimedOut, message)))
                    }
                    Poll::Pending => Poll::Pending,
                }
            }
        }
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for TimedWrites<S> {
    fn poll_write(self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        let written = Pin::new(&mut this.stream).poll_write(context, bytes);
        this.watch(context, written)
    }

    fn poll_write_vectored(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        parts: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        let written = Pin::new(&mut this.stream).poll_write_vectored(context, parts);
        this.watch(context, written)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    /// hyper flushes only after it has written everything: nothing waits then.
    fn poll_flush(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        this.stalled = None;
        this.backlog.clear();
        Pin::new(&mut this.stream).poll_flush(context)
    }

    fn poll_shutdown(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_shutdown(context)
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for TimedWrites<S> {
    fn poll_read(self: Pin<&mut Self>, context: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_read(context, buffer)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

    use super::*;

    const LIMIT: Duration = Duration::from_secs(1);

    #[tokio::test]
    async fn a_client_that_takes_nothing_is_ended_and_one_that_reads_slowly_is_not() {
        let (here, _client) = tokio::io::duplex(1_024);
        let mut writes = TimedWrites::new(here, LIMIT, Arc::default());
        let started = tokio::time::Instant::now();
        let error = writes.write_all(&[0; 10_000]).await.unwrap_err();
        assert!(error.kind() == io::ErrorKind::TimedOut && started.elapsed() >= LIMIT, "{error}");

        // 1,000 bytes each 30 ms: 3 s for the answer, which is three times the limit.
        let (here, mut client) = tokio::io::duplex(1_024);
        let mut writes = TimedWrites::new(here, LIMIT, Arc::default());
        let reader = tokio::spawn(async move {
            let mut bytes = vec![0; 1_000];
            for _ in 0..100 {
                tokio::time::sleep(LIMIT * 3 / 100).await;
                client.read_exact(&mut bytes).await.unwrap();
            }
        });
        writes.write_all(&vec![0; 100_000]).await.unwrap();
        reader.await.unwrap();
    }

    #[tokio::test]
    async fn single_bytes_do_not_keep_a_connection() {
        let (here, mut client) = tokio::io::duplex(1_024);
        let mut writes = TimedWrites::new(here, LIMIT, Arc::default());
        tokio::spawn(async move {
            let mut byte = [0];
            while client.read_exact(&mut byte).await.is_ok() {
                tokio::time::sleep(LIMIT / 100).await;
            }
        });
        assert_eq!(writes.write_all(&[0; 10_000]).await.unwrap_err().kind(), io::ErrorKind::TimedOut);
    }

    #[tokio::test]
    async fn the_time_between_two_events_does_not_count() {
        let (here, mut client) = tokio::io::duplex(16);
        let mut writes = TimedWrites::new(here, LIMIT, Arc::default());
        let reader = tokio::spawn(async move {
            let mut event = [0; 32];
            for _ in 0..3 {
                client.read_exact(&mut event).await.unwrap();
            }
        });
        // Each event waits a moment, because the client takes 16 bytes at a time.
        for _ in 0..3 {
            writes.write_all(&[0; 32]).await.unwrap();
            writes.flush().await.unwrap();
            tokio::time::sleep(LIMIT * 3 / 2).await;
        }
        reader.await.unwrap();
    }

    #[tokio::test]
    async fn what_waits_is_known_until_it_is_taken() {
        let (here, mut client) = tokio::io::duplex(16);
        let backlog = Arc::new(Backlog::default());
        let mut writes = TimedWrites::new(here, LIMIT, Arc::clone(&backlog));
        backlog.taken().await;
        let writing = tokio::spawn(async move {
            writes.write_all(&[0; 64]).await.unwrap();
            writes.flush().await.unwrap();
            writes
        });
        while !backlog.waits.load(Ordering::Acquire) {
            tokio::task::yield_now().await;
        }
        let mut all = [0; 64];
        client.read_exact(&mut all).await.unwrap();
        backlog.taken().await;
        drop(writing.await.unwrap());
    }
}
