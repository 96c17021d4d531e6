//! What a run tells the world: one trait, [`Observer`], feeds files, progress bar, TensorBoard and Prometheus.
//!
//! A user's own `main` can add observers of its own; they are called on the learner's thread, in order, between epochs.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

mod chart;
mod csv_table;
mod curve;
mod metrics_csv;
mod progress;
mod prometheus;
#[cfg(test)]
pub(crate) mod samples;
mod summary_json;
mod tensorboard;
mod timing_csv;

pub use curve::Curve;
pub use metrics_csv::MetricsCsv;
pub use progress::Progress;
pub(crate) use progress::clock;
pub use prometheus::Prometheus;
pub use summary_json::SummaryJson;
pub use tensorboard::TensorBoard;
pub use timing_csv::TimingCsv;

/// What is known when a run starts or is resumed.
#[derive(Clone, Debug)]
pub struct RunStart {
    /// The run directory.
    pub dir: PathBuf,
    /// Canonical id of the environment.
    pub env: String,
    /// Name of the memory.
    pub memory: String,
    /// Name of the preset.
    pub preset: String,
    /// Seed of the run.
    pub seed: u64,
    /// Epochs already completed: 0 for a new run, more for a resumed one.
    pub epoch: u64,
    /// Environment steps already completed.
    pub env_steps: u64,
    /// Episodes already completed.
    pub episodes: u64,
    /// Steps after which the run stops.
    pub total_steps: u64,
    /// Largest epoch mean return so far (resumed runs).
    pub mmer: Option<f64>,
}

/// One epoch: only quantities that do not depend on timing. A row of `metrics.csv`, in this order.
///
/// Losses are means over all minibatches of all passes, weighted by steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpochMetrics {
    /// Epochs completed before this one.
    pub epoch: u64,
    /// Environment steps of all epochs up to and with this one.
    pub env_steps: u64,
    /// Episodes of all epochs up to and with this one.
    pub episodes: u64,
    /// Mean return of the epoch's episodes, or of the last 100 episodes if the epoch has fewer.
    pub mean_return: f64,
    /// Mean return of the epoch's episodes, however few.
    pub epoch_return: f64,
    /// Smallest return in the epoch.
    pub min_return: f64,
    /// Largest return in the epoch.
    pub max_return: f64,
    /// Mean number of steps of the epoch's episodes.
    pub mean_length: f64,
    /// Maximum of `mean_return` over the epochs so far (the paper's headline number).
    pub mmer: f64,
    /// Clipped surrogate loss.
    pub policy_loss: f64,
    /// Clamped squared error of the critic.
    pub value_loss: f64,
    /// KL(old policy || new policy), nats a step.
    pub kl: f64,
    /// Coefficient of the KL term during the epoch.
    pub kl_coef: f64,
    /// Entropy of the policy, nats a step.
    pub entropy: f64,
    /// 1 - Var(return target - value) / Var(return target), of the values before the update.
    pub explained_variance: f64,
    /// Norm of the gradient before clipping.
    pub grad_norm: f64,
    /// Learning rate of the epoch.
    pub learning_rate: f64,
    /// Steps that the memory needed to compute, divided by the steps that it computed (1: no padding).
    pub valid_fraction: f64,
}

/// Where an epoch's time went. A row of `timing.csv`, in this order. Wall-clock, so never part of `metrics.csv`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpochTiming {
    /// Epochs completed before this one.
    pub epoch: u64,
    /// Environment steps of all epochs up to and with this one.
    pub env_steps: u64,
    /// Wall-clock seconds since the run began, earlier sessions of a resumed run included.
    pub wall_seconds: f64,
    /// Environment steps of this epoch per second of this epoch.
    pub steps_per_second: f64,
    /// Seconds between the opening of the epoch's sampling and its completion.
    pub collect_seconds: f64,
    /// Seconds in which the learner had nothing to do but wait for episodes.
    pub wait_seconds: f64,
    /// Seconds of the update: old log-probs, advantages, passes.
    pub learn_seconds: f64,
    /// Seconds of everything else: encoding weights, checkpoint, files.
    pub other_seconds: f64,
    /// Steps sampled beyond the epoch's prefix, and thrown away.
    pub surplus_steps: u64,
    /// Largest |log-prob of the actor - log-prob of the learner|: not small means a wrong actor build.
    pub log_prob_difference: f64,
    /// Actors connected at the end of the epoch.
    pub actors: u64,
}

/// A completed epoch.
#[derive(Clone, Debug)]
pub struct EpochReport {
    /// What does not depend on timing.
    pub metrics: EpochMetrics,
    /// What does.
    pub timing: EpochTiming,
}

/// The end of a run, as written to `summary.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Canonical id of the environment.
    pub env: String,
    /// Name of the memory.
    pub memory: String,
    /// Name of the preset.
    pub preset: String,
    /// Seed of the run.
    pub seed: u64,
    /// Lag of the sampling weights, in epochs.
    pub lag: u32,
    /// Epochs completed.
    pub epochs: u64,
    /// Environment steps completed.
    pub env_steps: u64,
    /// Episodes completed.
    pub episodes: u64,
    /// Maximum over epochs of the mean episodic return; none if no epoch was completed.
    pub mmer: Option<f64>,
    /// Mean return of the last epoch.
    pub final_mean_return: Option<f64>,
    /// Wall-clock seconds, earlier sessions of a resumed run included.
    pub wall_seconds: f64,
    /// `steps`, `mmer` or `interrupt`.
    pub stopped_by: String,
}

impl Summary {
    /// Whether the run has come to its own end.
    pub fn is_complete(&self) -> bool {
        self.stopped_by != "interrupt"
    }
}

/// Receives a run's events. Every method has an empty default.
///
/// An error is reported and the run goes on: what was computed is never lost for a full disk.
pub trait Observer {
    /// A run starts or is resumed.
    ///
    /// # Errors
    /// Whatever keeps the observer from its work.
    fn run_start(&mut self, _start: &RunStart) -> anyhow::Result<()> {
        Ok(())
    }

    /// An epoch is complete.
    ///
    /// # Errors
    /// Whatever keeps the observer from its work.
    fn epoch(&mut self, _report: &EpochReport) -> anyhow::Result<()> {
        Ok(())
    }

    /// The state after `epoch` completed epochs has been saved to `path`.
    ///
    /// # Errors
    /// Whatever keeps the observer from its work.
    fn checkpoint(&mut self, _epoch: u64, _path: &Path) -> anyhow::Result<()> {
        Ok(())
    }

    /// The run has ended.
    ///
    /// # Errors
    /// Whatever keeps the observer from its work.
    fn run_end(&mut self, _summary: &Summary) -> anyhow::Result<()> {
        Ok(())
    }
}
