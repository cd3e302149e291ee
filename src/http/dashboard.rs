//! `/` and `/assets/…`: the dashboard, plain ES modules that are embedded in the program.
//!
//! Its files contain no secrets, so they need no token; the data that they request does.

use axum::http::{header, HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use data_encoding::HEXLOWER;

use super::error::ApiError;
use super::request::ApiPath;
use crate::quantity::shown;

#[derive(rust_embed::Embed)]
#[folder = "src/http/dashboard/"]
struct Files;

/// Content security policy of the page: it may load only files of this service. Charts set styles through the CSSOM,
/// which needs no exception for inline styles.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; \
                      connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Headers of every file besides its type and entity tag. `no-cache` makes the browser revalidate each time: file names
/// do not change with a release, and a page with files of two releases would not work.
const HEADERS: [(HeaderName, &str); 5] = [
    (header::CONTENT_SECURITY_POLICY, POLICY),
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::REFERRER_POLICY, "no-referrer"),
    (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    (header::CACHE_CONTROL, "no-cache"),
];

/// `GET /`: the page.
///
/// # Errors
/// None: the page is embedded in the program.
pub async fn index(headers: HeaderMap) -> Result<Response, ApiError> {
    file("index.html", &headers)
}

/// `GET /assets/{path}`: a file of the page.
///
/// # Errors
/// 404 if the dashboard has no such file.
pub async fn asset(ApiPath(path): ApiPath<String>, headers: HeaderMap) -> Result<Response, ApiError> {
    file(&path, &headers)
}

fn file(path: &str, request: &HeaderMap) -> Result<Response, ApiError> {
    let unknown = || {
        let detail = format!("the dashboard has no file {}", shown(path));
        ApiError::new(StatusCode::NOT_FOUND, "unknown_asset", detail)
    };
    let content_type = content_type(path).ok_or_else(unknown)?;
    let file = Files::get(path).ok_or_else(unknown)?;
    let tag = etag(&file.metadata.sha256_hash());
    let mut response = if is_known(request, &tag) {
        StatusCode::NOT_MODIFIED.into_response()
    } else {
        ([(header::CONTENT_TYPE, content_type)], file.data).into_response()
    };
    for (name, value) in HEADERS {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    let tag = HeaderValue::from_str(&tag).expect("a tag is hexadecimal digits in quotes");
    response.headers_mut().insert(header::ETAG, tag);
    Ok(response)
}

/// Media type of a file by its extension; `None` for a file that is not served.
fn content_type(path: &str) -> Option<&'static str> {
    match path.rsplit_once('.')?.1 {
        "html" => Some("text/html; charset=utf-8"),
        "js" => Some("text/javascript; charset=utf-8"),
        "css" => Some("text/css; charset=utf-8"),
        "svg" => Some("image/svg+xml"),
        "txt" => Some("text/plain; charset=utf-8"),
        _ => None,
    }
}

/// Strong entity tag: SHA-256 of the file.
fn etag(sha256: &[u8; 32]) -> String {
    format!("\"{}\"", HEXLOWER.encode(sha256))
}

/// Whether the browser has this version of the file.
fn is_known(request: &HeaderMap, tag: &str) -> bool {
    let given = request.get_all(header::IF_NONE_MATCH).into_iter().filter_map(|value| value.to_str().ok());
    given.flat_map(|value| value.split(',')).map(str::trim).any(|t| t == "*" || t.trim_start_matches("W/") == tag)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

    use super::*;

    fn has_ending(path: &str, ending: &str) -> bool {
        path.rsplit_once('.').is_some_and(|(_, found)| found == ending)
    }

    #[test]
    fn every_file_for_browsers_has_a_type_and_the_strict_policy() {
        let mut served = 0;
        for path in Files::iter().filter(|path| !has_ending(path, "md")) {
            let response = file(&path, &HeaderMap::new()).unwrap();
            assert_eq!(response.headers()[header::CONTENT_SECURITY_POLICY], POLICY, "{path}");
            assert_eq!(response.headers()[header::X_CONTENT_TYPE_OPTIONS], "nosniff", "{path}");
            served += 1;
        }
        assert!(served > 10, "only {served} files are embedded");
        assert!(!POLICY.contains("unsafe"));
    }

    #[test]
    fn a_file_that_the_browser_has_is_answered_304_and_another_version_in_full() {
        let tag = file("app.js", &HeaderMap::new()).unwrap().headers()[header::ETAG].clone();
        let ask = |tags: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::IF_NONE_MATCH, HeaderValue::from_str(tags).unwrap());
            file("app.js", &headers).unwrap().status()
        };
        let known = tag.to_str().unwrap();
        assert_eq!(ask(known), StatusCode::NOT_MODIFIED);
        assert_eq!(ask(&format!("\"older\", W/{known}")), StatusCode::NOT_MODIFIED);
        assert_eq!(ask("\"older\""), StatusCode::OK);
    }

    #[test]
    fn every_term_with_help_is_an_entry_of_the_glossary() {
        let glossary = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/", "glossary.md")).unwrap();
        let entries: Vec<String> =
            glossary.lines().filter_map(|line| line.strip_prefix("### ")).map(str::to_lowercase).collect();
        let mut terms = 0;
        for path in Files::iter().filter(|path| has_ending(path, "js") && !path.starts_with("vendor/")) {
            let source = String::from_utf8(Files::get(&path).unwrap().data.into_owned()).unwrap();
            for begin in ["help(\"", "term: \""] {
                for term in source.split(begin).skip(1).filter_map(|rest| rest.split('"').next()) {
                    assert!(entries.contains(&term.to_lowercase()), "{path}: {term} is not in docs/glossary.md");
                    terms += 1;
                }
            }
        }
        assert!(terms > 10, "only {terms} terms have help");
    }

    #[test]
    fn what_the_page_refers_to_is_embedded() {
        let text = |path: &str| String::from_utf8(Files::get(path).unwrap().data.into_owned()).unwrap();
        for reference in text("index.html").split('"').filter_map(|part| part.strip_prefix("assets/")) {
            assert!(Files::get(reference).is_some(), "index.html refers to {reference}");
        }
        for path in Files::iter().filter(|path| has_ending(path, "js") && !path.starts_with("vendor/")) {
            let folder = std::path::Path::new(&*path).parent().unwrap().to_path_buf();
            let source = text(&path);
            let imports = source.lines().filter(|line| line.starts_with("import ") || line.starts_with("} from "));
            for import in imports.filter_map(|line| line.split('"').nth(1)) {
                let mut target = folder.clone();
                for part in import.split('/') {
                    match part {
                        "." => {}
                        ".." => assert!(target.pop(), "{path} imports {import}"),
                        name => target.push(name),
                    }
                }
                assert!(Files::get(target.to_str().unwrap()).is_some(), "{path} imports {import}");
            }
        }
    }
}
