//! One tar entry: headers, long names and PAX records, parsed into a path and a kind that the tree
//! can trust. The parser accepts the output of GNU tar, Python and the packer, and nothing on which
//! two readers could disagree.

use std::io::Read;

use task_proto::packages::manifest::MAX_CONTENT_PATH_BYTES;

use super::stream::{BLOCK_BYTES, Blocks};
use super::{Refusal, UnpackError};

/// The longest name of one file: the limit of Linux file systems.
const MAX_COMPONENT_BYTES: usize = 255;
/// The largest block of PAX records.
const MAX_PAX_BYTES: u64 = 16 * 1024;
/// Set-user-id, set-group-id and sticky.
const SPECIAL_MODE_BITS: u32 = 0o7000;
/// PAX records without influence on the created files: times and owners, which the robot sets
/// itself.
const IGNORED_PAX_KEYS: [&[u8]; 8] =
    [b"atime", b"comment", b"ctime", b"gid", b"gname", b"mtime", b"uid", b"uname"];

/// An entry whose path is relative, without `.`, `..` or empty components; empty for the root
/// itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    /// The path in the tree.
    pub path: String,
    /// The kind of file to create.
    pub kind: Kind,
}

/// The kind of an entry.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Kind {
    /// A directory, with no bytes.
    Directory,
    /// A regular file with its bytes.
    File {
        /// The size of the file in bytes.
        size: u64,
        /// Whether the file is executable.
        executable: bool,
    },
    /// A symbolic link with its target.
    Symlink {
        /// As written: relative to the link's own directory.
        target: String,
    },
    /// A second name of a file.
    HardLink {
        /// A path like the entry's own.
        target: String,
    },
}

/// Values from extension headers for the entry that follows them.
#[derive(Default)]
struct Extended {
    path: Option<Vec<u8>>,
    link: Option<Vec<u8>>,
}

/// The next entry; `None` at the end marker.
pub(super) fn next<R: Read>(
    archive: &mut Blocks<R>,
    depth_limit: usize,
) -> Result<Option<Entry>, UnpackError> {
    let mut extended = Extended::default();
    loop {
        let block = archive.block()?;
        if block == [0; BLOCK_BYTES] {
            if extended.path.is_some() || extended.link.is_some() {
                return Err(archive.damaged("a long name without an entry"));
            }
            return Ok(None);
        }
        let header = tar::Header::from_byte_slice(&block);
        if header.cksum().ok() != Some(checksum(&block)) {
            return Err(archive.damaged("a header's checksum is wrong"));
        }
        if header.as_ustar().is_none() && header.as_gnu().is_none() {
            return Err(archive.damaged("a header is neither ustar nor GNU"));
        }
        let size =
            header.entry_size().map_err(|_| archive.damaged("an entry's size is not a number"))?;
        archive.check_entry(size)?;
        match header.entry_type().as_byte() {
            b'L' => extended.path(long_name(archive, size)?, archive)?,
            b'K' => extended.link(long_name(archive, size)?, archive)?,
            b'x' => extended.records(pax_records(archive, size)?, archive)?,
            b'g' => global_records(pax_records(archive, size)?, archive)?,
            _ => return Ok(Some(parse(header, size, extended, depth_limit)?)),
        }
    }
}

impl Extended {
    fn path<R: Read>(&mut self, path: Vec<u8>, archive: &Blocks<R>) -> Result<(), UnpackError> {
        match self.path.replace(path) {
            None => Ok(()),
            Some(_) => Err(archive.damaged("an entry has two long names")),
        }
    }

    fn link<R: Read>(&mut self, link: Vec<u8>, archive: &Blocks<R>) -> Result<(), UnpackError> {
        match self.link.replace(link) {
            None => Ok(()),
            Some(_) => Err(archive.damaged("an entry has two long link targets")),
        }
    }

    fn records<R: Read>(
        &mut self,
        records: Vec<Record>,
        archive: &Blocks<R>,
    ) -> Result<(), UnpackError> {
        for Record { key, value } in records {
            match &key[..] {
                b"path" => self.path(value, archive)?,
                b"linkpath" => self.link(value, archive)?,
                key if IGNORED_PAX_KEYS.contains(&key) => {}
                // Sizes and sparse maps that contradict the header make readers disagree about an
                // archive.
                key => {
                    return Err(archive
                        .damaged(format!("PAX record {} is not accepted", super::shown(key))));
                }
            }
        }
        Ok(())
    }
}

fn global_records<R: Read>(records: Vec<Record>, archive: &Blocks<R>) -> Result<(), UnpackError> {
    match records.iter().find(|record| record.key != b"comment") {
        None => Ok(()),
        Some(record) => Err(archive.damaged(format!(
            "PAX record {} is not accepted for all entries",
            super::shown(&record.key)
        ))),
    }
}

