//! Mosquitto's files: password file, access control list, and the configuration of its listener.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, KeyInit as _, Mac as _};
use sha2::Sha512;
use task_proto::messages::topic::TopicPrefix;

use super::{Account, External};
use crate::broker::CANARY_LEVEL;
use crate::domain::broker_url::BrokerUrl;

/// The default of `mosquitto_passwd`. Iterations only slow down guessing, and 256 bits can't be
/// guessed.
const DERIVED_ITERATIONS: u32 = 101;
/// More iterations, because a person chose the server's own password.
const SERVER_ITERATIONS: u32 = 20_000;
/// The salt length that mosquitto reads.
const SALT_BYTES: usize = 12;

/// One line of a mosquitto password file. The salt is derived from user and password, so that the
/// same robots make the same file and a changed file means a changed password.
pub(super) fn passwd_line(external: &External, account: &Account) -> String {
    let Account { user_name, password, .. } = account;
    let iterations = if account.is_derived() { DERIVED_ITERATIONS } else { SERVER_ITERATIONS };
    let salt = &external.derived(&format!("salt {user_name} {password}"))[..SALT_BYTES];
    let hash = pbkdf2(password.as_bytes(), salt, iterations);
    format!("{user_name}:$7${iterations}${}${}\n", STANDARD.encode(salt), STANDARD.encode(hash))
}

/// PBKDF2 with HMAC-SHA-512; mosquitto uses only the first block.
fn pbkdf2(password: &[u8], salt: &[u8], iterations: u32) -> [u8; 64] {
    let keyed = Hmac::<Sha512>::new_from_slice(password).expect("HMAC takes keys of any length");
    let block = |input: &[&[u8]]| -> [u8; 64] {
        let mut mac = keyed.clone();
        input.iter().for_each(|bytes| mac.update(bytes));
        mac.finalize().into_bytes().into()
    };
    let mut last = block(&[salt, &1u32.to_be_bytes()]);
    let mut all = last;
    for _ in 1..iterations {
        last = block(&[&last]);
        all.iter_mut().zip(last).for_each(|(all, last)| *all ^= last);
    }
    all
}

/// A mosquitto ACL file: robots on their own topics by name, `%u` being the robot id; the server on
/// all topics that it needs. Patterns apply to every user of the broker, but only robots have such
/// names.
pub(super) fn acl(user_name: &str, prefix: &TopicPrefix) -> String {
    format!(
        "# Written by `taskd broker acl`.\n\
         user {user_name}\n\
         topic write {prefix}/r/+/desired\n\
         topic write {prefix}/r/+/request\n\
         topic write {prefix}/p/+\n\
         topic read {prefix}/r/+/status\n\
         topic read {prefix}/r/+/reply\n\
         topic read {prefix}/r/+/log\n\
         topic read {prefix}/r/+/telemetry\n\
         topic readwrite {prefix}/{CANARY_LEVEL}\n\
         \n\
         pattern read {prefix}/r/%u/desired\n\
         pattern read {prefix}/r/%u/request\n\
         pattern read {prefix}/p/+\n\
         pattern write {prefix}/r/%u/status\n\
         pattern write {prefix}/r/%u/reply\n\
         pattern write {prefix}/r/%u/log\n\
         pattern write {prefix}/r/%u/telemetry\n"
    )
}

/// The listener at `url`, with the rules that the server relies on.
pub(super) fn conf(url: &BrokerUrl) -> String {
    let tls = match url.tls {
        true => {
            "certfile /etc/mosquitto/certs/broker.pem\nkeyfile /etc/mosquitto/certs/broker.key\n"
        }
        false => "",
    };
    format!(
        "# Written by `taskd broker conf`: /etc/mosquitto/conf.d/taskd.conf\n\
         listener {}\n\
         {tls}\
         allow_anonymous false\n\
         # Without this line a robot that connects with the client id of the server or of another robot ends its session.\n\
         use_username_as_clientid true\n\
         acl_file /etc/mosquitto/taskd.acl\n\
         password_file /etc/mosquitto/taskd.passwd\n\
         # Nothing of it needs to last.\n\
         persistence false\n\
         # Larger than a part (delivery.part_bytes). A message above 4 MiB would end the server's session.\n\
         message_size_limit 2097152\n\
         # Statuses of a whole fleet may come at once.\n\
         max_queued_messages 100000\n",
        url.port
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hash_matches_the_reference_vector() {
        // PBKDF2-HMAC-SHA-512 of "password" and "salt" with one and two iterations begins with
        // these bytes in every implementation.
        let hex = |iterations| {
            let bytes = pbkdf2(b"password", b"salt", iterations);
            bytes[..8].iter().map(|byte| format!("{byte:02x}")).collect::<String>()
        };
        assert_eq!((hex(1).as_str(), hex(2).as_str()), ("867f70cf1ade02cf", "e1d9c16aa681708a"));
    }
}
