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

/// Parses a number of bytes: digits, with at most three decimals, alone or with `B`, `KB`, `MB` or
/// `GB` in any case, each 1,024 times the previous one. Accepts each text of [`format_bytes`].
pub fn parse_bytes(text: &str) -> Option<u64> {
    let split = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = text.split_at(split);
    let one: u128 = match unit.trim_start().to_ascii_uppercase().as_str() {
        "" | "B" => 1,
        "KB" => 1 << 10,
        "MB" => 1 << 20,
        "GB" => 1 << 30,
        _ => return None,
    };
    let (whole, decimals) = match number.split_once('.') {
        Some((whole, decimals)) if one > 1 && matches!(decimals.len(), 1..=3) => (whole, decimals),
        Some(_) => return None,
        None => (number, ""),
    };
    let thousandths: u64 = format!("{decimals:0<3}").parse().ok()?;
    let bytes = u128::from(whole.parse::<u64>().ok()?) * one + u128::from(thousandths) * one / 1000;
    bytes.try_into().ok()
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

    #[test]
    fn sizes_have_units() {
        for (text, bytes) in [
            ("65536", 65_536),
            ("1 KB", 1024),
            ("256kb", 262_144),
            ("9.7 MB", 10_171_187),
            ("1.125 Gb", (1 << 30) + (1 << 27)),
            ("7 B", 7),
        ] {
            assert_eq!(parse_bytes(text), Some(bytes), "{text}");
        }
        for bad in ["", "KB", "-1 KB", "1.5", "1.5 B", "1. MB", ".5 MB", "1.2.3 MB", "1.2345 MB"] {
            assert_eq!(parse_bytes(bad), None, "{bad}");
        }
        for bad in ["1,5 MB", "1 TB", "20000000000 GB", "1 KB ", "1 kib"] {
            assert_eq!(parse_bytes(bad), None, "{bad}");
        }
    }
}
