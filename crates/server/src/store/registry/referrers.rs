//! The manifests that refer to a manifest, one page at a time: their number is unlimited, and each
//! brings texts of its own.

use sqlx::Row as _;
use sqlx::any::AnyRow;
use task_proto::desired::BlobRef;
use task_proto::packages::oci::Descriptor;
use task_proto::{Digest, RepositoryName};

use crate::store::repositories::Manifests;
use crate::store::{Store, StoreError, rows};

/// Approximate limit of a page in bytes of JSON. A larger first entry is returned alone.
const MAX_PAGE_BYTES: u64 = 4 * 1024 * 1024;
/// The most bytes of an entry besides its texts.
const ENTRY_BYTES: u64 = 256;

/// A page of referrers.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ReferrersPage {
    /// The referrers, sorted by digest.
    pub manifests: Vec<Descriptor>,
    /// The last referrer of the page, if there are more.
    pub next: Option<Digest>,
}

impl Manifests<&Store> {
    /// The manifests whose subject is `subject`, of one type or of all. The page begins after a
    /// digest, or with the first manifest.
    pub async fn referrers(
        self,
        repository: &RepositoryName,
        subject: &str,
        artifact_type: Option<&str>,
        after: Option<&Digest>,
    ) -> Result<ReferrersPage, StoreError> {
        let artifact_type = artifact_type.unwrap_or_default();
        let after = after.map_or_else(String::new, Digest::to_string);
        // The sizes are read first, because all texts together may not fit into memory.
        let sizes: Vec<(String, i64)> = sqlx::query_as(
            "SELECT digest, CAST(octet_length(annotations) + octet_length(media_type)
                 + octet_length(COALESCE(artifact_type, '')) AS BIGINT) FROM manifests
             WHERE repository = $1 AND subject = $2 AND ($3 = '' OR artifact_type = $3) AND digest > $4
             ORDER BY digest LIMIT $5",
        )
        .bind(repository.as_str())
        .bind(subject)
        .bind(artifact_type)
        .bind(&after)
        .bind(rows::stored(MAX_PAGE_BYTES / ENTRY_BYTES + 1))
        .fetch_all(&self.0.reads)
        .await?;
        let Some((last, has_more)) = page_end(&sizes) else { return Ok(ReferrersPage::default()) };
        let found = sqlx::query(
            "SELECT digest, size, media_type, artifact_type, annotations FROM manifests
             WHERE repository = $1 AND subject = $2 AND ($3 = '' OR artifact_type = $3) AND digest > $4 AND digest <= $5
             ORDER BY digest",
        )
        .bind(repository.as_str())
        .bind(subject)
        .bind(artifact_type)
        .bind(&after)
        .bind(last)
        .fetch_all(&self.0.reads)
        .await?;
        let next = if has_more { Some(rows::id("manifests.digest", last)?) } else { None };
        Ok(ReferrersPage {
            manifests: found.iter().map(descriptor).collect::<Result<_, _>>()?,
            next,
        })
    }
}

/// The last entry of a page that begins with the first of these, and whether more follow; `None` if
/// there are no entries.
fn page_end(sizes: &[(String, i64)]) -> Option<(&str, bool)> {
    let mut bytes = 0;
    let fitting = sizes.iter().take_while(|(_, size)| {
        bytes += ENTRY_BYTES + rows::number(*size);
        bytes <= MAX_PAGE_BYTES
    });
    let count = fitting.count().max(1);
    let (last, _) = sizes.get(count - 1)?;
    Some((last.as_str(), sizes.len() > count))
}

fn descriptor(row: &AnyRow) -> Result<Descriptor, StoreError> {
    let digest = rows::id("manifests.digest", row.try_get("digest")?)?;
    let blob = BlobRef { digest, size: rows::number(row.try_get("size")?) };
    Ok(Descriptor {
        artifact_type: row.try_get("artifact_type")?,
        annotations: rows::from_json("manifests.annotations", row.try_get("annotations")?)?,
        ..Descriptor::new(row.try_get("media_type")?, blob)
    })
}
