//! The setting `blobs.store`: a bucket of an S3-compatible store, or a directory that several
//! servers have mounted. A URL never holds a key. This module opens no connection.

use std::fmt;
use std::net::IpAddr;
use std::path::PathBuf;
use std::str::FromStr;

use super::url_text::percent_decoded;

/// Where the bytes of packages and outputs lie, if not in the data directory alone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BlobStoreUrl {
    /// A directory that every server has mounted.
    Directory(PathBuf),
    S3(S3Bucket),
}

/// A bucket, and the way to it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct S3Bucket {
    pub bucket: String,
    /// The server's URL; absent: Amazon's for the region.
    pub endpoint: Option<String>,
    pub region: Option<String>,
    /// The file with the access key; absent: the variables `AWS_*`, or the machine's own role.
    pub credentials: Option<PathBuf>,
}

/// The text is not a valid `blobs.store`. The message never repeats the text.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum InvalidBlobStoreUrl {
    #[error("expected a URL that starts with s3:// or file:///")]
    Scheme,
    #[error("expected an absolute path without a query: file:///mnt/taskd")]
    Path,
    #[error(
        "expected s3://BUCKET, with endpoint, region and credentials after a '?': the bucket's name has 3 to 63 of \
         a-z, 0-9, '.' and '-', and no path follows it"
    )]
    Bucket,
    #[error(
        "it holds an access key: put the key into AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or into a file named \
         by credentials=FILE"
    )]
    Key,
    #[error("the parameters of a bucket are endpoint, region and credentials, each once")]
    Parameter,
    #[error("its endpoint is not of the form https://HOST or https://HOST:PORT")]
    Endpoint,
}

impl S3Bucket {
    /// The host of an endpoint that does not encrypt, unless the host is this machine.
    pub fn plaintext_host(&self) -> Option<&str> {
        let host = host_of(self.endpoint.as_deref()?.strip_prefix("http://")?);
        let bare = host.trim_start_matches('[').trim_end_matches(']');
        let is_loopback = host == "localhost"
            || bare.parse::<IpAddr>().is_ok_and(|address| address.is_loopback());
        (!is_loopback).then_some(host)
    }
}

impl FromStr for BlobStoreUrl {
    type Err = InvalidBlobStoreUrl;

    fn from_str(text: &str) -> Result<Self, InvalidBlobStoreUrl> {
        if let Some(path) = text.strip_prefix("file://") {
            let path = percent_decoded(path).ok_or(InvalidBlobStoreUrl::Path)?;
            let is_usable = path.starts_with('/') && path.len() > 1 && !path.contains(['?', '\0']);
            return if is_usable {
                Ok(Self::Directory(path.into()))
            } else {
                Err(InvalidBlobStoreUrl::Path)
            };
        }
        let place = text.strip_prefix("s3://").ok_or(InvalidBlobStoreUrl::Scheme)?;
        let (bucket, query) = place.split_once('?').unwrap_or((place, ""));
        if bucket.contains('@') {
            return Err(InvalidBlobStoreUrl::Key);
        }
        let is_plain =
            |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || matches!(b, b'.' | b'-');
        if !(3..=63).contains(&bucket.len()) || !bucket.bytes().all(is_plain) {
            return Err(InvalidBlobStoreUrl::Bucket);
        }
        let mut s3 =
            S3Bucket { bucket: bucket.to_owned(), endpoint: None, region: None, credentials: None };
        for pair in query.split('&').filter(|pair| !pair.is_empty()) {
            let (key, value) = pair.split_once('=').ok_or(InvalidBlobStoreUrl::Parameter)?;
            let value = percent_decoded(value).filter(|value| !value.is_empty());
            let value = value.ok_or(InvalidBlobStoreUrl::Parameter)?;
            match key {
                "endpoint" if s3.endpoint.is_none() => s3.endpoint = Some(endpoint(value)?),
                "region" if s3.region.is_none() => s3.region = Some(value),
                "credentials" if s3.credentials.is_none() => {
                    s3.credentials = Some(value.into());
                }
                _ if key.contains("key") || key.contains("secret") => {
                    return Err(InvalidBlobStoreUrl::Key);
                }
                _ => return Err(InvalidBlobStoreUrl::Parameter),
            }
        }
        Ok(Self::S3(s3))
    }
}

