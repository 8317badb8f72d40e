//! The small text files of a package's directory: regular, UTF-8 and of bounded size, or a problem
//! that is named.

use std::fs::{self, File};
use std::io::{self, Read as _};
use std::path::Path;

use super::{PackageError, Problem};

/// The largest text file that is read.
const MAX_TEXT_BYTES: u64 = 1024 * 1024;

/// The text file `name` in `dir`; `None` if the file is absent or unusable, which then is a
/// problem.
pub(super) fn read_text(
    dir: &Path,
    name: &str,
    problems: &mut Vec<Problem>,
) -> Result<Option<String>, PackageError> {
    let path = dir.join(name);
    let mut refuse = |reason: String| problems.push(Problem { file: name.to_owned(), reason });
    // Only a regular file is opened: a FIFO would block forever.
    match fs::symlink_metadata(&path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Ok(metadata) if metadata.is_file() && metadata.len() <= MAX_TEXT_BYTES => {}
        Ok(metadata) if metadata.is_file() => {
            refuse(format!("is larger than {MAX_TEXT_BYTES} bytes"));
            return Ok(None);
        }
        Ok(_) => {
            refuse("is not a regular file".to_owned());
            return Ok(None);
        }
        Err(source) => {
            return Err(PackageError::Io {
                what: format!("can't read {}", path.display()),
                source,
            });
        }
    }
    let mut bytes = Vec::new();
    File::open(&path).and_then(|file| file.take(MAX_TEXT_BYTES).read_to_end(&mut bytes)).map_err(
        |source| PackageError::Io { what: format!("can't read {}", path.display()), source },
    )?;
    match String::from_utf8(bytes) {
        Ok(text) => Ok(Some(text)),
        Err(_) => {
            refuse("is not UTF-8".to_owned());
            Ok(None)
        }
    }
}
