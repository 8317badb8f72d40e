//! Sizes as people read them, in the units of the server's configuration: a KB is 1,024 bytes.

/// A number of bytes: `9.7 MB`.
pub fn format_bytes(bytes: u64) -> String {
    let units = [(1u64 << 30, "GB"), (1 << 20, "MB"), (1 << 10, "KB")];
    let Some((one, unit)) = units.into_iter().find(|(one, _)| bytes >= *one) else {
        return format!("{bytes} B");
    };
    let tenths = (u128::from(bytes) * 10 + u128::from(one) / 2) / u128::from(one);
    if tenths.is_multiple_of(10) || tenths >= 1000 {
        format!("{} {unit}", tenths / 10)
    } else {
        format!("{}.{} {unit}", tenths / 10, tenths % 10)
    }
}

/// A number of bytes per second: `9.7 MB/s`.
pub fn format_rate(bytes_per_s: u64) -> String {
    format!("{}/s", format_bytes(bytes_per_s))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_shown_in_the_units_of_the_configuration() {
        let shown = [0, 1023, 1024, 1536, 256 << 10, 10_171_187, (100 << 20) + 52_429, u64::MAX]
            .map(format_bytes);
        assert_eq!(
            shown,
            ["0 B", "1023 B", "1 KB", "1.5 KB", "256 KB", "9.7 MB", "100 MB", "17179869184 GB"]
        );
    }
}
