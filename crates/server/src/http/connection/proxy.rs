//! The original address of a request behind a reverse proxy, from `X-Forwarded-For`. The header is
//! believed only from a proxy with a trusted address.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;

use axum::extract::{ConnectInfo, Request, State};
use http::HeaderMap;

/// The addresses of trusted proxies.
pub(in crate::http) type TrustedProxies = Arc<[IpAddr]>;

/// Replaces the proxy's address by the address of the proxy's client, with port 0: the client's port
/// is unknown.
pub(in crate::http) async fn resolve_client_address(
    State(trusted): State<TrustedProxies>,
    mut request: Request,
) -> Request {
    let Some(ConnectInfo(peer)) = request.extensions().get::<ConnectInfo<SocketAddr>>().copied()
    else {
        return request;
    };
    if let Some(address) = forwarded_for(&trusted, peer.ip(), request.headers()) {
        request.extensions_mut().insert(ConnectInfo(SocketAddr::new(address, 0)));
    }
    request
}

/// The last address on the list that is not a trusted proxy's. Addresses before it can be forged by
/// any client and are ignored.
fn forwarded_for(trusted: &[IpAddr], peer: IpAddr, headers: &HeaderMap) -> Option<IpAddr> {
    if !trusted.contains(&peer.to_canonical()) {
        return None;
    }
    let lines = headers.get_all("x-forwarded-for").iter().rev();
    for text in lines.flat_map(|line| line.as_bytes().rsplit(|&b| b == b',')) {
        // A trusted proxy writes only valid addresses.
        let address: IpAddr = std::str::from_utf8(text.trim_ascii()).ok()?.parse().ok()?;
        if !trusted.contains(&address.to_canonical()) {
            return Some(address.to_canonical());
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(peer: &str, lines: &[&str]) -> Option<String> {
        let lines: Vec<&[u8]> = lines.iter().map(|line| line.as_bytes()).collect();
        found_in(peer, &lines)
    }

    fn found_in(peer: &str, lines: &[&[u8]]) -> Option<String> {
        let trusted: Vec<IpAddr> =
            ["10.0.0.1", "10.0.0.2"].map(|text| text.parse().expect("an address")).into();
        let mut headers = HeaderMap::new();
        for line in lines {
            headers
                .append("x-forwarded-for", http::HeaderValue::from_bytes(line).expect("a value"));
        }
        forwarded_for(&trusted, peer.parse().expect("an address"), &headers)
            .map(|address| address.to_string())
    }

    #[test]
    fn only_entries_of_a_trusted_proxy_count() {
        assert_eq!(found("10.0.0.1", &["192.0.2.7"]).as_deref(), Some("192.0.2.7"));
        assert_eq!(found("::ffff:10.0.0.1", &["192.0.2.7"]).as_deref(), Some("192.0.2.7"));
        assert_eq!(
            found("10.0.0.1", &["1.1.1.1, 192.0.2.7, 10.0.0.2"]).as_deref(),
            Some("192.0.2.7")
        );
        assert_eq!(found("10.0.0.1", &["1.1.1.1", "2001:db8::7"]).as_deref(), Some("2001:db8::7"));
        assert_eq!(found("192.0.2.9", &["192.0.2.7"]), None);
        assert_eq!(found("10.0.0.1", &[]), None);
        assert_eq!(found("10.0.0.1", &["192.0.2.7, unknown"]), None);
        assert_eq!(found("10.0.0.1", &["10.0.0.2"]), None);
    }

    #[test]
    fn malformed_entries_before_the_client_are_ignored() {
        let foreign: &[u8] = b"caf\xe9, \xff";
        assert_eq!(found_in("10.0.0.1", &[foreign, b"192.0.2.7"]).as_deref(), Some("192.0.2.7"));
        assert_eq!(
            found_in("10.0.0.1", &[b"\xff,192.0.2.7, 10.0.0.2"]).as_deref(),
            Some("192.0.2.7")
        );
        assert_eq!(
            found("10.0.0.1", &["nonsense", "192.0.2.7", "10.0.0.2"]).as_deref(),
            Some("192.0.2.7")
        );
        assert_eq!(found_in("10.0.0.1", &[b"192.0.2.7, \xff"]), None);
        assert_eq!(found_in("10.0.0.1", &[b"192.0.2.7", foreign]), None);
    }
}
