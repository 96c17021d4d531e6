//! One run directory, read.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail, ensure};
use popgym_envs::{Difficulty, Entry, Registry};
use popgym_models::memory;
use serde::Deserialize;
use toml::Table;

use super::blocks::mmer_65k;
use super::changes::{changes, cut_after};
use crate::config::read_table;
use crate::observer::{EpochMetrics, MetricsCsv, Summary, SummaryJson, TimingCsv};
use crate::run_dir::RunDir;

/// What a run was to learn, and with which hyper-parameters: figures of different ones are never mixed.
#[derive(Clone, Debug)]
pub struct Task {
    /// Place of the environment among all that are known.
    pub order: usize,
    /// Short name of the environment.
    pub env: String,
    /// Without the difficulty.
    pub game: String,
    /// As the paper's tables call it, if they have this task.
    pub paper_game: Option<String>,
    /// What kind of environment it is.
    pub group: String,
    /// Its difficulty, if it has several.
    pub difficulty: Option<Difficulty>,
    /// Smallest and largest possible return.
    pub return_range: (f64, f64),
    /// The runs' preset, and what was changed of it: `quick` or `quick, clip 0.4`.
    pub preset: String,
    /// The number of steps after which episodes are cut, if that is before their own end: then it is not the benchmark's
    /// task, and the paper has no figure of it.
    pub cut_after: Option<i64>,
}

impl Task {
    /// By what tasks are sorted and told apart.
    pub fn key(&self) -> (usize, &str) {
        (self.order, &self.preset)
    }

    /// `value` as a share of the return range: 0 the smallest possible return, 1 the largest.
    pub fn standardised(&self, value: f64) -> f64 {
        let (low, high) = self.return_range;
        (value - low) / (high - low)
    }

    fn new(order: usize, entry: &Entry, preset: String, cut_after: Option<i64>) -> Self {
        let level = entry.difficulty.map_or_else(String::new, |level| level.to_string());
        let game = |name: &str| name.strip_suffix(&level).unwrap_or(name).to_owned();
        Self {
            order,
            env: entry.name.clone(),
            game: game(&entry.name),
            paper_game: entry.paper_name.as_deref().filter(|_| cut_after.is_none()).map(game),
            group: entry.group.clone(),
            difficulty: entry.difficulty,
            return_range: entry.spec.return_range,
            preset,
            cut_after,
        }
    }
}

/// What a report needs to know of a run.
#[derive(Clone, Debug)]
pub struct Run {
    /// Its directory.
    pub dir: PathBuf,
    /// Environment and preset.
    pub task: Task,
    /// Name of the memory.
    pub memory: String,
    /// Its name in the paper's tables, or its own.
    pub paper_memory: String,
    /// Seed.
    pub seed: u64,
    /// Steps after which it stops.
    pub budget: u64,
    /// MMER at which it stops earlier.
    pub stop_at_mmer: Option<f64>,
    /// Environment steps done.
    pub steps: u64,
    /// Epochs done.
    pub epochs: u64,
    /// Maximum over epochs of the mean return.
    pub mmer: f64,
    /// Maximum over complete blocks of 65,536 steps; none if there is no such block.
    pub mmer_65k: Option<f64>,
    /// Mean return of the last epoch.
    pub last: f64,
    /// Wall-clock seconds, where they are known.
    pub wall_seconds: Option<f64>,
    /// What stopped it: `steps` or `mmer`; none of a run that is not complete.
    pub stopped_by: Option<String>,
    /// The largest mean so far after each epoch: environment steps and value.
    pub curve: Vec<(u64, f64)>,
    /// The whole configuration.
    pub config: Table,
}

/// The keys of `config.toml` that a report needs. Others may come and go between versions.
#[derive(Deserialize)]
struct Keys {
    env: String,
    #[serde(default = "partial")]
    observability: String,
    preset: String,
    seed: u64,
    steps: u64,
    stop_at_mmer: Option<f64>,
    memory: MemoryKeys,
}

