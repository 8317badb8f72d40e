//! `taskd audit`: shows the audit, exports it, and verifies that no entry was changed.

use std::io::{BufRead as _, BufReader};
use std::path::PathBuf;
use std::str::FromStr;

use clap::Args;
use task_proto::Digest;
use task_proto::api::{AuditPage, AuditQuery};
use task_proto::audit::{AuditEntry, AuditRecord, Link};

use crate::commands::display::output::table::Columns;
use crate::commands::display::output::{json_line, say, stream_text, time};
use crate::commands::{CommandError, Connection, Outcome, Session};

/// The longest line of an export.
const MOST_LINE_BYTES: u64 = 256 * 1024;

/// What to show of the audit.
#[derive(Debug, Args)]
pub struct AuditOrder {
    /// Only what this one did
    #[arg(long, value_name = "NAME")]
    who: Option<String>,
    /// Only what was done to this: an id or a name
    #[arg(long, value_name = "TARGET")]
    target: Option<String>,
    /// Only acts that begin so, like robot. or deployment.create
    #[arg(long, value_name = "ACT")]
    act: Option<String>,
    /// At most so many, the newest
    #[arg(short = 'n', long, value_name = "N", default_value_t = 50)]
    limit: u64,
    /// Print all entries from the first on, a JSON record a line
    #[arg(long, conflicts_with_all = ["verify", "who", "target", "act"])]
    export: bool,
    /// Verify the chain from the first entry to the last
    #[arg(long, conflicts_with_all = ["who", "target", "act"])]
    verify: bool,
    /// With --verify: the chain must also go through this link, which an earlier --verify printed
    #[arg(long, value_name = "NUMBER:DIGEST", requires = "verify")]
    expect: Option<Expected>,
    /// With --verify: verify this export instead; no server is asked
    #[arg(long, value_name = "FILE", requires = "verify")]
    file: Option<PathBuf>,
}

/// A link that was seen before.
#[derive(Debug, Clone, Copy)]
struct Expected(Link);

impl FromStr for Expected {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let expected = || "expected what --verify prints, like 12:sha256:…".to_owned();
        let (number, digest) = text.split_once(':').ok_or_else(expected)?;
        let digest: Digest = digest.parse().map_err(|_| expected())?;
        Ok(Self(Link { number: number.parse().map_err(|_| expected())?, digest }))
    }
}

pub(in crate::commands) async fn run(
    connection: &Connection,
    order: AuditOrder,
) -> Result<Outcome, CommandError> {
    if let Some(path) = &order.file {
        return verify_file(path, order.expect);
    }
    let session = connection.open()?;
    if order.verify {
        return verify(&session, order.expect).await;
    }
    if order.export {
        return export(&session).await;
    }
    let page = newest(&session, order).await?;
    session.output.result(&page, &COLUMNS, |page| {
        page.records.iter().rev().filter_map(AuditRecord::read).map(row).collect()
    })?;
    Ok(Outcome::Succeeded)
}

/// The newest entries, up to the limit; the server returns them in pages.
async fn newest(session: &Session, order: AuditOrder) -> Result<AuditPage, CommandError> {
    let AuditOrder { who, target, act, limit, .. } = order;
    let mut query = AuditQuery { after: None, before: None, limit: Some(limit), who, target, act };
    let mut found: AuditPage = session.client.get_by("/audit", &query).await?;
    loop {
        let left = limit.saturating_sub(found.records.len() as u64);
        query.before = found.records.last().and_then(AuditRecord::read).map(|entry| entry.number);
        if left == 0 || query.before.is_none() {
            return Ok(found);
        }
        query.limit = Some(left);
        let page: AuditPage = session.client.get_by("/audit", &query).await?;
        if page.records.is_empty() {
            return Ok(found);
        }
        found.records.extend(page.records);
    }
}

const COLUMNS: Columns = Columns::of(&["number", "time", "who", "from", "act", "target", "detail"]);

