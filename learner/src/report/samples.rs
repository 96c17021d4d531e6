//! Directories of invented runs, for the tests of this module.

use std::fs;
use std::path::{Path, PathBuf};

use popgym_envs::Registry;
use popgym_models::memory;

use super::cell::{Cell, cells};
use super::collect::{Collection, collect};
use super::run::Run;
use crate::observer::{EpochReport, MetricsCsv, Observer, Summary, TimingCsv, samples};

/// What an invented run says of itself.
pub(crate) struct RunFiles<'a> {
    pub(crate) env: &'a str,
    pub(crate) observability: &'a str,
    pub(crate) memory: &'a str,
    pub(crate) preset: &'a str,
    pub(crate) seed: u64,
    /// None: the steps that it did.
    pub(crate) budget: Option<u64>,
    /// More lines of the configuration.
    pub(crate) keys: &'a str,
    /// Empty: the run was killed.
    pub(crate) stopped_by: &'a str,
}

impl Default for RunFiles<'_> {
    fn default() -> Self {
        Self {
            env: "RepeatFirstEasy",
            observability: "partial",
            memory: "gru",
            preset: "quick",
            seed: 0,
            budget: None,
            keys: "",
            stopped_by: "steps",
        }
    }
}

impl RunFiles<'_> {
    /// Writes the directory of a run with epochs of so many steps, so many episodes, and this mean return; 1000 steps take a
    /// second.
    pub(crate) fn write(&self, dir: &Path, epochs: &[(u64, u64, f64)]) {
        fs::create_dir_all(dir).unwrap();
        let (mut metrics, mut timing) = (MetricsCsv::open(dir, 0).unwrap(), TimingCsv::open(dir, 0).unwrap());
        let (mut env_steps, mut episodes, mut mmer) = (0, 0, f64::NEG_INFINITY);
        for (epoch, (more_steps, more_episodes, value)) in epochs.iter().enumerate() {
            env_steps += more_steps;
            episodes += more_episodes;
            mmer = f64::max(mmer, *value);
            let mut report: EpochReport = samples::report(epoch as u64);
            let row = &mut report.metrics;
            (row.env_steps, row.episodes, row.mmer) = (env_steps, episodes, mmer);
            (row.mean_return, row.epoch_return) = (*value, *value);
            report.timing.env_steps = env_steps;
            report.timing.wall_seconds = env_steps as f64 / 1000.0;
            metrics.epoch(&report).unwrap();
            timing.epoch(&report).unwrap();
        }
        let Self { env, observability, memory, preset, seed, keys, stopped_by, .. } = self;
        let budget = self.budget.unwrap_or(env_steps);
        assert!(*stopped_by != "steps" || env_steps >= budget, "no run ends like that");
        let target = if *stopped_by == "mmer" { format!("stop_at_mmer = {mmer:?}\n") } else { String::new() };
        let config = format!(
            "env = \"{env}\"\nobservability = \"{observability}\"\npreset = \"{preset}\"\nseed = {seed}\n\
             steps = {budget}\n{target}memory.name = \"{memory}\"\n{keys}"
        );
        fs::write(dir.join("config.toml"), config).unwrap();
        let summary = Summary {
            env_steps,
            stopped_by: (*stopped_by).to_owned(),
            wall_seconds: env_steps as f64 / 1000.0,
            ..samples::summary(epochs.len() as u64)
        };
        if !stopped_by.is_empty() {
            fs::write(dir.join("summary.json"), serde_json::to_string(&summary).unwrap()).unwrap();
        }
    }
}

/// The run in `dir`.
pub(crate) fn read(dir: &Path) -> anyhow::Result<Run> {
    Run::read(dir, &Registry::standard(), &memory::Registry::standard())
}

/// The runs below `dirs`.
pub(crate) fn collected(dirs: &[&Path]) -> anyhow::Result<Collection> {
    let dirs: Vec<PathBuf> = dirs.iter().map(|dir| (*dir).to_owned()).collect();
    collect(&dirs, &Registry::standard(), &memory::Registry::standard())
}

/// The cells of invented runs: environment, memory, and the MMER of each seed over 70,000 steps and 200 episodes.
pub(crate) fn cells_of(runs: &[(&str, &str, &[f64])]) -> Vec<Cell> {
    let root = tempfile::tempdir().unwrap();
    for (i, (env, memory, scores)) in runs.iter().enumerate() {
        for (seed, score) in scores.iter().enumerate() {
            let files = RunFiles { env, memory, seed: seed as u64, ..RunFiles::default() };
            files.write(&root.path().join(format!("{i}-{seed}")), &[(70_000, 200, *score)]);
        }
    }
    let found = collected(&[root.path()]).unwrap();
    assert_eq!(found.notes, []);
    cells(found.runs).unwrap()
}
