//! The files of a run: CSV, HTML, and JSON, which can be read back. It never changes a point.

use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::time::Instant;

use crate::results::report;
use crate::results::run::Run;

impl Run {
    /// Writes the three files, creating the directory if needed; returns their paths. `began` is
    /// the start of the run.
    pub fn write(&mut self, dir: &Path, began: Instant) -> io::Result<Vec<PathBuf>> {
        self.wall_s = (began.elapsed().as_secs_f64() * 1000.0).round() / 1000.0;
        std::fs::create_dir_all(dir)?;
        let files = [
            ("json", format!("{:#}\n", serde_json::to_value(&*self).map_err(io::Error::other)?)),
            ("csv", self.csv()),
            ("html", report::page(self)),
        ];
        let write = |(extension, text): (&str, String)| {
            let path = dir.join(format!("{}.{extension}", self.scenario));
            std::fs::File::create(&path)?.write_all(text.as_bytes())?;
            Ok(path)
        };
        files.into_iter().map(write).collect()
    }

    /// Reads a run back.
    pub fn read(path: &Path) -> io::Result<Self> {
        serde_json::from_slice(&std::fs::read(path)?)
            .map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))
    }

    /// A row for each quantity of each point; a point without quantities has one row, with its
    /// failures.
    pub fn csv(&self) -> String {
        let settings: std::collections::BTreeSet<&String> =
            self.points.iter().flat_map(|p| p.settings.keys()).collect();
        let names = settings.iter().map(|name| cell(name));
        let head = std::iter::once("series".to_owned()).chain(names);
        let rest = ["quantity", "unit", "count", "min", "median", "p95", "p99", "max", "failed"]
            .map(str::to_owned);
        let mut text = head.chain(rest).collect::<Vec<_>>().join(",") + "\n";
        for point in &self.points {
            let mut begin = vec![cell(&point.series)];
            begin.extend(
                settings
                    .iter()
                    .map(|name| point.settings.get(*name).map_or(String::new(), f64::to_string)),
            );
            let mut row = |cells: [String; 8]| {
                let all: Vec<String> = begin
                    .iter()
                    .cloned()
                    .chain(cells)
                    .chain([point.failed().to_string()])
                    .collect();
                text.push_str(&(all.join(",") + "\n"));
            };
            for (name, q) in &point.quantities {
                let figures = [q.min, q.median, q.p95, q.p99, q.max].map(|value| value.to_string());
                let [min, median, p95, p99, max] = figures;
                row([
                    cell(name),
                    cell(q.unit.symbol()),
                    q.count.to_string(),
                    min,
                    median,
                    p95,
                    p99,
                    max,
                ]);
            }
            if point.quantities.is_empty() {
                row(Default::default());
            }
        }
        text
    }
}

/// A CSV value, quoted if necessary.
fn cell(text: &str) -> String {
    let is_plain = !text.contains([',', '"', '\n', '\r']);
    if is_plain { text.to_owned() } else { format!("\"{}\"", text.replace('"', "\"\"")) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::run::tests::sample;

    #[test]
    fn run_is_written_and_read_back_with_its_failures() {
        let dir = tempfile::tempdir().expect("a directory");
        let mut run = sample();
        let files = run.write(&dir.path().join("new"), Instant::now()).expect("written");
        assert_eq!(files.len(), 3);
        let read = Run::read(&files[0]).expect("read");
        assert_eq!(read.points, run.points);
        assert_eq!((read.failed(), &read.plots), (1, &run.plots));
        let csv = std::fs::read_to_string(&files[1]).expect("read");
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(
            lines[0],
            "series,payload_bytes,robots,quantity,unit,count,min,median,p95,p99,max,failed"
        );
        assert_eq!(lines[1], "push-pull,1000,1,delay,ms,3,10,20,30,30,30,0");
        assert_eq!(lines[4], "direct-push,4000,4,,,,,,,,,1");
        assert_eq!(cell("a \"b\", c"), "\"a \"\"b\"\", c\"");
    }
}
