//! `taskd login` and `taskd logout`: exchanges name and password for a token, which is stored by
//! server in a file of the user until the token is signed out or ends.

use std::time::Duration;

use clap::Args;
use task_proto::UserName;
use task_proto::api::{AccessToken, LogIn};

use crate::commands::api::client::Client;
use crate::commands::api::credentials::{Kept, path};
use crate::commands::display::output::{say, time};
use crate::commands::display::password::{self, PasswordFrom};
use crate::commands::{CommandError, Connection, Outcome};
use crate::config::lifetime;

/// Who signs in.
#[derive(Debug, Args)]
pub struct LoginOrder {
    /// The user's name
    user: UserName,
    /// How long to stay signed in, like 12h [default: 30d, which is also the most]
    #[arg(long, value_name = "TIME", value_parser = lifetime)]
    ttl: Option<Duration>,
    #[command(flatten)]
    from: PasswordFrom,
}

pub(in crate::commands) async fn log_in(
    connection: &Connection,
    order: LoginOrder,
) -> Result<Outcome, CommandError> {
    let client = Client::anonymous(connection)?;
    let path = path()
        .ok_or_else(|| CommandError::Usage("neither XDG_CONFIG_HOME nor HOME is set".to_owned()))?;
    let password =
        password::ask(order.from.password_stdin, &format!("password of {}", order.user))?.reveal();
    let request = LogIn { user: order.user, password, ttl_s: order.ttl.map(|ttl| ttl.as_secs()) };
    let token: AccessToken = client.once("/login", &request).await?;
    let mut kept = Kept::read(&path)?;
    kept.servers.insert(client.base().to_owned(), token.token);
    kept.last = Some(client.base().to_owned());
    if let Some(pin) = connection.pin {
        kept.pins.insert(client.base().to_owned(), pin);
    }
    kept.write(&path)?;
    say(&format!(
        "signed in at {} as {} until {}",
        client.base(),
        token.user,
        time(token.expires_at_ms)
    ));
    Ok(Outcome::Succeeded)
}

pub(in crate::commands) async fn log_out(connection: &Connection) -> Result<Outcome, CommandError> {
    let client = Client::anonymous(connection)?;
    let base = client.base().to_owned();
    let unknown = || CommandError::Usage(format!("you are not signed in at {base}"));
    let path = path().ok_or_else(unknown)?;
    let token = Kept::read(&path)?.servers.remove(&base).ok_or_else(unknown)?;
    // The token may have expired by itself, with the same effect. A token that the server may still
    // accept is not forgotten.
    match client.with_token(&token)?.delete("/session").await {
        Err(error) if error.outcome() != Outcome::NotAllowed => return Err(error.into()),
        _ => {}
    }
    let mut kept = Kept::read(&path)?;
    kept.servers.remove(&base);
    kept.last.take_if(|last| *last == base);
    kept.write(&path)?;
    say(&format!("signed out at {base}"));
    Ok(Outcome::Succeeded)
}
