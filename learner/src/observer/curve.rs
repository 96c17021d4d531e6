//! The learning curve as a picture: `curve.svg` and `curve.png`.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::{EpochMetrics, EpochReport, MetricsCsv, Observer, RunStart, Summary, chart};
use crate::files::replace;

/// Pictures are at least this far apart, but for the last.
const INTERVAL: Duration = Duration::from_mins(1);

/// Draws mean, minimum and maximum of the returns of each epoch over environment steps, and the largest mean so far
/// (MMER), to `curve.svg` and `curve.png` in the run directory: at checkpoints, once a minute at most, and at the end.
#[derive(Default)]
pub struct Curve {
    dir: PathBuf,
    title: String,
    rows: Vec<EpochMetrics>,
    drawn: Option<Instant>,
}

impl Curve {
    /// The observer. For a resumed run it takes the earlier epochs from `metrics.csv`.
    pub fn new() -> Self {
        Self::default()
    }

    fn draw(&mut self) -> anyhow::Result<()> {
        if self.rows.is_empty() {
            return Ok(());
        }
        self.drawn = Some(Instant::now());
        let svg = chart::svg(&self.title, &self.rows)?;
        replace(&self.dir.join("curve.svg"), |partial| Ok(fs::write(partial, svg)?))?;
        replace(&self.dir.join("curve.png"), |partial| chart::png(partial, &self.title, &self.rows))
    }
}

impl Observer for Curve {
    fn run_start(&mut self, start: &RunStart) -> anyhow::Result<()> {
        self.dir.clone_from(&start.dir);
        self.title = format!("{} on {}, seed {}", start.memory, start.env, start.seed);
        if start.epoch > 0 {
            self.rows = MetricsCsv::read(&start.dir)?;
            self.rows.retain(|row| row.epoch < start.epoch);
        }
        Ok(())
    }

    fn epoch(&mut self, report: &EpochReport) -> anyhow::Result<()> {
        self.rows.push(report.metrics.clone());
        Ok(())
    }

    fn checkpoint(&mut self, _epoch: u64, _path: &Path) -> anyhow::Result<()> {
        if self.drawn.is_some_and(|drawn| drawn.elapsed() < INTERVAL) { Ok(()) } else { self.draw() }
    }

    fn run_end(&mut self, _summary: &Summary) -> anyhow::Result<()> {
        self.draw()
    }
}

#[cfg(test)]
mod tests {
    use super::super::samples::{report, start, summary};
    use super::*;

    #[test]
    fn resumed_run_shows_earlier_epochs() {
        let dir = tempfile::tempdir().unwrap();
        let mut csv = MetricsCsv::open(dir.path(), 0).unwrap();
        (0..4).for_each(|epoch| csv.epoch(&report(epoch)).unwrap());
        let mut curve = Curve::new();
        curve.run_start(&start(dir.path(), 3)).unwrap();
        curve.epoch(&report(3)).unwrap();
        let epochs: Vec<_> = curve.rows.iter().map(|row| row.epoch).collect();
        assert_eq!(epochs, [0, 1, 2, 3]);
        curve.run_end(&summary(4)).unwrap();
        let svg = fs::read_to_string(dir.path().join("curve.svg")).unwrap();
        assert!(svg.contains("GRU on RepeatPreviousEasy, seed 0"));
        let png = fs::read(dir.path().join("curve.png")).unwrap();
        // Signature, header of 13 bytes, width 1200, height 720.
        assert_eq!(png[..24], *b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\x04\xb0\0\0\x02\xd0");
        assert_eq!(png[png.len() - 8..png.len() - 4], *b"IEND");
        assert_eq!(fs::read_dir(&dir).unwrap().count(), 3, "partial files are left behind");
    }

    #[test]
    fn drawn_at_checkpoints_but_not_at_each() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("curve.svg");
        let mut curve = Curve::new();
        curve.run_start(&start(dir.path(), 0)).unwrap();
        curve.checkpoint(0, dir.path()).unwrap();
        assert!(!path.exists(), "a picture of nothing");
        curve.epoch(&report(0)).unwrap();
        curve.checkpoint(1, dir.path()).unwrap();
        fs::remove_file(&path).unwrap();
        curve.checkpoint(1, dir.path()).unwrap();
        assert!(!path.exists());
        curve.drawn = Instant::now().checked_sub(INTERVAL);
        curve.checkpoint(1, dir.path()).unwrap();
        assert!(path.exists());
        fs::remove_file(&path).unwrap();
        curve.run_end(&summary(1)).unwrap();
        assert!(path.exists());
    }

    #[test]
    fn errors_name_the_file() {
        let dir = tempfile::tempdir().unwrap();
        let mut curve = Curve::new();
        assert!(format!("{:#}", curve.run_start(&start(dir.path(), 3)).unwrap_err()).contains("metrics.csv"));
        curve.run_start(&start(&dir.path().join("gone"), 0)).unwrap();
        curve.epoch(&report(0)).unwrap();
        assert!(format!("{:#}", curve.run_end(&summary(1)).unwrap_err()).contains("curve.svg"));
    }
}
