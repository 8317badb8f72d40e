//! `taskd audit`: shows the audit, exports it, and verifies that no entry was changed.

use std::io::{BufRead as _, BufReader};
use std::path::PathBuf;
use std::str::FromStr;

use clap::Args;
use task_proto::Digest;
use task_proto::api::{AuditPage, AuditQuery};
use task_proto::people::audit::{AuditEntry, AuditRecord, ChainLink};

use crate::display::output::table::Columns;
use crate::display::output::{json_line, say, stream_text, time};
use crate::{CommandError, Connection, Outcome, Session};

/// The longest line of an export.
const MAX_LINE_BYTES: u64 = 256 * 1024;

/// The entries to show, export or verify.
#[derive(Debug, Args)]
pub struct AuditArgs {
    /// Only actions by this user
    #[arg(long, value_name = "NAME")]
    who: Option<String>,
    /// Only actions on this target: an id or a name
    #[arg(long, value_name = "TARGET")]
    target: Option<String>,
    /// Only actions with this prefix, such as robot. or deployment.create
    #[arg(long, value_name = "ACT")]
    act: Option<String>,
    /// Maximum number of entries, newest first
    #[arg(short = 'n', long, value_name = "N", default_value_t = 50)]
    limit: u64,
    /// Print all entries from the first, one JSON record per line
    #[arg(long, conflicts_with_all = ["verify", "who", "target", "act"])]
    export: bool,
    /// Verify the hash chain from the first entry to the last
    #[arg(long, conflicts_with_all = ["who", "target", "act"])]
    verify: bool,
    /// With --verify: also require this link, printed by an earlier --verify
    #[arg(long, value_name = "NUMBER:DIGEST", requires = "verify")]
    expect: Option<ExpectedLink>,
    /// With --verify: verify this exported file instead of the server's log
    #[arg(long, value_name = "FILE", requires = "verify")]
    file: Option<PathBuf>,
}

/// The link that an earlier verification printed.
#[derive(Debug, Clone, Copy)]
struct ExpectedLink(ChainLink);

impl FromStr for ExpectedLink {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let expected = || "expected a link printed by --verify, such as 12:sha256:…".to_owned();
        let (number, digest) = text.split_once(':').ok_or_else(expected)?;
        let digest: Digest = digest.parse().map_err(|_| expected())?;
        Ok(Self(ChainLink { number: number.parse().map_err(|_| expected())?, digest }))
    }
}

pub(crate) async fn run(connection: &Connection, args: AuditArgs) -> Result<Outcome, CommandError> {
    if let Some(path) = &args.file {
        return verify_file(path, args.expect);
    }
    let session = connection.open()?;
    if args.verify {
        return verify(&session, args.expect).await;
    }
    if args.export {
        return export(&session).await;
    }
    let page = newest(&session, args).await?;
    session.output.print_list(&page, &COLUMNS, |page| {
        page.records.iter().rev().filter_map(AuditRecord::read).map(row).collect()
    })?;
    Ok(Outcome::Succeeded)
}

/// The newest entries, up to the limit; the server returns them in pages.
async fn newest(session: &Session, args: AuditArgs) -> Result<AuditPage, CommandError> {
    let AuditArgs { who, target, act, limit, .. } = args;
    let mut query = AuditQuery { after: None, before: None, limit: Some(limit), who, target, act };
    let mut found: AuditPage = session.client.get_with("/audit", &query).await?;
    loop {
        let left = limit.saturating_sub(found.records.len() as u64);
        query.before = found.records.last().and_then(AuditRecord::read).map(|entry| entry.number);
        if left == 0 || query.before.is_none() {
            return Ok(found);
        }
        query.limit = Some(left);
        let page: AuditPage = session.client.get_with("/audit", &query).await?;
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
    Ok(session.client.get_with("/audit", &query).await?)
}

async fn export(session: &Session) -> Result<Outcome, CommandError> {
    let mut link = ChainLink::START;
    loop {
        let page = page_after(session, link.number).await?;
        if page.records.is_empty() {
            return Ok(Outcome::Succeeded);
        }
        for record in &page.records {
            // A broken chain in the export would otherwise be discovered too late.
            link = link.append(record).map_err(broken)?;
            if !stream_text(&format!("{}\n", json_line(record)?))? {
                return Ok(Outcome::Succeeded);
            }
        }
    }
}

async fn verify(
    session: &Session,
    expected: Option<ExpectedLink>,
) -> Result<Outcome, CommandError> {
    let mut verifier = ChainVerifier::new(expected);
    loop {
        let page = page_after(session, verifier.link.number).await?;
        if page.records.is_empty() {
            return verifier.finish();
        }
        page.records.iter().try_for_each(|record| verifier.append(record))?;
    }
}

fn verify_file(
    path: &std::path::Path,
    expected: Option<ExpectedLink>,
) -> Result<Outcome, CommandError> {
    let failed =
        |source| CommandError::Io { what: format!("can't read {}", path.display()), source };
    let mut reader = BufReader::new(std::fs::File::open(path).map_err(failed)?);
    let mut verifier = ChainVerifier::new(expected);
    loop {
        let mut line = Vec::new();
        let read = std::io::Read::take(&mut reader, MAX_LINE_BYTES)
            .read_until(b'\n', &mut line)
            .map_err(failed)?;
        if read == 0 {
            return verifier.finish();
        }
        let record: AuditRecord = serde_json::from_slice(&line).map_err(|error| {
            let number = verifier.link.number + 1;
            CommandError::Usage(format!(
                "{}, line {number}: not an audit record: {error}",
                path.display()
            ))
        })?;
        verifier.append(&record)?;
    }
}

/// The verified length of a chain.
struct ChainVerifier {
    link: ChainLink,
    expected: Option<ChainLink>,
}

impl ChainVerifier {
    fn new(expected: Option<ExpectedLink>) -> Self {
        Self { link: ChainLink::START, expected: expected.map(|ExpectedLink(link)| link) }
    }

    fn append(&mut self, record: &AuditRecord) -> Result<(), CommandError> {
        self.link = self.link.append(record).map_err(broken)?;
        match self.expected {
            Some(expected)
                if expected.number == self.link.number && expected.digest != self.link.digest =>
            {
                Err(CommandError::Broken(format!(
                    "entry {} differs from the expected link",
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
                "entry {number} is expected, but the log ends at entry {last}"
            )));
        }
        stream_text(&format!("{}:{}\n", link.number, link.digest))?;
        say(&format!(
            "{} entries verified; pass the line above to --expect next time",
            link.number
        ));
        Ok(Outcome::Succeeded)
    }
}

fn broken(error: task_proto::people::audit::BrokenChain) -> CommandError {
    CommandError::Broken(error.to_string())
}