#[derive(Deserialize)]
struct MemoryKeys {
    name: String,
}

fn partial() -> String {
    "partial".to_owned()
}

impl Run {
    /// Reads the run in `dir`.
    ///
    /// # Errors
    /// Why the run cannot be reported: a file is missing, damaged or of another format; no epoch was completed; the
    /// environment is not known here, or was not played as the benchmark's task.
    pub fn read(dir: &Path, envs: &Registry, memories: &memory::Registry) -> anyhow::Result<Self> {
        let config = read_table(&RunDir::config_path(dir))?;
        let keys: Keys = config.clone().try_into().map_err(|error: toml::de::Error| {
            anyhow::anyhow!("config.toml is not that of a run: {}", error.message())
        })?;
        let observability = &keys.observability;
        let benchmark = ["partial", "full-in-info"].contains(&observability.as_str());
        ensure!(benchmark, "its observability is `{observability}`, which is not the benchmark's task");
        let entry = envs.get(&keys.env)?;
        let order = envs.iter().position(|other| other.id() == entry.id()).unwrap_or(usize::MAX);
        let rows = rows(dir)?;
        let Some(end) = rows.last() else { bail!("no epoch has been completed yet") };
        let mmer = rows.iter().map(|row| row.mean_return).filter(|value| value.is_finite()).reduce(f64::max);
        let summary = summary(dir).filter(|summary| summary.env_steps == end.env_steps);
        let seconds =
            || TimingCsv::read(dir).ok()?.last().map(|row| row.wall_seconds).filter(|seconds| seconds.is_finite());
        // A budget may have been raised after the summary was written.
        let far_enough =
            end.env_steps >= keys.steps || keys.stop_at_mmer.zip(mmer).is_some_and(|(target, mmer)| mmer >= target);
        let reason = summary.as_ref().map(|summary| summary.stopped_by.clone());
        let preset = std::iter::once(keys.preset).chain(changes(&config, entry, envs, memories));
        let preset = preset.collect::<Vec<_>>().join(", ");
        Ok(Self {
            dir: dir.to_owned(),
            task: Task::new(order, entry, preset, cut_after(&config, entry)),
            paper_memory: memories.get(&keys.memory.name).map_or(keys.memory.name.clone(), |m| m.paper_name.to_owned()),
            memory: keys.memory.name,
            seed: keys.seed,
            budget: keys.steps,
            stop_at_mmer: keys.stop_at_mmer,
            steps: end.env_steps,
            epochs: rows.len() as u64,
            mmer: mmer.context("no epoch's mean return in metrics.csv is a finite number")?,
            mmer_65k: mmer_65k(&rows),
            last: end.mean_return,
            wall_seconds: summary.map(|summary| summary.wall_seconds).or_else(seconds),
            stopped_by: reason.filter(|reason| reason != "interrupt" && far_enough),
            curve: cumulative_maximum(&rows),
            config,
        })
    }

    /// Whether it reached its end.
    pub fn complete(&self) -> bool {
        self.stopped_by.is_some()
    }

    /// Whether it ended before its budget because its MMER was high enough.
    pub fn stopped_early(&self) -> bool {
        self.stopped_by.as_deref() == Some("mmer") && self.steps < self.budget
    }
}

