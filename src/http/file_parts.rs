//! Answers with a file that is made part by part while it is sent, so that the memory does not grow with the file.
//!
//! A slow reader makes that take hours. Between two parts the token may be revoked, and the structure deleted, or made anew under its id: the
//! connection is then closed before the end of the file, so that the client does not take a part for the whole, nor rows of two structures for
//! those of one.

use std::future::Future;
use std::io;

use axum::body::{Body, Bytes};
use axum::http::header;
use axum::response::{IntoResponse, Response};
use futures_util::stream::try_unfold;

use super::access::{AccessControl, Client};
use super::error::ApiError;
use super::shared::Shared;
use super::table::Format;
use crate::monitor::{Error, Records};
use crate::quantity::{StructureId, Timestamp};

/// A file of which the parts so far are sent.
pub trait FileParts: Sized + Send + 'static {
    /// Makes the next part. Returns it with the rest of the file, which is `None` after the last part.
    fn part(self) -> impl Future<Output = Result<(Bytes, Option<Self>), ApiError>> + Send;
}

/// What has to stay as it was until the last part of a file is sent.
pub struct Basis {
    access: AccessControl,
    client: Client,
    records: Records,
    structure: StructureId,
    created_at: Timestamp,
}

impl Basis {
    /// The token of a client and a structure, as they are now. What the file is written by, such as the columns of a table, is to be looked up
    /// afterwards: if it is that of another structure, no part passes the check.
    ///
    /// # Errors
    /// 404 for the structure.
    pub async fn now(shared: &Shared, client: Client, structure: &StructureId) -> Result<Self, ApiError> {
        let records = shared.monitor.records().clone();
        let created_at = records.created_at(structure).await?;
        Ok(Self { access: shared.access.clone(), client, records, structure: structure.clone(), created_at })
    }

    /// The next part of a file. The structure is looked at after the part was read, and not before: a deletion is noted in the store before
    /// it removes the first row, so that a part is whole if no deletion is noted behind it.
    async fn part<F: FileParts>(&self, file: F) -> Result<(Bytes, Option<F>), ApiError> {
        let part = file.part().await?;
        self.access.look_again(&self.client)?;
        if self.records.created_at(&self.structure).await? != self.created_at {
            return Err(Error::UnknownStructure(self.structure.clone()).into());
        }
        Ok(part)
    }
}

/// Answers with a file. Its first part is made before the status is sent, so that an early error can be answered as a problem.
///
/// # Errors
/// Those of the first part.
pub async fn file<F: FileParts>(basis: Basis, parts: F, format: Format, name: &str) -> Result<Response, ApiError> {
    let first = basis.part(parts).await?;
    let parts = try_unfold((basis, Some(first)), |(basis, part): (Basis, Option<(Bytes, Option<F>)>)| async move {
        let Some((bytes, rest)) = part else { return Ok(None) };
        let next = if let Some(rest) = rest {
            Some(basis.part(rest).await.map_err(broken_off)?)
        } else {
            // The last part may have waited for the reader.
            basis.access.look_again(&basis.client).map_err(broken_off)?;
            None
        };
        Ok::<_, io::Error>(Some((bytes, (basis, next))))
    });
    let name = format!("attachment; filename=\"{name}.{}\"", format.name());
    let headers = [
        (header::CONTENT_TYPE, format.content_type()),
        (header::CONTENT_DISPOSITION, name.as_str()),
        (header::CACHE_CONTROL, "no-store"),
    ];
    Ok((headers, Body::from_stream(parts)).into_response())
}

/// An error of a body, at which the connection is closed.
pub fn broken_off(cause: ApiError) -> io::Error {
    io::Error::other(cause.into_body().detail)
}
