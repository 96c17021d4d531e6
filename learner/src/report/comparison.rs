//! Some runs, one over the other: curves by environment steps and by wall time, and how long each took to some levels.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use maud::{PreEscaped, html};
use toml::{Table, Value};

use super::labels::labels;
use super::page::{document, table};
use super::run::rows;
use super::text;
use crate::chart::{FINE, Lines, PALETTE, Series, svg};
use crate::config::read_table;
use crate::observer::TimingCsv;
use crate::run_dir::RunDir;

/// Width of the picture in its own units.
const WIDTH: u32 = 340;

/// Where between the lowest first mean return and the best MMER the levels are.
const LEVELS: [f64; 4] = [0.25, 0.5, 0.75, 0.95];

/// A run's mean returns.
#[derive(Clone, Debug)]
pub struct Curve {
    /// What tells the run from the others.
    pub label: String,
    /// The environment's id.
    pub env: String,
    /// Environment steps done.
    pub steps: u64,
    /// Maximum over epochs of the mean return.
    pub mmer: f64,
    /// Environment steps and mean return of each epoch.
    pub by_steps: Vec<(f64, f64)>,
    /// Wall-clock seconds and mean return of each epoch of which the time is known.
    pub by_seconds: Vec<(f64, f64)>,
}

/// Several runs.
#[derive(Debug)]
pub struct Comparison {
    /// In the order in which they were named.
    pub curves: Vec<Curve>,
    /// What must be known to read the figures.
    pub notes: Vec<String>,
}

impl Comparison {
    /// Reads the runs in `dirs`.
    ///
    /// # Errors
    /// The directory that holds no run that can be read, and why.
    pub fn read(dirs: &[PathBuf]) -> anyhow::Result<Self> {
        let mut configs = Vec::new();
        for dir in dirs {
            anyhow::ensure!(RunDir::holds_run(dir), "{} holds no run (no config.toml)", dir.display());
            configs.push(read_table(&RunDir::config_path(dir))?);
        }
        let names: Vec<String> = dirs.iter().map(|dir| dir.display().to_string()).collect();
        let labels = labels(&configs.iter().collect::<Vec<_>>(), &names);
        let (mut curves, mut notes) = (Vec::new(), Vec::new());
        for ((dir, config), label) in dirs.iter().zip(&configs).zip(labels) {
            curves.push(curve(dir, config, label, &mut notes)?);
        }
        let mut comparison = Self { curves, notes };
        let envs = comparison.envs();
        if envs.len() > 1 {
            let envs = envs.into_iter().collect::<Vec<_>>().join(", ");
            let note = format!("the runs are of different environments, whose returns are not the same thing: {envs}");
            comparison.notes.push(note);
        }
        Ok(comparison)
    }

    /// The environments' ids, each once.
    fn envs(&self) -> BTreeSet<&str> {
        self.curves.iter().map(|curve| curve.env.as_str()).collect()
    }

    /// Levels of the mean return, rounded; the best run reaches them all. None for runs of different environments.
    pub fn levels(&self) -> Vec<f64> {
        if self.envs().len() > 1 {
            return Vec::new();
        }
        let first = self.curves.iter().filter_map(|curve| curve.by_steps.first()).map(|point| point.1);
        let (low, high) = (
            first.fold(f64::INFINITY, f64::min),
            self.curves.iter().map(|curve| curve.mmer).fold(f64::NEG_INFINITY, f64::max),
        );
        if high <= low || !(high - low).is_finite() {
            return Vec::new();
        }
        // Two digits of the range, rounded down: what was reached stays reached.
        let unit = 10_f64.powf((high - low).log10().floor() - 1.0);
        let mut levels: Vec<f64> =
            LEVELS.iter().map(|part| ((low + part * (high - low)) / unit).floor() * unit).collect();
        levels.dedup();
        levels
    }

