//! Draws a plot as inline SVG: a line and a mark for each series, a thin line from the median to
//! the 99th percentile, a cross for failures. Colours come from the page's style sheet; a point's
//! values are in its tooltip.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use crate::results::axis::{Axis, unit_of_setting, written};
use crate::results::run::{Figure, Plot, Point, Unit};

const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 420.0;
const LEFT: f64 = 78.0;
const RIGHT: f64 = 16.0;
const TOP: f64 = 16.0;
const BOTTOM: f64 = 52.0;
/// Half the size of a mark.
const MARK: f64 = 3.6;

/// All points of one series at one position of the horizontal axis.
#[derive(Debug, Default)]
struct PointGroup {
    values: Vec<f64>,
    high: Vec<f64>,
    failures: BTreeMap<String, u64>,
}

/// A plot's frame, ready to place points in.
struct Frame {
    x: Axis,
    y: Axis,
    x_unit: Unit,
    y_unit: Unit,
}

/// The plot as SVG; `None` if the plot has no points. `colours` numbers each series of the whole
/// run.
pub fn svg(plot: &Plot, points: &[Point], colours: &BTreeMap<&str, usize>) -> Option<String> {
    let shown: Vec<&Point> = plot.points(points).collect();
    if shown.is_empty() {
        return None;
    }
    let series = gather(plot, &shown);
    let groups = || series.values().flat_map(BTreeMap::values);
    let quantities = shown.iter().filter_map(|point| point.quantities.get(&plot.y));
    let frame = Frame {
        x: Axis::over(shown.iter().map(|point| point.settings[&plot.x]), plot.x_log),
        y: Axis::over(
            groups().flat_map(|group| group.values.iter().chain(&group.high).copied()),
            plot.y_log,
        )
        .from_zero(),
        x_unit: unit_of_setting(&plot.x),
        y_unit: quantities.map(|quantity| quantity.unit).next().unwrap_or(Unit::Number),
    };
    let mut svg = format!(
        "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{}\">",
        escaped(&plot.title)
    );
    frame.draw_grid(&mut svg, plot);
    for (name, groups) in &series {
        let colour = colours.get(name).copied().unwrap_or(0);
        frame.draw_series(&mut svg, plot, name, colour, groups);
    }
    svg.push_str("</svg>");
    Some(svg)
}

/// Spots by series and by the bits of their position. The bits sort like the positions, which are
/// not negative.
fn gather<'a>(plot: &Plot, shown: &[&'a Point]) -> BTreeMap<&'a str, BTreeMap<u64, PointGroup>> {
    let mut series: BTreeMap<&str, BTreeMap<u64, PointGroup>> = BTreeMap::new();
    for point in shown {
        let place = point.settings[&plot.x].max(0.0).to_bits();
        let group = series.entry(&point.series).or_default().entry(place).or_default();
        if let Some(quantity) = point.quantities.get(&plot.y) {
            group.values.push(quantity.figure(plot.figure));
            if plot.figure == Figure::Median {
                group.high.push(quantity.p99);
            }
        }
        for (text, count) in &point.failures {
            *group.failures.entry(text.clone()).or_default() += count;
        }
    }
    series
}

/// The mean, so that good points do not hide a bad one.
fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

impl Frame {
    fn x_of(&self, value: f64) -> f64 {
        LEFT + self.x.place(value) * (WIDTH - LEFT - RIGHT)
    }

    fn y_of(&self, value: f64) -> f64 {
        HEIGHT - BOTTOM - self.y.place(value) * (HEIGHT - TOP - BOTTOM)
    }

    fn draw_grid(&self, svg: &mut String, plot: &Plot) {
        let (right, bottom) = (WIDTH - RIGHT, HEIGHT - BOTTOM);
        for tick in self.x.ticks() {
            let x = self.x_of(tick);
            let text = escaped(&written(tick, self.x_unit));
            let _ = write!(svg, "<path class=\"grid\" d=\"M{x:.1} {TOP}V{bottom}\"/>");
            let _ = write!(
                svg,
                "<text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{text}</text>",
                bottom + 18.0
            );
        }
        for tick in self.y.ticks() {
            let y = self.y_of(tick);
            let text = escaped(&written(tick, self.y_unit));
            let _ = write!(svg, "<path class=\"grid\" d=\"M{LEFT} {y:.1}H{right}\"/>");
            let at = LEFT - 8.0;
            let below = y + 4.0;
            let _ = write!(
                svg,
                "<text x=\"{at:.1}\" y=\"{below:.1}\" text-anchor=\"end\">{text}</text>"
            );
        }
        let (width, height) = (right - LEFT, bottom - TOP);
        let _ = write!(
            svg,
            "<rect class=\"frame\" x=\"{LEFT}\" y=\"{TOP}\" width=\"{width}\" height=\"{height}\"/>"
        );
        let (x, y) = (LEFT + width / 2.0, TOP + height / 2.0);
        let (x_label, y_label) = (escaped(&plot.x_label), escaped(&plot.y_label));
        let _ = write!(
            svg,
            "<text class=\"label\" x=\"{x}\" y=\"{}\" text-anchor=\"middle\">{x_label}</text>",
            HEIGHT - 10.0
        );
        let turned = format!("transform=\"translate(14 {y}) rotate(-90)\" text-anchor=\"middle\"");
        let _ = write!(svg, "<text class=\"label\" {turned}>{y_label}</text>");
    }