fn parse(
    header: &tar::Header,
    size: u64,
    extended: Extended,
    depth_limit: usize,
) -> Result<Entry, Refusal> {
    let name = extended.path.unwrap_or_else(|| header.path_bytes().into_owned());
    let refuse = |reason: String| Refusal::entry(&name, reason);
    let kind = header.entry_type().as_byte();
    let unaccepted = match kind {
        b'0' | 0 | b'1' | b'2' | b'5' => None,
        b'3' | b'4' => Some("devices are not accepted".to_owned()),
        b'6' => Some("FIFOs are not accepted".to_owned()),
        b'S' => Some("sparse files are not accepted".to_owned()),
        other => Some(format!("entries of type {} are not accepted", super::shown(&[other]))),
    };
    if let Some(reason) = unaccepted {
        return Err(refuse(reason));
    }
    let path = normal_path(&name, depth_limit).map_err(refuse)?;
    let mode = header.mode().map_err(|_| refuse("its mode is not a number".to_owned()))?;
    if mode & SPECIAL_MODE_BITS != 0 {
        return Err(refuse(format!("mode {mode:o} has set-id or sticky bits")));
    }
    let link = || {
        let link = extended
            .link
            .clone()
            .or_else(|| header.link_name_bytes().map(|bytes| bytes.into_owned()));
        link.ok_or_else(|| refuse("its link target is missing".to_owned()))
    };
    let link_refused = |reason: String| refuse(format!("its link target: {reason}"));
    let kind = match kind {
        b'5' => Kind::Directory,
        b'2' => Kind::Symlink { target: text(&link()?).map_err(link_refused)?.to_owned() },
        b'1' => {
            Kind::HardLink { target: normal_path(&link()?, depth_limit).map_err(link_refused)? }
        }
        _ if name.ends_with(b"/") => return Err(refuse("a file's name ends with '/'".to_owned())),
        _ => Kind::File { size, executable: mode & 0o111 != 0 },
    };
    if size > 0 && !matches!(kind, Kind::File { .. }) {
        return Err(refuse("only files may have content".to_owned()));
    }
    if path.is_empty() && !matches!(kind, Kind::Directory) {
        return Err(refuse("it would replace the package's own directory".to_owned()));
    }
    Ok(Entry { path, kind })
}

/// `path` without `.` and empty components; an error with the reason if the path must not be
/// created.
fn normal_path(path: &[u8], depth_limit: usize) -> Result<String, String> {
    let text = text(path)?;
    if text.starts_with('/') {
        return Err("the path is absolute".to_owned());
    }
    let components: Vec<&str> = text.split('/').filter(|part| !matches!(*part, "" | ".")).collect();
    if components.contains(&"..") {
        return Err("the path has '..'".to_owned());
    }
    if components.iter().any(|part| part.len() > MAX_COMPONENT_BYTES) {
        return Err(format!("a name is longer than {MAX_COMPONENT_BYTES} bytes"));
    }
    if components.len() > depth_limit {
        return Err(format!(
            "the path has {} components, where at most {depth_limit} are allowed",
            components.len()
        ));
    }
    Ok(components.join("/"))
}

/// `bytes` as the text of a path.
fn text(bytes: &[u8]) -> Result<&str, String> {
    if bytes.is_empty() {
        return Err("the path is empty".to_owned());
    }
    if bytes.len() > MAX_CONTENT_PATH_BYTES {
        return Err(format!("the path is longer than {MAX_CONTENT_PATH_BYTES} bytes"));
    }
    let text = std::str::from_utf8(bytes).map_err(|_| "the path is not UTF-8".to_owned())?;
    if text.chars().any(char::is_control) {
        return Err("the path has a control character".to_owned());
    }
    Ok(text)
}

fn checksum(block: &[u8; BLOCK_BYTES]) -> u32 {
    // The checksum's own eight bytes count as spaces.
    let sum = |bytes: &[u8]| bytes.iter().map(|&byte| u32::from(byte)).sum::<u32>();
    sum(&block[..148]) + 8 * u32::from(b' ') + sum(&block[156..])
}

fn long_name<R: Read>(archive: &mut Blocks<R>, size: u64) -> Result<Vec<u8>, UnpackError> {
    if size > MAX_CONTENT_PATH_BYTES as u64 + 1 {
        return Err(
            archive.damaged(format!("a name is longer than {MAX_CONTENT_PATH_BYTES} bytes"))
        );
    }
    let mut name = archive.collect(size)?;
    if name.last() == Some(&0) {
        name.pop();
    }
    Ok(name)
}

struct Record {
    key: Vec<u8>,
    value: Vec<u8>,
}

fn pax_records<R: Read>(archive: &mut Blocks<R>, size: u64) -> Result<Vec<Record>, UnpackError> {
    if size > MAX_PAX_BYTES {
        return Err(archive.damaged(format!("PAX records are longer than {MAX_PAX_BYTES} bytes")));
    }
    let bytes = archive.collect(size)?;
    let mut rest = &bytes[..];
    let mut records = Vec::new();
    while !rest.is_empty() {
        let (record, after) =
            split_record(rest).ok_or_else(|| archive.damaged("a PAX record is malformed"))?;
        records.push(record);
        rest = after;
    }
    Ok(records)
}

/// Takes one `LENGTH KEY=VALUE\n` from the front, where LENGTH counts the whole record.
fn split_record(bytes: &[u8]) -> Option<(Record, &[u8])> {
    let digits = bytes.iter().position(|&byte| byte == b' ')?;
    if digits > 5 || !bytes[..digits].iter().all(u8::is_ascii_digit) {
        return None;
    }
    let length: usize = std::str::from_utf8(&bytes[..digits]).ok()?.parse().ok()?;
    let body = bytes.get(digits + 1..length)?.strip_suffix(b"\n")?;
    let equals = body.iter().position(|&byte| byte == b'=')?;
    let (key, value) = (body[..equals].to_vec(), body[equals + 1..].to_vec());
    Some((Record { key, value }, &bytes[length..]))
}