    /// The table: label, steps, MMER, and seconds to each level; with its head.
    pub fn table(&self) -> Vec<Vec<String>> {
        let levels = self.levels();
        let mut head = ["run", "steps", "MMER", "seconds"].map(str::to_owned).to_vec();
        head.extend(levels.iter().map(|level| format!("s to {}", crate::chart::short(*level))));
        let seconds = |value: Option<f64>| value.map_or_else(|| text::NONE.to_owned(), |value| format!("{value:.1}"));
        let row = |curve: &Curve| {
            let end = curve.by_seconds.last().map(|point| point.0);
            let mut row =
                vec![curve.label.clone(), text::steps(curve.steps), text::number(Some(curve.mmer)), seconds(end)];
            row.extend(levels.iter().map(|level| seconds(reached(&curve.by_seconds, *level))));
            row
        };
        std::iter::once(head).chain(self.curves.iter().map(row)).collect()
    }

    /// The picture: by environment steps above, by wall time below.
    ///
    /// # Errors
    /// None that can be caused from outside.
    pub fn svg(&self) -> anyhow::Result<String> {
        let by_steps = self.lines("By environment steps", "environment steps", |curve| &curve.by_steps);
        let by_seconds = self.lines("By wall time", "seconds", |curve| &curve.by_seconds);
        svg((WIDTH, by_steps.height() + by_seconds.height()), FINE, |area| {
            let (above, below) = area.split_vertically(FINE.px(by_steps.height()));
            by_steps.draw(&above, FINE)?;
            by_seconds.draw(&below, FINE)
        })
    }

    /// The page: picture and table.
    ///
    /// # Errors
    /// None that can be caused from outside.
    pub fn html(&self) -> anyhow::Result<String> {
        let rows = self.table();
        let head: Vec<&str> = rows[0].iter().map(String::as_str).collect();
        let body = html! {
            h1 { (self.curves.len()) " runs compared" }
            ul { @for note in &self.notes { li { (note) } } }
            figure.single { (PreEscaped(self.svg()?)) figcaption { "Mean return of each epoch." } }
            h2 { "Figures" }
            p { "Seconds of wall time; a dash where a level was not reached or the time is not known." }
            (table(&head, &rows[1..]))
        };
        Ok(document("Runs compared", &body).into_string())
    }

    fn lines(&self, title: &str, x_desc: &str, points: fn(&Curve) -> &Vec<(f64, f64)>) -> Lines {
        let series = self.curves.iter().enumerate().map(|(i, curve)| Series {
            name: curve.label.clone(),
            colour: PALETTE[i % PALETTE.len()],
            points: points(curve).clone(),
            band: Vec::new(),
        });
        let (title, y_desc) = (title.to_owned(), "mean return".to_owned());
        Lines { title, x_desc: x_desc.to_owned(), y_desc, series: series.collect(), columns: 1 }
    }
}

fn curve(dir: &Path, config: &Table, label: String, notes: &mut Vec<String>) -> anyhow::Result<Curve> {
    let rows = rows(dir).map_err(|error| error.context(dir.display().to_string()))?;
    let finite = || rows.iter().filter(|row| row.mean_return.is_finite());
    let Some(mmer) = finite().map(|row| row.mean_return).reduce(f64::max) else {
        anyhow::bail!("{}: no epoch has been completed yet", dir.display());
    };
    let timing = TimingCsv::read(dir).unwrap_or_else(|error| {
        notes.push(format!("{}: no wall time: {error:#}", dir.display()));
        Vec::new()
    });
    // A damaged file may hold any number.
    let times = || timing.iter().filter(|row| row.wall_seconds.is_finite() && row.wall_seconds >= 0.0);
    let seconds = |epoch: u64| times().find(|row| row.epoch == epoch).map(|row| row.wall_seconds);
    Ok(Curve {
        label,
        env: config.get("env").and_then(Value::as_str).unwrap_or_default().to_owned(),
        steps: rows.last().map_or(0, |row| row.env_steps),
        mmer,
        by_steps: finite().map(|row| (row.env_steps as f64, row.mean_return)).collect(),
        by_seconds: finite().filter_map(|row| Some((seconds(row.epoch)?, row.mean_return))).collect(),
    })
}