/// The rows of `metrics.csv`, which must be those of consecutive epochs from the first on.
///
/// # Errors
/// If they are not, or the file is missing, damaged or of another format.
pub fn rows(dir: &Path) -> anyhow::Result<Vec<EpochMetrics>> {
    let path = dir.join(MetricsCsv::FILE);
    if !path.exists() {
        bail!("{} is missing", MetricsCsv::FILE);
    }
    let head = fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let head = head.split(|byte| *byte == b'\n').next().unwrap_or_default();
    if let Some(difference) = other_columns(String::from_utf8_lossy(head).trim()) {
        bail!("{} is of another version of the format: {difference}", MetricsCsv::FILE);
    }
    let rows = MetricsCsv::read(dir)?;
    let follows = |pair: &[EpochMetrics]| pair[0].env_steps < pair[1].env_steps && pair[0].episodes <= pair[1].episodes;
    let numbered = rows.iter().enumerate().all(|(i, row)| row.epoch == i as u64);
    ensure!(
        numbered && rows.windows(2).all(follows),
        "{}: its rows are not those of consecutive epochs",
        path.display()
    );
    Ok(rows)
}

/// In what the header of a `metrics.csv` is not that of this version, if it is not. An empty file has none yet.
fn other_columns(header: &str) -> Option<String> {
    if header.is_empty() || header == MetricsCsv::HEADER {
        return None;
    }
    let (found, expected): (Vec<&str>, Vec<&str>) =
        (header.split(',').collect(), MetricsCsv::HEADER.split(',').collect());
    let beyond = |a: &[&str], b: &[&str]| -> Vec<String> {
        a.iter().filter(|name| !b.contains(name)).map(|name| format!("`{name}`")).collect()
    };
    let (missing, unknown) = (beyond(&expected, &found), beyond(&found, &expected));
    let mut parts = Vec::new();
    if !missing.is_empty() {
        parts.push(format!("it lacks the columns {}", missing.join(", ")));
    }
    if !unknown.is_empty() {
        parts.push(format!("it has the unknown columns {}", unknown.join(", ")));
    }
    Some(if parts.is_empty() { "its columns are in another order".to_owned() } else { parts.join(" and ") })
}

fn summary(dir: &Path) -> Option<Summary> {
    serde_json::from_slice(&fs::read(dir.join(SummaryJson::FILE)).ok()?).ok()
}

fn cumulative_maximum(rows: &[EpochMetrics]) -> Vec<(u64, f64)> {
    let mut most = f64::NEG_INFINITY;
    let points = rows.iter().map(|row| {
        most = most.max(row.mean_return);
        (row.env_steps, most)
    });
    points.filter(|(_, value)| value.is_finite()).collect()
}

#[cfg(test)]
mod tests {
    use super::super::samples::{RunFiles, read};
    use super::*;

    #[test]
    fn a_complete_run() {
        let dir = tempfile::tempdir().unwrap();
        let files = RunFiles { budget: Some(100_000), ..RunFiles::default() };
        files.write(dir.path(), &[(50_000, 200, 0.25), (50_000, 200, 0.75), (20_000, 200, 0.5)]);
        let run = read(dir.path()).unwrap();
        assert_eq!((run.task.env.as_str(), run.task.game.as_str()), ("RepeatFirstEasy", "RepeatFirst"));
        assert_eq!((run.task.group.as_str(), run.task.difficulty), ("diagnostic", Some(Difficulty::Easy)));
        assert_eq!((run.memory.as_str(), run.paper_memory.as_str()), ("gru", "GRU"));
        assert_eq!((run.steps, run.epochs, run.budget), (120_000, 3, 100_000));
        assert_eq!((run.mmer, run.mmer_65k, run.last), (0.75, Some(0.5), 0.5));
        assert_eq!(run.curve, [(50_000, 0.25), (100_000, 0.75), (120_000, 0.75)]);
        assert!(run.complete() && !run.stopped_early());
        assert!((run.task.standardised(0.5) - 0.75).abs() < 1e-12);
    }

