//! An axis of a plot: maps values to positions, places ticks, and formats numbers.

use crate::results::run::Unit;

/// Ticks a linear axis has, about.
const LINEAR_TICKS: f64 = 6.0;
/// A logarithmic axis that spans fewer decades has ticks at 2 and 5 as well.
const FEW_DECADES: f64 = 3.0;

/// From the least value to the most, logarithmic or not.
#[derive(Debug, Clone, Copy)]
pub struct Axis {
    least: f64,
    most: f64,
    is_log: bool,
}

impl Axis {
    /// An axis that covers all `values`; a logarithmic axis leaves out values that are not above
    /// zero.
    pub fn over(values: impl IntoIterator<Item = f64>, is_log: bool) -> Self {
        let fits = |value: &f64| value.is_finite() && (!is_log || *value > 0.0);
        let (mut least, mut most) = (f64::INFINITY, f64::NEG_INFINITY);
        for value in values.into_iter().filter(fits) {
            (least, most) = (least.min(value), most.max(value));
        }
        if least > most {
            (least, most) = (1.0, 10.0);
        }
        if is_log {
            // A little room, so that no point lies on the frame.
            (least, most) = (least / 1.3, most * 1.3);
        } else {
            let room = (most - least).max(most.abs() * 0.1).max(f64::MIN_POSITIVE) * 0.06;
            (least, most) = (least - room, most + room);
        }
        Self { least, most, is_log }
    }

    /// The axis, starting at zero if it is linear.
    pub fn from_zero(self) -> Self {
        Self { least: if self.is_log { self.least } else { self.least.min(0.0) }, ..self }
    }

    /// Position of a value: 0 for the least, 1 for the most.
    pub fn place(&self, value: f64) -> f64 {
        let least = self.scaled(self.least);
        let most = self.scaled(self.most);
        let value = self.scaled(value);
        ((value - least) / (most - least)).clamp(0.0, 1.0)
    }

    /// The values of the axis labels.
    pub fn ticks(&self) -> Vec<f64> {
        let ticks: Vec<f64> = if self.is_log { self.log_ticks() } else { self.linear_ticks() };
        ticks.into_iter().filter(|tick| *tick >= self.least && *tick <= self.most).collect()
    }

    fn scaled(&self, value: f64) -> f64 {
        if self.is_log { value.max(f64::MIN_POSITIVE).log10() } else { value }
    }

    fn log_ticks(&self) -> Vec<f64> {
        let (first, last) = (self.least.log10().floor() as i32, self.most.log10().ceil() as i32);
        let few = self.scaled(self.most) - self.scaled(self.least) < FEW_DECADES;
        let steps: &[f64] = if few { &[1.0, 2.0, 5.0] } else { &[1.0] };
        (first..=last)
            .flat_map(|decade| steps.iter().map(move |step| step * 10_f64.powi(decade)))
            .collect()
    }

    fn linear_ticks(&self) -> Vec<f64> {
        let rough = (self.most - self.least) / LINEAR_TICKS;
        let decade = 10_f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0]
            .into_iter()
            .map(|factor| factor * decade)
            .find(|step| *step >= rough);
        let step = step.unwrap_or(rough);
        let first = (self.least / step).ceil() as i64;
        let last = (self.most / step).floor() as i64;
        (first..=last).map(|number| number as f64 * step).collect()
    }
}

/// A value with its unit, short enough for a tick label.
pub fn written(value: f64, unit: Unit) -> String {
    match unit {
        Unit::Milliseconds if value >= 1000.0 => format!("{} s", rounded(value / 1000.0)),
        Unit::Bytes => in_thousands(value, &["B", "KB", "MB", "GB", "TB"]),
        Unit::BytesPerSecond => in_thousands(value, &["B/s", "KB/s", "MB/s", "GB/s"]),
        Unit::Percent => format!("{} %", rounded(value)),
        Unit::Number => in_thousands(value, &["", "k", "M", "G"]).trim_end().to_owned(),
        _ => format!("{} {}", rounded(value), unit.symbol()),
    }
}

fn in_thousands(value: f64, names: &[&str]) -> String {
    let mut value = value;
    let mut names = names.iter();
    let mut name = names.next().copied().unwrap_or_default();
    // A value that would be printed as 1000 belongs to the next unit.
    while value.abs() >= 999.5 {
        let Some(next) = names.next() else { break };
        (value, name) = (value / 1000.0, next);
    }
    format!("{} {name}", rounded(value))
}

/// Three significant digits, without trailing zeros behind the point.
fn rounded(value: f64) -> String {
    let digits = if value == 0.0 { 0.0 } else { value.abs().log10().floor() };
    let places = (2.0 - digits).clamp(0.0, 9.0) as usize;
    let text = format!("{value:.places$}");
    let trimmed =
        if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    trimmed.to_owned()
}

/// The unit that a setting's name ends with.
pub fn unit_of_setting(name: &str) -> Unit {
    let ends = [
        ("_bytes_per_s", Unit::BytesPerSecond),
        ("_bytes", Unit::Bytes),
        ("_ms", Unit::Milliseconds),
    ];
    let found = ends.into_iter().find(|(end, _)| name.ends_with(end));
    found.map_or(if name.ends_with("_s") { Unit::Seconds } else { Unit::Number }, |(_, unit)| unit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short_and_carry_their_unit() {
        for (value, unit, text) in [
            (9_700_000.0, Unit::Bytes, "9.7 MB"),
            (999_999.0, Unit::Bytes, "1 MB"),
            (1000.0, Unit::Bytes, "1 KB"),
            (0.0, Unit::Bytes, "0 B"),
            (12.345, Unit::Milliseconds, "12.3 ms"),
            (1234.0, Unit::Milliseconds, "1.23 s"),
            (0.00123, Unit::SecondsPerGigabyte, "0.00123 s/GB"),
            (8.0, Unit::Number, "8"),
            (10_000.0, Unit::Number, "10 k"),
            (100.0, Unit::Percent, "100 %"),
        ] {
            assert_eq!(written(value, unit), text);
        }
        assert_eq!(unit_of_setting("payload_bytes"), Unit::Bytes);
        assert_eq!(unit_of_setting("robots"), Unit::Number);
    }

    #[test]
    fn log_axis_has_decades_and_linear_axis_round_steps() {
        let axis = Axis::over([1000.0, 100_000_000.0], true);
        assert_eq!(axis.ticks(), [1e3, 1e4, 1e5, 1e6, 1e7, 1e8]);
        assert!(axis.place(1000.0) < axis.place(10_000.0) && axis.place(0.0) == 0.0);
        assert_eq!(Axis::over([1.0, 8.0], false).ticks(), [2.0, 4.0, 6.0, 8.0]);
        assert_eq!(
            Axis::over([20.0, 100.0], false).from_zero().ticks(),
            [0.0, 20.0, 40.0, 60.0, 80.0, 100.0]
        );
        // Nothing to show is no reason to fail.
        assert!(!Axis::over([], true).ticks().is_empty());
        assert!(Axis::over([5.0, 5.0], false).place(5.0) > 0.0);
    }
}
