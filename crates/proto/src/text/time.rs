//! Civil time, in UTC, of milliseconds since the Unix epoch, and back; and lengths of time as
//! people say and write them. It never reads a clock.

use std::time::Duration;

use jiff::SignedDuration;
use jiff::civil::{DateTime, date};

const EPOCH: DateTime = date(1970, 1, 1).at(0, 0, 0, 0);

/// Milliseconds of a duration; the largest number if they are more.
pub fn millis(duration: Duration) -> u64 {
    u64::try_from(duration.as_millis()).unwrap_or(u64::MAX)
}

/// `2026-01-31T08:05:09.123Z`; always 24 bytes. Times after the year 9999 are shown as its end.
pub fn timestamp(ms: u64) -> String {
    let since = SignedDuration::from_millis(i64::try_from(ms).unwrap_or(i64::MAX));
    format!("{:.3}Z", EPOCH.saturating_add(since))
}

/// Parses the text written by [`timestamp`]; `None` for any other text.
pub fn parse_timestamp(text: &str) -> Option<u64> {
    let time: DateTime = text.strip_suffix('Z')?.parse().ok()?;
    let ms = u64::try_from(time.duration_since(EPOCH).as_millis()).ok()?;
    (timestamp(ms) == text).then_some(ms)
}

/// A time in its two largest units.
pub fn span(time: Duration) -> String {
    match time.as_secs() {
        seconds @ ..60 => format!("{seconds} s"),
        seconds @ 60..3600 => format!("{} min {} s", seconds / 60, seconds % 60),
        seconds @ 3600..86_400 => format!("{} h {} min", seconds / 3600, seconds / 60 % 60),
        seconds => format!("{} d {} h", seconds / 86_400, seconds / 3600 % 24),
    }
}

/// Parses a whole number with a unit of time: `ms`, `s`, `m`, `h` or `d`. A number alone means
/// seconds.
pub fn parse_duration(text: &str) -> Option<Duration> {
    let split = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let number: u64 = text[..split].parse().ok()?;
    let unit_ms = match &text[split..] {
        "ms" => 1,
        "s" | "" => 1_000,
        "m" => 60_000,
        "h" => 3_600_000,
        "d" => 86_400_000,
        _ => return None,
    };
    number.checked_mul(unit_ms).map(Duration::from_millis)
}

/// Parses a duration that must be positive and at most ten years.
pub fn parse_lifetime(text: &str) -> Result<Duration, String> {
    const MAX: Duration = Duration::from_secs(3650 * 24 * 60 * 60);
    match parse_duration(text) {
        Some(time) if !time.is_zero() && time <= MAX => Ok(time),
        _ => Err(format!(
            "{text:?} is not a time: expected for example 90s, 15m, 12h or 7d, at most 3650d"
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The last millisecond of the year 9999.
    const LAST_MS: u64 = 253_402_300_799_999;

    #[test]
    fn times_are_civil_dates_both_ways() {
        for (ms, text) in [
            (0, "1970-01-01T00:00:00.000Z"),
            (951_782_400_007, "2000-02-29T00:00:00.007Z"),
            (1_704_067_199_999, "2023-12-31T23:59:59.999Z"),
            (LAST_MS, "9999-12-31T23:59:59.999Z"),
        ] {
            assert_eq!(timestamp(ms), text);
            assert_eq!(parse_timestamp(text), Some(ms));
        }
        assert_eq!(timestamp(u64::MAX), timestamp(LAST_MS));
        for day in 0..80_000u64 {
            assert_eq!(parse_timestamp(&timestamp(day * 86_400_000)), Some(day * 86_400_000));
        }
    }

    #[test]
    fn invalid_times_are_refused() {
        for text in [
            "",
            "2026-11-21 10:00:00.123Z",
            "2026-13-21T10:00:00.123Z",
            "2026-02-29T10:00:00.123Z",
            "2026-11-21T10:00:60.000Z",
            "2026-11-21T10:00:00.1234Z",
            "2026-11-21T10:00:00.12éZ",
            "1969-12-31T23:59:59.999Z",
        ] {
            assert_eq!(parse_timestamp(text), None, "{text}");
        }
    }

    #[test]
    fn times_have_two_units() {
        let spans = [5, 61, 7260, 90_000].map(|seconds| span(Duration::from_secs(seconds)));
        assert_eq!(spans, ["5 s", "1 min 1 s", "2 h 1 min", "1 d 1 h"]);
    }

    #[test]
    fn durations_have_units() {
        for (text, ms) in
            [("250ms", 250), ("90s", 90_000), ("90", 90_000), ("2m", 120_000), ("1h", 3_600_000)]
        {
            assert_eq!(parse_duration(text), Some(Duration::from_millis(ms)), "{text}");
        }
        for bad in ["", "s", "-1s", "1.5h", "1w", "99999999999999999999s", "18446744073709551615d"]
        {
            assert_eq!(parse_duration(bad), None, "{bad}");
        }
    }
}