    #[test]
    fn an_interrupted_run_and_one_that_goes_on() {
        let dir = tempfile::tempdir().unwrap();
        let epochs = [(50_000, 200, 0.25)];
        let budget = Some(1_000_000);
        RunFiles { stopped_by: "interrupt", budget, ..RunFiles::default() }.write(dir.path(), &epochs);
        assert!(!read(dir.path()).unwrap().complete());
        RunFiles { stopped_by: "mmer", budget, ..RunFiles::default() }.write(dir.path(), &epochs);
        let run = read(dir.path()).unwrap();
        assert!(run.complete() && run.stopped_early() && run.mmer_65k.is_none());
        // Resumed since: the summary is of an earlier end.
        let summary = fs::read(dir.path().join("summary.json")).unwrap();
        RunFiles::default().write(dir.path(), &[(50_000, 200, 0.25), (10, 1, 0.5)]);
        fs::write(dir.path().join("summary.json"), summary).unwrap();
        assert!(!read(dir.path()).unwrap().complete());
    }

    #[test]
    fn a_raised_budget_reopens_a_run() {
        let dir = tempfile::tempdir().unwrap();
        RunFiles::default().write(dir.path(), &[(50_000, 200, 0.25)]);
        assert!(read(dir.path()).unwrap().complete());
        // Resumed with more steps, and killed before the next epoch.
        let path = dir.path().join("config.toml");
        let config = fs::read_to_string(&path).unwrap();
        fs::write(&path, config.replace("steps = 50000", "steps = 50001")).unwrap();
        let run = read(dir.path()).unwrap();
        assert_eq!((run.complete(), run.stopped_by, run.budget), (false, None, 50_001));
    }

    #[test]
    fn another_configuration_is_another_task() {
        let dir = tempfile::tempdir().unwrap();
        RunFiles { keys: "ppo.clip = 0.4\nmax_episode_steps = 20\n", ..RunFiles::default() }
            .write(dir.path(), &[(50_000, 200, 0.25)]);
        let task = read(dir.path()).unwrap().task;
        assert_eq!(task.preset, "quick, max_episode_steps 20, clip 0.4");
        assert_eq!((task.cut_after, task.paper_game), (Some(20), None));
    }

    #[test]
    fn what_cannot_be_read_says_why() {
        let dir = tempfile::tempdir().unwrap();
        let reason = || format!("{:#}", read(dir.path()).unwrap_err());
        RunFiles::default().write(dir.path(), &[(50_000, 200, 0.25)]);
        let metrics = dir.path().join("metrics.csv");
        let whole = fs::read_to_string(&metrics).unwrap();
        fs::write(&metrics, whole.replace(",epoch_return", "").replace(",kl,", ",kl_mean,")).unwrap();
        assert_eq!(
            reason(),
            "metrics.csv is of another version of the format: it lacks the columns `epoch_return`, `kl` and it has the \
             unknown columns `kl_mean`"
        );
        fs::write(&metrics, format!("{whole}{}", whole.lines().last().unwrap().replace('.', "x"))).unwrap();
        assert!(read(dir.path()).is_ok(), "a torn last line is no row");
        fs::write(&metrics, format!("{whole}1,x\n")).unwrap();
        assert!(reason().contains("metrics.csv, line 3"));
        fs::write(&metrics, whole.replace("\n0,", "\n1,")).unwrap();
        assert!(reason().contains("not those of consecutive epochs"));
        for (text, expected) in [("", "no epoch"), (MetricsCsv::HEADER, "no epoch")] {
            fs::write(&metrics, text).unwrap();
            assert!(reason().contains(expected), "{}", reason());
        }
        fs::remove_file(&metrics).unwrap();
        assert_eq!(reason(), "metrics.csv is missing");
        RunFiles { env: "NoSuchEnv", ..RunFiles::default() }.write(dir.path(), &[(1, 1, 0.0)]);
        assert!(reason().contains("unknown environment `NoSuchEnv`"));
        RunFiles { observability: "full", ..RunFiles::default() }.write(dir.path(), &[(1, 1, 0.0)]);
        assert!(reason().contains("observability is `full`"));
        fs::write(dir.path().join("config.toml"), "name = 1\n").unwrap();
        assert!(reason().contains("config.toml is not that of a run"));
    }
}
