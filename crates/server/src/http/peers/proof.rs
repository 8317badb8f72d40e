//! The proofs by which the servers of a cluster know each other's requests. They are made from the
//! signing key, which all servers have and nothing else. A proof is for one request to one server,
//! so no clocks are compared. An eavesdropper can repeat only requests that read, and has seen
//! their answers. This module never decides about the rights of a proven request.

use std::net::IpAddr;

use hmac::{Hmac, KeyInit as _, Mac as _};
use http::{HeaderMap, HeaderName, Method, Uri};
use sha2::Sha256;
use task_proto::Digest;
use task_proto::ids::NodeName;
use task_proto::ids::digest::{hex, unhex};
use task_proto::trust::envelope::SigningKey;

/// The digest of the body of a server's own request, and its proof.
pub(super) const PEER: HeaderName = HeaderName::from_static("taskd-peer");
/// The address of the client whose request is passed on, and its proof.
pub(super) const CLIENT: HeaderName = HeaderName::from_static("taskd-client");

/// The proof of a request about its sender.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Proven {
    /// Nothing: any client may have sent it.
    Nothing,
    /// Another server of the cluster asks for itself.
    Peer,
    /// Another server passes on the request of a client at this address.
    Client(IpAddr),
}

/// A server's key for proofs.
pub(super) struct PeerKey(Hmac<Sha256>);

impl PeerKey {
    pub(super) fn of(key: &SigningKey) -> Self {
        let mac = Hmac::new_from_slice(&key.to_bytes()).expect("HMAC takes keys of any length");
        let mut mac: Hmac<Sha256> = mac;
        mac.update(b"request between servers of a cluster ");
        Self(mac)
    }

    /// The value of [`PEER`] for a request with this body to the server `to`.
    pub(super) fn prove_request(&self, to: &NodeName, path: &str, body: &[u8]) -> String {
        let digest = Digest::of(body).hex();
        let proof = self.mac(&["peer", to.as_str(), path, &digest]).finalize();
        format!("{digest} {}", hex(&proof.into_bytes()))
    }

    /// The value of [`CLIENT`] for a client's request that is passed on to the server `to`.
    pub(super) fn prove_client(
        &self,
        to: &NodeName,
        method: &Method,
        path: &str,
        client: IpAddr,
    ) -> String {
        let address = client.to_string();
        let proof = self.mac(&["client", to.as_str(), method.as_str(), path, &address]).finalize();
        format!("{address} {}", hex(&proof.into_bytes()))
    }

    /// The proof of a request that has reached the server `own`.
    pub(super) fn proven(
        &self,
        own: &NodeName,
        method: &Method,
        uri: &Uri,
        headers: &HeaderMap,
    ) -> Proven {
        let path = uri.path_and_query().map_or("", |path| path.as_str());
        if let Some((digest, proof)) = pair(headers, &PEER) {
            let mac = self.mac(&["peer", own.as_str(), path, digest]);
            return if verifies(mac, proof) { Proven::Peer } else { Proven::Nothing };
        }
        let client = pair(headers, &CLIENT).and_then(|(address, proof)| {
            let mac = self.mac(&["client", own.as_str(), method.as_str(), path, address]);
            verifies(mac, proof).then(|| address.parse().ok())?
        });
        client.map_or(Proven::Nothing, Proven::Client)
    }

    /// The code of these texts, each with its length.
    fn mac(&self, texts: &[&str]) -> Hmac<Sha256> {
        let mut mac = self.0.clone();
        for text in texts {
            mac.update(&(text.len() as u64).to_le_bytes());
            mac.update(text.as_bytes());
        }
        mac
    }
}

/// Whether the body is the one of a proven request.
pub(super) fn is_body(headers: &HeaderMap, body: &[u8]) -> bool {
    pair(headers, &PEER).is_some_and(|(digest, _)| digest == Digest::of(body).hex())
}

/// The two words of a header.
fn pair<'a>(headers: &'a HeaderMap, name: &HeaderName) -> Option<(&'a str, &'a str)> {
    headers.get(name)?.to_str().ok()?.split_once(' ')
}

fn verifies(mac: Hmac<Sha256>, proof: &str) -> bool {
    unhex(proof).is_some_and(|proof: [u8; 32]| mac.verify_slice(&proof).is_ok())
}

#[cfg(test)]
mod tests {
    use http::HeaderValue;

    use super::*;

    fn name(text: &str) -> NodeName {
        text.parse().expect("a name")
    }

    fn headers(name: HeaderName, value: &str) -> HeaderMap {
        HeaderMap::from_iter([(name, HeaderValue::from_str(value).expect("a header's value"))])
    }

    #[test]
    fn proof_is_for_one_request_to_one_server() {
        let key = PeerKey::of(&SigningKey::from_bytes([7; 32]));
        let uri = Uri::from_static("/peer/figures");
        let sent = headers(PEER, &key.prove_request(&name("b"), "/peer/figures", b"{}"));
        let proven = |own: &str, uri: &Uri| key.proven(&name(own), &Method::POST, uri, &sent);
        assert_eq!(proven("b", &uri), Proven::Peer);
        assert_eq!(proven("c", &uri), Proven::Nothing, "another server");
        assert_eq!(proven("b", &Uri::from_static("/peer/status")), Proven::Nothing, "another path");
        assert!(is_body(&sent, b"{}") && !is_body(&sent, b"{ }"));
        let foreign = PeerKey::of(&SigningKey::from_bytes([8; 32]));
        assert_eq!(foreign.proven(&name("b"), &Method::POST, &uri, &sent), Proven::Nothing);
        for forged in ["", "-", "a b", &format!("{} {}", "0".repeat(64), "0".repeat(64))] {
            let sent = headers(PEER, forged);
            assert_eq!(key.proven(&name("b"), &Method::POST, &uri, &sent), Proven::Nothing);
        }
    }

    #[test]
    fn address_of_a_client_counts_only_with_its_proof() {
        let key = PeerKey::of(&SigningKey::from_bytes([7; 32]));
        let (uri, client) = (Uri::from_static("/a?b=c"), IpAddr::from([10, 0, 0, 9]));
        let value = key.prove_client(&name("b"), &Method::POST, "/a?b=c", client);
        let proven =
            |method, value: &str| key.proven(&name("b"), &method, &uri, &headers(CLIENT, value));
        assert_eq!(proven(Method::POST, &value), Proven::Client(client));
        assert_eq!(proven(Method::GET, &value), Proven::Nothing);
        let forged = value.replace("10.0.0.9", "10.0.0.8");
        assert_eq!(proven(Method::POST, &forged), Proven::Nothing);
        assert_eq!(proven(Method::POST, "10.0.0.9"), Proven::Nothing);
        // The same code in the other header proves nothing.
        let other = key.proven(&name("b"), &Method::POST, &uri, &headers(PEER, &value));
        assert_eq!(other, Proven::Nothing);
    }
}
