//! Robots of a server under measurement: enrolled through its API like any other, but without a
//! process.

use anyhow::Context as _;
use futures_util::{StreamExt as _, TryStreamExt as _};
use task_proto::MacAddress;
use task_proto::api::{CreateEnrollmentToken, EnrollRequest, EnrollResponse};
use task_proto::ids::Labels;

use crate::programs::server::Server;

/// Enrollments under way at a time.
const CONCURRENT_REQUESTS: usize = 16;
/// Lifetime of the enrollment token.
const TOKEN_TTL_S: u64 = 3600;

/// Enrolls `count` robots, named by their numbers.
pub async fn enroll_robots(server: &Server, count: usize) -> anyhow::Result<Vec<EnrollResponse>> {
    let uses = Some(count as u64);
    let order = CreateEnrollmentToken { ttl_s: Some(TOKEN_TTL_S), uses, ..Default::default() };
    let token = server.create_enrollment_token(&order).await?.token;
    let enrolling = (0..count).map(|number| {
        let token = &token;
        async move {
            let [_, _, _, _, a, b, c, d] = (number as u64).to_be_bytes();
            // Locally administered.
            let mac = MacAddress::from_octets([0x02, 0, a, b, c, d]).context("no MAC")?;
            let name = Some(format!("bench-{number:05}").parse()?);
            let request = EnrollRequest { mac, name, labels: Labels::new(), client_key: None };
            anyhow::Ok(server.enroll(token, &request).await?)
        }
    });
    futures_util::stream::iter(enrolling).buffered(CONCURRENT_REQUESTS).try_collect().await
}
