//! A run as one self-contained HTML file: no network, no script, light or dark by the reader's
//! system.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use crate::results::axis::{unit_of_setting, written};
use crate::results::plot::{escaped, mark, svg};
use crate::results::run::{Point, Run};

const STYLE: &str = include_str!("report.css");

pub fn page(run: &Run) -> String {
    let mut names: Vec<&str> = Vec::new();
    for point in &run.points {
        if !names.contains(&point.series.as_str()) {
            names.push(&point.series);
        }
    }
    let colours: BTreeMap<&str, usize> =
        names.iter().enumerate().map(|(number, name)| (*name, number % 8)).collect();
    let title = escaped(&format!("taskbench {}", run.scenario));
    let mut page = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>{title}</title>\
         <meta name=\"viewport\" content=\"width=device-width\"><style>{STYLE}</style></head><body><h1>{title}</h1>"
    );
    page.push_str(&facts(run));
    for note in &run.notes {
        let _ = write!(page, "<p>{}</p>", escaped(note));
    }
    for plot in &run.plots {
        let Some(drawing) = svg(plot, &run.points, &colours) else { continue };
        let shown: Vec<&str> =
            plot.points(&run.points).map(|point| point.series.as_str()).collect();
        let _ = write!(
            page,
            "<figure><figcaption>{}</figcaption>{drawing}<p class=\"legend\">",
            escaped(&plot.title)
        );
        for name in names.iter().filter(|name| shown.contains(name)) {
            let colour = colours[name];
            let sign = mark(colours[name], 7.0, 7.0);
            let _ = write!(
                page,
                "<span class=\"s{colour}\"><svg viewBox=\"0 0 14 14\">{sign}</svg>{}</span>",
                escaped(name)
            );
        }
        page.push_str("</p></figure>");
    }
    page.push_str(&failures(&run.points));
    page.push_str(&table(&run.points));
    page.push_str("</body></html>\n");
    page
}

fn facts(run: &Run) -> String {
    let machine = &run.machine;
    let memory = written(machine.memory_bytes as f64, crate::results::run::Unit::Bytes);
    let versions: Vec<String> =
        run.versions.iter().map(|(name, version)| format!("{name} {version}")).collect();
    let rows = [
        ("began", run.began.clone()),
        ("took", format!("{:.0} s", run.wall_s)),
        ("command", format!("taskbench {}", run.command_line.join(" "))),
        ("commit", run.commit.clone()),
        ("versions", versions.join(", ")),
        ("machine", format!("{}, {} cores, {memory}", machine.cpu, machine.cores)),
        ("system", format!("{}, {}", machine.system, machine.kernel)),
        ("seed", run.seed.to_string()),
    ];
    let row =
        |(name, value): (&str, String)| format!("<dt>{name}</dt><dd>{}</dd>", escaped(&value));
    format!("<dl>{}</dl>", rows.map(row).concat())
}

fn failures(points: &[Point]) -> String {
    let mut text = String::new();
    for point in points {
        for (failure, count) in &point.failures {
            let where_ = escaped(&format!("{}, {}", point.series, settings(point)));
            let _ = write!(text, "<li>{where_}: {count} × {}</li>", escaped(failure));
        }
    }
    if text.is_empty() {
        "<p>Nothing failed.</p>".to_owned()
    } else {
        format!("<h2>Failures</h2><ul>{text}</ul>")
    }
}

fn settings(point: &Point) -> String {
    let one = |(name, value): (&String, &f64)| {
        format!("{name} {}", written(*value, unit_of_setting(name)))
    };
    point.settings.iter().map(one).collect::<Vec<_>>().join(", ")
}

fn table(points: &[Point]) -> String {
    let mut table = "<h2>All points</h2><table><thead><tr><th>series<th>settings<th>quantity<th>n<th>min<th>median<th>\
                     p95<th>p99<th>max<th>failed</tr></thead><tbody>"
        .to_owned();
    for point in points {
        let begin = format!("<tr><td>{}<td>{}", escaped(&point.series), escaped(&settings(point)));
        for (name, quantity) in &point.quantities {
            let figures = [quantity.min, quantity.median, quantity.p95, quantity.p99, quantity.max];
            let figures =
                figures.map(|value| format!("<td>{}", written(value, quantity.unit))).concat();
            let _ = write!(
                table,
                "{begin}<td>{}<td>{}{figures}<td>{}</tr>",
                escaped(name),
                quantity.count,
                point.failed()
            );
        }
        if point.quantities.is_empty() {
            let _ = write!(table, "{begin}<td colspan=\"7\"><td>{}</tr>", point.failed());
        }
    }
    table + "</tbody></table>"
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::run::tests::sample;

    #[test]
    fn report_page_is_self_contained_and_shows_failures() {
        let page = page(&sample());
        for outside in ["<script", "http:", "https:", "url(", "@import", "<link"] {
            assert!(!page.contains(outside), "{outside}");
        }
        for inside in
            ["<figure>", "prefers-color-scheme", "a &lt;note&gt;", "1 × the client", "seed", "abc"]
        {
            assert!(page.contains(inside), "{inside}");
        }
    }
}