fn row(entry: AuditEntry) -> Vec<String> {
    let detail: Vec<String> =
        entry.detail.iter().map(|(key, value)| format!("{key}={value}")).collect();
    vec![
        entry.number.to_string(),
        time(entry.at_ms),
        entry.who,
        entry.address.map_or_else(|| "-".to_owned(), |address| address.to_string()),
        entry.act,
        entry.target,
        detail.join(" "),
    ]
}

/// The records after a number, the lowest first.
async fn page_after(session: &Session, number: u64) -> Result<AuditPage, CommandError> {
    let query = AuditQuery { after: Some(number), ..AuditQuery::default() };
    Ok(session.client.get_by("/audit", &query).await?)
}

async fn export(session: &Session) -> Result<Outcome, CommandError> {
    let mut link = Link::START;
    loop {
        let page = page_after(session, link.number).await?;
        if page.records.is_empty() {
            return Ok(Outcome::Succeeded);
        }
        for record in &page.records {
            // A broken chain in the export would otherwise be discovered too late.
            link = link.follow(record).map_err(broken)?;
            if !stream_text(&format!("{}\n", json_line(record)?))? {
                return Ok(Outcome::Succeeded);
            }
        }
    }
}

async fn verify(session: &Session, expected: Option<Expected>) -> Result<Outcome, CommandError> {
    let mut verified = Verified::new(expected);
    loop {
        let page = page_after(session, verified.link.number).await?;
        if page.records.is_empty() {
            return verified.finish();
        }
        page.records.iter().try_for_each(|record| verified.follow(record))?;
    }
}

fn verify_file(
    path: &std::path::Path,
    expected: Option<Expected>,
) -> Result<Outcome, CommandError> {
    let failed =
        |source| CommandError::Io { what: format!("can't read {}", path.display()), source };
    let mut reader = BufReader::new(std::fs::File::open(path).map_err(failed)?);
    let mut verified = Verified::new(expected);
    loop {
        let mut line = Vec::new();
        let read = std::io::Read::take(&mut reader, MOST_LINE_BYTES)
            .read_until(b'\n', &mut line)
            .map_err(failed)?;
        if read == 0 {
            return verified.finish();
        }
        let record: AuditRecord = serde_json::from_slice(&line).map_err(|error| {
            let number = verified.link.number + 1;
            CommandError::Usage(format!(
                "{}, line {number}: it is no record of an export: {error}",
                path.display()
            ))
        })?;
        verified.follow(&record)?;
    }
}

/// The verified length of a chain.
struct Verified {
    link: Link,
    expected: Option<Link>,
}

impl Verified {
    fn new(expected: Option<Expected>) -> Self {
        Self { link: Link::START, expected: expected.map(|Expected(link)| link) }
    }

    fn follow(&mut self, record: &AuditRecord) -> Result<(), CommandError> {
        self.link = self.link.follow(record).map_err(broken)?;
        match self.expected {
            Some(expected)
                if expected.number == self.link.number && expected.digest != self.link.digest =>
            {
                Err(CommandError::Broken(format!(
                    "entry {} is not the one that was seen before",
                    expected.number
                )))
            }
            _ => Ok(()),
        }
    }

    fn finish(self) -> Result<Outcome, CommandError> {
        let Self { link, expected } = self;
        if let Some(expected) = expected.filter(|expected| expected.number > link.number) {
            let (number, last) = (expected.number, link.number);
            return Err(CommandError::Broken(format!(
                "entry {number} was seen before, and now the last is {last}"
            )));
        }
        stream_text(&format!("{}:{}\n", link.number, link.digest))?;
        say(&format!(
            "all {} entries hold; give the line above to --expect next time",
            link.number
        ));
        Ok(Outcome::Succeeded)
    }
}

fn broken(error: task_proto::audit::BrokenChain) -> CommandError {
    CommandError::Broken(error.to_string())
}
