//! The file in the body of an upload: the body itself, or the one file of a form.

use std::convert::Infallible;

use axum::body::Bytes;
use axum::http::{header, HeaderMap};

use super::error::ApiError;
use crate::quantity::shown;

/// Media type of the forms of browsers and of `curl -F`.
pub const FORM: &str = "multipart/form-data";

/// A form with one file.
#[derive(utoipa::ToSchema)]
#[expect(dead_code, reason = "only its description is used")]
pub struct TableForm {
    /// The table. The options are in the query, not in fields of the form.
    #[schema(value_type = String, format = Binary)]
    file: String,
}

/// The one file of a form.
///
/// # Errors
/// 422 for a form that cannot be read, or without exactly one file and nothing else.
pub async fn file_of_form(headers: &HeaderMap, body: Bytes) -> Result<Bytes, ApiError> {
    let content_type = headers.get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok()).unwrap_or_default();
    let boundary = multer::parse_boundary(content_type).map_err(|_| {
        let message = "multipart/form-data needs a boundary: let the program that sends the form set the header";
        ApiError::invalid_field("header/Content-Type", message)
    })?;
    let unreadable =
        |error: multer::Error| ApiError::invalid_field("body", format!("the form cannot be read: {error}"));
    let mut form = multer::Multipart::new(futures_util::stream::iter([Ok::<_, Infallible>(body)]), boundary);
    let mut file = None;
    while let Some(field) = form.next_field().await.map_err(unreadable)? {
        let name = field.name().unwrap_or_default().to_owned();
        if field.file_name().is_none() {
            let message = format!("{} is not a file: options such as split and zone are in the query", shown(&name));
            return Err(ApiError::invalid_field("body", message));
        }
        if file.is_some() {
            return Err(ApiError::invalid_field("body", "the form has more than one file: send one at a time"));
        }
        file = Some(content(field).await.map_err(unreadable)?);
    }
    file.ok_or_else(|| ApiError::invalid_field("body", "the form has no file"))
}

/// The content of a field. The whole form has arrived, so that it is one piece, which is not copied.
async fn content(mut field: multer::Field<'_>) -> Result<Bytes, multer::Error> {
    let mut pieces = Vec::new();
    while let Some(piece) = field.chunk().await? {
        pieces.push(piece);
    }
    Ok(match <[Bytes; 1]>::try_from(pieces) {
        Ok([whole]) => whole,
        Err(pieces) => Bytes::from(pieces.concat()),
    })
}
