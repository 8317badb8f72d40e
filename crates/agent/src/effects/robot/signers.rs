//! Who has signed a package, as the robot's steps ask for it: before anything is fetched, once more at each step that
//! fetches, builds or starts, whatever was planned.

use task_proto::desired::PackageRef;
use tokio_util::sync::CancellationToken;

use super::Robot;
use super::outcomes::fetch_failure;
use crate::plan::StepFailure;
use crate::trust::{Distrust, Use};
use crate::vouching::NotVouched;

impl Robot {
    /// That the package may be used so, by what was signed about it, which is fetched if need be.
    pub(super) async fn vouched(
        &self,
        package: &PackageRef,
        purpose: Use,
        cancel: &CancellationToken,
    ) -> Result<(), StepFailure> {
        let Some(vouching) = &self.vouching else { return Ok(()) };
        vouching.vouch(package, purpose, cancel).await.map_err(|error| match error {
            NotVouched::Distrusted(distrust) => refusal(&distrust, package),
            NotVouched::Fetch(error) => fetch_failure(error),
        })
    }

    /// The same for what was found to be so a moment ago. If it is no more, that is looked into first.
    pub(super) fn still_vouched(&self, package: &PackageRef) -> Result<(), StepFailure> {
        let Some(vouching) = &self.vouching else { return Ok(()) };
        let judged = vouching.judge(package, Use::Begin);
        judged.map_err(|distrust| StepFailure { retry_after_ms: Some(0), ..refusal(&distrust, package) })
    }
}

/// Only a list of publishers comes by itself: other signatures come with another order.
fn refusal(distrust: &Distrust, package: &PackageRef) -> StepFailure {
    StepFailure { failure: distrust.failure(package), retry_after_ms: distrust.may_pass().then_some(0) }
}
