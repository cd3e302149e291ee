//! Answers with a file that is made part by part while it is sent, so that the memory does not grow with the file.

use std::future::Future;

use axum::body::{Body, Bytes};
use axum::http::header;
use axum::response::{IntoResponse, Response};
use futures_util::stream::try_unfold;

use super::error::ApiError;
use super::table::Format;

/// A file of which the parts so far are sent.
pub trait FileParts: Sized + Send + 'static {
    /// Makes the next part. Returns it with the rest of the file, which is `None` after the last part.
    fn part(self) -> impl Future<Output = Result<(Bytes, Option<Self>), ApiError>> + Send;
}

/// Answers with a file. Its first part is made before the status is sent, so that an early error can be answered as a problem.
///
/// # Errors
/// Those of the first part.
pub async fn file<F: FileParts>(parts: F, format: Format, name: &str) -> Result<Response, ApiError> {
    let first = parts.part().await?;
    let parts = try_unfold(Some(first), |part: Option<(Bytes, Option<F>)>| async {
        let Some((bytes, rest)) = part else { return Ok(None) };
        let next = match rest {
            Some(rest) => Some(rest.part().await.map_err(|_| std::io::Error::other("the export failed"))?),
            None => None,
        };
        Ok::<_, std::io::Error>(Some((bytes, next)))
    });
    let name = format!("attachment; filename=\"{name}.{}\"", format.name());
    let headers = [
        (header::CONTENT_TYPE, format.content_type()),
        (header::CONTENT_DISPOSITION, name.as_str()),
        (header::CACHE_CONTROL, "no-store"),
    ];
    Ok((headers, Body::from_stream(parts)).into_response())
}
