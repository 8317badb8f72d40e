//! The documents about people and the audit.

use std::fmt::Debug;

use task_proto::api::{
    AccessToken, Me, ProviderView, SessionView, TokenOrigin, TokenView, UserView,
};
use task_proto::people::audit::{AuditEntry, AuditRecord, ChainLink};
use task_proto::people::roles::Permission;

use crate::golden::{check, check_text, check_tolerance};

fn parsed<T: std::str::FromStr<Err: Debug>>(text: &str) -> T {
    text.parse().expect(text)
}

#[test]
fn people_and_token_documents() {
    let user = UserView {
        name: parsed("alice"),
        roles: parsed("operator,publisher"),
        scope: Some(parsed("site=lab")),
        has_password: true,
        subject: None,
        created_at_ms: 1_800_000_000_000,
    };
    check("user_view.json", &user);
    let subject = Some("https://id.example.org 248289761001".to_owned());
    check("user_view_of_provider.json", &UserView { has_password: false, subject, ..user });
    let provider = ProviderView {
        title: "the lab".to_owned(),
        url: "https://fleet.example.org/api/v1/oidc".to_owned(),
    };
    check(
        "session_view.json",
        &SessionView { expires_at_ms: Some(1_800_000_000_000), provider: Some(provider) },
    );
    check_tolerance::<SessionView>("session_view.json");
    let token = TokenView {
        id: parsed("0123456789ab"),
        user: parsed("alice"),
        origin: TokenOrigin::Token,
        title: "a dashboard".to_owned(),
        roles: Some(parsed("publisher")),
        scope: None,
        created_at_ms: 1_800_000_000_000,
        expires_at_ms: Some(1_807_776_000_000),
        revoked_at_ms: None,
    };
    check("token_view.json", &token);
    let me = Me {
        name: parsed("alice"),
        roles: parsed("operator"),
        permissions: vec![Permission::Read, Permission::Operate],
        scope: vec![parsed("site=lab"), parsed("atlas,boreas")],
        token: parsed("0123456789ab"),
    };
    check("me.json", &me);
    let made = AccessToken {
        id: parsed("0123456789ab"),
        token: "tsko_…".to_owned(),
        user: parsed("alice"),
        expires_at_ms: 1_807_776_000_000,
    };
    check_text("access_token.json", &made);
    check_tolerance::<UserView>("user_view.json");
    check_tolerance::<TokenView>("token_view.json");
    check_tolerance::<Me>("me.json");
}

/// An entry's bytes and their chaining may never change: written entries must stay valid.
#[test]
fn audit_documents() {
    let entry = AuditEntry {
        number: 1,
        at_ms: 1_800_000_000_000,
        who: "alice".to_owned(),
        token: Some(parsed("0123456789ab")),
        address: Some(parsed("192.0.2.7")),
        act: "deployment.create".to_owned(),
        target: "d00000000000000b2".to_owned(),
        detail: [("robots".to_owned(), "site=lab".to_owned())].into(),
    };
    check("audit_entry.json", &entry);
    let text = serde_json::to_string(&entry).expect("json");
    let link = ChainLink::START.next(&text);
    let entry = serde_json::value::RawValue::from_string(text).expect("json");
    let record = AuditRecord { digest: link.digest, entry };
    check_text("audit_record.json", &record);
    assert_eq!(ChainLink::START.append(&record), Ok(link));
}
