//! The header by which a node tells the one that serves whose request it passes on.
//!
//! The limits by address, the check of origins and the audit of the serving node see the client, not the node between. A client must not be
//! able to say the same of itself: the header ends with a code (HMAC-SHA-256) under the secret that the nodes of a database share, over the
//! node that it is meant for, method and path of the request, the address of the client, and the version of HTTP that it speaks.

use std::net::SocketAddr;

use axum::extract::{ConnectInfo, Request};
use axum::http::{HeaderName, HeaderValue, Method, Version};
use hmac::{Hmac, KeyInit as _, Mac as _};
use sha2::Sha256;

use crate::store::server::Nodes;

/// Name of the header.
pub const FORWARDED: HeaderName = HeaderName::from_static("modalwatch-forwarded");

/// The header does not come from a node that means this one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NotForUs;

/// The header of a request that is passed on to the node `target`.
pub fn signed(
    nodes: &Nodes,
    target: &str,
    (method, path): (&Method, &str),
    (client, version): (SocketAddr, Version),
) -> HeaderValue {
    let http = name_of(version);
    let code = code(nodes.secret(), target, (method, path), (&client.to_string(), http)).finalize().into_bytes();
    let text = format!("{client} {http} {}", data_encoding::HEXLOWER.encode(&code));
    HeaderValue::from_str(&text).expect("an address and digits are plain text")
}

/// Removes the header from a request; if it has one of a node, the request then is as it was when the client sent it. Returns whether it came
/// through a node.
///
/// # Errors
/// [`NotForUs`] for a header that does not come from a node of this database, or is meant for another node.
pub fn restore(request: &mut Request, nodes: &Nodes) -> Result<bool, NotForUs> {
    let mut given = request.headers().get_all(FORWARDED).iter();
    let value = match (given.next(), given.next()) {
        (None, _) => return Ok(false),
        (Some(value), None) => value.to_str().map_err(|_| NotForUs)?.to_owned(),
        (Some(_), Some(_)) => return Err(NotForUs),
    };
    let mut parts = value.split(' ');
    let (Some(client), Some(http), Some(hex), None) = (parts.next(), parts.next(), parts.next(), parts.next()) else {
        return Err(NotForUs);
    };
    let given = data_encoding::HEXLOWER.decode(hex.as_bytes()).map_err(|_| NotForUs)?;
    let path = request.uri().path_and_query().map_or("/", |path| path.as_str());
    let expected = code(nodes.secret(), &nodes.own().id, (request.method(), path), (client, http));
    // In constant time.
    expected.verify_slice(&given).map_err(|_| NotForUs)?;
    let client: SocketAddr = client.parse().map_err(|_| NotForUs)?;
    *request.version_mut() = if http == "1.0" { Version::HTTP_10 } else { Version::HTTP_11 };
    request.headers_mut().remove(FORWARDED);
    request.extensions_mut().insert(ConnectInfo(client));
    Ok(true)
}

fn name_of(version: Version) -> &'static str {
    if version < Version::HTTP_11 {
        "1.0"
    } else {
        "1.1"
    }
}

fn code(secret: &str, target: &str, (method, path): (&Method, &str), (client, http): (&str, &str)) -> Hmac<Sha256> {
    let mut code = Hmac::<Sha256>::new_from_slice(secret.as_bytes()).expect("a key may have any length");
    // None of the parts contains a line break.
    for part in [target, method.as_str(), path, client, http] {
        code.update(part.as_bytes());
        code.update(b"\n");
    }
    code
}