/// Where a curve first reaches `level`.
fn reached(curve: &[(f64, f64)], level: f64) -> Option<f64> {
    curve.iter().find(|point| point.1 >= level).map(|point| point.0)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::super::samples::RunFiles;
    use super::*;

    #[test]
    fn levels_and_the_seconds_to_them() {
        let root = tempfile::tempdir().unwrap();
        let dirs = [root.path().join("a"), root.path().join("b")];
        let epochs = [(1000, 10, -0.5), (1000, 10, 0.0), (1000, 10, 0.5)];
        let budget = Some(2000);
        RunFiles { budget, ..RunFiles::default() }.write(&dirs[0], &epochs);
        RunFiles { memory: "mlp", budget, ..RunFiles::default() }.write(&dirs[1], &epochs[..2]);
        let found = Comparison::read(&dirs).unwrap();
        assert!(found.notes.is_empty(), "{:?}", found.notes);
        // From -0.5 to 0.5, in tenths, rounded down: -0.25, 0, 0.25, 0.45.
        let levels: Vec<String> = found.levels().iter().map(|level| format!("{level:.2}")).collect();
        assert_eq!(levels, ["-0.30", "0.00", "0.20", "0.40"]);
        assert_eq!(
            text::aligned(&found.table()),
            "run  steps   MMER  seconds  s to -0.3  s to 0  s to 0.2  s to 0.4\n\
             gru     3k  0.500      3.0        2.0     2.0       3.0       3.0\n\
             mlp     2k  0.000      2.0        2.0     2.0         –         –"
        );
        let html = found.html().unwrap();
        assert!(html.contains("By wall time") && html.contains("By environment steps"));
    }

    #[test]
    fn times_that_are_no_numbers_are_left_out() {
        let root = tempfile::tempdir().unwrap();
        let dirs = [root.path().join("a"), root.path().join("b")];
        for (seed, dir) in dirs.iter().enumerate() {
            RunFiles { seed: seed as u64, ..RunFiles::default() }.write(dir, &[(1000, 10, 0.0), (1000, 10, 0.5)]);
        }
        let path = dirs[0].join("timing.csv");
        let text = fs::read_to_string(&path).unwrap();
        // The second epoch ends after two seconds.
        let damaged = text.replace(",2000,2.0,", ",2000,inf,");
        assert_ne!(damaged, text);
        fs::write(&path, damaged).unwrap();
        let found = Comparison::read(&dirs).unwrap();
        assert_eq!(found.curves[0].by_seconds, [(1.0, 0.0)]);
        assert_eq!(found.curves[1].by_seconds, [(1.0, 0.0), (2.0, 0.5)]);
        assert!(found.svg().is_ok());
    }

    #[test]
    fn other_environments_and_missing_times_are_said() {
        let root = tempfile::tempdir().unwrap();
        let dirs = [root.path().join("a"), root.path().join("b")];
        let budget = Some(1000);
        RunFiles { budget, ..RunFiles::default() }.write(&dirs[0], &[(1000, 10, 0.0), (1000, 10, 0.5)]);
        RunFiles { env: "BattleshipEasy", budget, ..RunFiles::default() }.write(&dirs[1], &[(1000, 10, 0.5)]);
        fs::remove_file(dirs[0].join("timing.csv")).unwrap();
        let found = Comparison::read(&dirs).unwrap();
        assert!(found.notes[0].contains("no wall time") && found.notes[1].contains("different environments"));
        assert!(found.levels().is_empty());
        let labels: Vec<&str> = found.curves.iter().map(|curve| curve.label.as_str()).collect();
        assert_eq!(labels, ["RepeatFirstEasy", "BattleshipEasy"]);
        assert!(found.svg().is_ok());
        fs::remove_file(dirs[0].join("config.toml")).unwrap();
        assert!(format!("{:#}", Comparison::read(&dirs).unwrap_err()).contains("holds no run"));
    }
}
