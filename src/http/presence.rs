//! Whether the client of a request is still connected: for work that goes on in a task of its own.

use std::convert::Infallible;

use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use tokio::sync::watch;

/// Held while the answer of a request is awaited.
pub struct Awaited {
    _sender: watch::Sender<()>,
}

/// Whether the client of a request is still connected.
#[derive(Debug, Clone, Default)]
pub struct Presence(Option<watch::Receiver<()>>);

impl Presence {
    /// The presence of a client, which lasts as long as the first value is kept.
    pub fn begin() -> (Awaited, Self) {
        let (sender, receiver) = watch::channel(());
        (Awaited { _sender: sender }, Self(Some(receiver)))
    }

    /// Completes when the client has left.
    pub async fn ends(&self) {
        match self.0.clone() {
            // An error means that the sender is gone.
            Some(mut receiver) => while receiver.changed().await.is_ok() {},
            None => std::future::pending().await,
        }
    }
}

impl<S: Send + Sync> FromRequestParts<S> for Presence {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        Ok(parts.extensions.get::<Self>().cloned().unwrap_or_default())
    }
}
