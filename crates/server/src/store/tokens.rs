//! Tokens: stored as digests, with what each may do.

use task_proto::RobotId;
use task_proto::token::Token;

use super::{Store, StoreError};

/// Whom a valid token stands for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum TokenHolder {
    /// An operator.
    Operator,
    /// Someone who may enrol.
    Enrolment,
    /// This robot.
    Robot(RobotId),
}

impl Store {
    /// Whom `token` stands for at `now_ms`; `None` if it is unknown, wrong, used up, expired or revoked.
    pub async fn token_holder(&self, token: &Token, now_ms: u64) -> Result<Option<TokenHolder>, StoreError> {
        todo!()
    }

    /// Stores an operator's token that does not expire.
    pub async fn create_operator_token(&self, token: &Token, now_ms: u64) -> Result<(), StoreError> {
        todo!()
    }
}
