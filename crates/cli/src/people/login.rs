//! `taskd login` and `taskd logout`: exchanges name and password for a token, which is stored by
//! server in a file of the user until the token is signed out or ends.

use std::time::Duration;

use clap::Args;
use task_proto::UserName;
use task_proto::api::{AccessToken, LogIn};
use task_proto::time::parse_lifetime;

use crate::api::client::Client;
use crate::api::credentials::{StoredCredentials, path};
use crate::display::output::{say, time};
use crate::display::password::{self, PasswordSource};
use crate::{CommandError, Connection, Outcome};

/// The user, and the lifetime of the sign-in.
#[derive(Debug, Args)]
pub struct LoginArgs {
    /// User name
    user: UserName,
    /// Time to stay signed in, such as 12h, at most 30d [default: 30d]
    #[arg(long, value_name = "TIME", value_parser = parse_lifetime)]
    ttl: Option<Duration>,
    #[command(flatten)]
    source: PasswordSource,
}

pub(crate) async fn login(
    connection: &Connection,
    args: LoginArgs,
) -> Result<Outcome, CommandError> {
    let client = Client::anonymous(connection)?;
    let path = path()
        .ok_or_else(|| CommandError::Usage("neither XDG_CONFIG_HOME nor HOME is set".to_owned()))?;
    let password =
        password::prompt(args.source.password_stdin, &format!("password of {}", args.user))?
            .reveal();
    let request = LogIn { user: args.user, password, ttl_s: args.ttl.map(|ttl| ttl.as_secs()) };
    let token: AccessToken = client.post_once("/login", &request).await?;
    let mut stored = StoredCredentials::read(&path)?;
    stored.servers.insert(client.base().to_owned(), token.token);
    stored.last = Some(client.base().to_owned());
    if let Some(pin) = connection.pin {
        stored.pins.insert(client.base().to_owned(), pin);
    }
    stored.write(&path)?;
    say(&format!(
        "signed in to {} as {} until {}",
        client.base(),
        token.user,
        time(token.expires_at_ms)
    ));
    Ok(Outcome::Succeeded)
}

pub(crate) async fn logout(connection: &Connection) -> Result<Outcome, CommandError> {
    let client = Client::anonymous(connection)?;
    let base = client.base().to_owned();
    let unknown = || CommandError::Usage(format!("you are not signed in to {base}"));
    let path = path().ok_or_else(unknown)?;
    let token = StoredCredentials::read(&path)?.servers.remove(&base).ok_or_else(unknown)?;
    // The token may have expired by itself, with the same effect. A token that the server may still
    // accept is not forgotten.
    match client.with_token(&token)?.delete("/session").await {
        Err(error) if error.outcome() != Outcome::NotAllowed => return Err(error.into()),
        _ => {}
    }
    let mut stored = StoredCredentials::read(&path)?;
    stored.servers.remove(&base);
    stored.last.take_if(|last| *last == base);
    stored.write(&path)?;
    say(&format!("signed out of {base}"));
    Ok(Outcome::Succeeded)
}