impl fmt::Display for BlobStoreUrl {
    /// The store's name for messages.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Directory(path) => write!(f, "file://{}", path.display()),
            Self::S3(S3Bucket { bucket, endpoint: Some(endpoint), .. }) => {
                write!(f, "s3://{bucket} at {endpoint}")
            }
            Self::S3(S3Bucket { bucket, .. }) => write!(f, "s3://{bucket}"),
        }
    }
}

fn endpoint(mut url: String) -> Result<String, InvalidBlobStoreUrl> {
    url.truncate(url.trim_end_matches('/').len());
    let place = url.strip_prefix("https://").or_else(|| url.strip_prefix("http://"));
    match place {
        Some(place) if place.contains('@') => Err(InvalidBlobStoreUrl::Key),
        Some(place) if !host_of(place).is_empty() && !place.contains(['/', '?', '#', ' ']) => {
            Ok(url)
        }
        _ => Err(InvalidBlobStoreUrl::Endpoint),
    }
}

/// The host of `HOST:PORT`.
fn host_of(place: &str) -> &str {
    if place.starts_with('[') {
        return place.find(']').map_or("", |end| &place[..=end]);
    }
    place.split(':').next().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bucket_has_its_parameters() {
        let url =
            "s3://fleet-blobs?endpoint=http%3A%2F%2F10.0.0.5:7070/&region=eu-1&credentials=/etc/k";
        let BlobStoreUrl::S3(s3) = url.parse().expect("valid") else { panic!("a bucket") };
        assert_eq!(s3.bucket, "fleet-blobs");
        assert_eq!(s3.endpoint.as_deref(), Some("http://10.0.0.5:7070"));
        assert_eq!(s3.region.as_deref(), Some("eu-1"));
        assert_eq!(s3.credentials, Some("/etc/k".into()));
        assert_eq!(s3.plaintext_host(), Some("10.0.0.5"));
        for (endpoint, plaintext) in [
            ("http://127.0.0.1:7070", None),
            ("http://[::1]:7070", None),
            ("http://localhost", None),
            ("https://10.0.0.5", None),
            ("http://[2001:db8::1]:7070", Some("[2001:db8::1]")),
        ] {
            let url = format!("s3://fleet?endpoint={endpoint}");
            let BlobStoreUrl::S3(s3) = url.parse().expect("valid") else { panic!("a bucket") };
            assert_eq!(s3.plaintext_host(), plaintext, "{endpoint}");
        }
    }

    #[test]
    fn directory_is_absolute() {
        let directory = "file:///mnt/task%20store".parse();
        assert_eq!(directory, Ok(BlobStoreUrl::Directory("/mnt/task store".into())));
        for text in ["file://", "file:///", "file://mnt", "file:///mnt?x=1"] {
            let expected = Err(InvalidBlobStoreUrl::Path);
            assert_eq!(text.parse::<BlobStoreUrl>(), expected, "{text}");
        }
    }

    #[test]
    fn invalid_bucket_is_refused() {
        for (text, expected) in [
            ("/mnt/taskd", InvalidBlobStoreUrl::Scheme),
            ("https://x", InvalidBlobStoreUrl::Scheme),
            ("s3://", InvalidBlobStoreUrl::Bucket),
            ("s3://Fleet", InvalidBlobStoreUrl::Bucket),
            ("s3://fleet/path", InvalidBlobStoreUrl::Bucket),
            ("s3://AKIA:secret@fleet", InvalidBlobStoreUrl::Key),
            ("s3://fleet?secret_access_key=x", InvalidBlobStoreUrl::Key),
            ("s3://fleet?endpoint=https://key@host", InvalidBlobStoreUrl::Key),
            ("s3://fleet?region", InvalidBlobStoreUrl::Parameter),
            ("s3://fleet?region=a&region=b", InvalidBlobStoreUrl::Parameter),
            ("s3://fleet?zone=a", InvalidBlobStoreUrl::Parameter),
            ("s3://fleet?endpoint=host", InvalidBlobStoreUrl::Endpoint),
            ("s3://fleet?endpoint=https://", InvalidBlobStoreUrl::Endpoint),
            ("s3://fleet?endpoint=https://host/path", InvalidBlobStoreUrl::Endpoint),
        ] {
            assert_eq!(text.parse::<BlobStoreUrl>(), Err(expected), "{text}");
        }
    }
}