    fn draw_series(
        &self,
        svg: &mut String,
        plot: &Plot,
        name: &str,
        colour: usize,
        groups: &BTreeMap<u64, PointGroup>,
    ) {
        let place = |bits: &u64| f64::from_bits(*bits);
        let mut line = String::new();
        for (bits, group) in groups {
            if let Some(value) = mean(&group.values) {
                let letter = if line.is_empty() { 'M' } else { 'L' };
                let _ =
                    write!(line, "{letter}{:.1} {:.1}", self.x_of(place(bits)), self.y_of(value));
            }
        }
        let _ = write!(svg, "<g class=\"s{colour}\"><path class=\"line\" d=\"{line}\"/>");
        for (bits, group) in groups {
            let x = self.x_of(place(bits));
            let value = mean(&group.values);
            let y = value.map_or(TOP + MARK * 2.0, |value| self.y_of(value));
            if let (Some(_), Some(high)) = (value, mean(&group.high)) {
                let _ = write!(
                    svg,
                    "<path class=\"high\" d=\"M{x:.1} {y:.1}V{:.1}\"/>",
                    self.y_of(high)
                );
            }
            let at = written(place(bits), self.x_unit);
            let mut says = format!("{name}, {} {at}: ", plot.x_label);
            says.push_str(
                &value.map_or("no value".to_owned(), |value| written(value, self.y_unit)),
            );
            for (text, count) in &group.failures {
                let _ = write!(says, "\n{count} failed: {text}");
            }
            let _ = write!(svg, "<g><title>{}</title>", escaped(&says));
            if value.is_some() {
                svg.push_str(&mark(colour, x, y));
            }
            if !group.failures.is_empty() {
                svg.push_str(&cross(x, y));
            }
            svg.push_str("</g>");
        }
        svg.push_str("</g>");
    }
}

/// The mark of a series, so that series differ by more than colour.
pub fn mark(colour: usize, x: f64, y: f64) -> String {
    let m = MARK;
    let w = MARK * 1.3;
    match colour % 4 {
        0 => format!("<circle class=\"mark\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{m}\"/>"),
        1 => format!(
            "<rect class=\"mark\" x=\"{:.1}\" y=\"{:.1}\" width=\"{s}\" height=\"{s}\"/>",
            x - m,
            y - m,
            s = m * 2.0
        ),
        2 => format!(
            "<path class=\"mark\" d=\"M{x:.1} {:.1}l{w:.1} {h:.1}h-{:.1}z\"/>",
            y - w,
            w * 2.0,
            h = w * 2.0
        ),
        _ => format!(
            "<path class=\"mark\" d=\"M{x:.1} {:.1}l{w:.1} {w:.1}l-{w:.1} {w:.1}l-{w:.1} -{w:.1}z\"/>",
            y - w
        ),
    }
}

fn cross(x: f64, y: f64) -> String {
    let m = MARK * 1.7;
    let w = MARK * 3.4;
    format!(
        "<path class=\"cross\" d=\"M{:.1} {:.1}l{w:.1} {w:.1}m0 -{w:.1}l-{w:.1} {w:.1}\"/>",
        x - m,
        y - m
    )
}

/// Escapes text for HTML and its attributes.
pub fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::run::tests::sample;

    #[test]
    fn plot_shows_every_series_and_crosses_for_failures() {
        let run = sample();
        let colours = [("push-pull", 0), ("direct-push", 1)].into();
        let svg = svg(&run.plots[0], &run.points, &colours).expect("points");
        assert!(svg.starts_with("<svg") && svg.ends_with("</svg>"));
        assert_eq!(
            (svg.matches("class=\"line\"").count(), svg.matches("class=\"cross\"").count()),
            (2, 1)
        );
        assert_eq!(svg.matches("class=\"mark\"").count(), 3);
        assert!(svg.contains("1 failed: the client, &quot;r1&quot; &lt;lost&gt; it"), "{svg}");
        assert!(svg.contains("Delay &amp; robots") && !svg.contains("NaN"), "{svg}");
        assert!(is_balanced(&svg), "{svg}");
    }

    /// Every element that is opened is closed.
    fn is_balanced(svg: &str) -> bool {
        let opened =
            svg.matches('<').count() - svg.matches("</").count() - svg.matches("/>").count();
        opened == svg.matches("</").count()
    }

    #[test]
    fn plot_without_points_is_left_out() {
        let run = sample();
        let plot = Plot { series: vec!["nobody".to_owned()], ..run.plots[0].clone() };
        assert!(svg(&plot, &run.points, &BTreeMap::new()).is_none());
    }
}
