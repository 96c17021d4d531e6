//! The run as Prometheus metrics, through the `metrics` crate; an exporter is the business of `main`.

use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::Context as _;
use metrics::{Unit, counter, describe_counter, describe_gauge, describe_histogram, gauge, histogram};

use super::{EpochReport, Observer, RunStart, Summary};

/// Sets the metrics `popgym_learner_...` after every epoch.
#[derive(Default)]
pub struct Prometheus {
    /// The run directory.
    dir: PathBuf,
    /// What run it is.
    labels: Vec<(&'static str, String)>,
    /// Steps and episodes of the run so far.
    env_steps: u64,
    episodes: u64,
}

impl Prometheus {
    /// The observer; it records wherever the `metrics` crate's recorder is at the time.
    pub fn new() -> Self {
        Self::default()
    }

    /// Tells the recorder the meaning and unit of each metric; once, after the recorder is installed.
    pub fn describe() {
        describe_gauge!("popgym_learner_run_info", "What is trained, in labels; always 1.");
        describe_gauge!("popgym_learner_target_steps", Unit::Count, "Environment steps after which the run stops.");
        describe_gauge!("popgym_learner_complete", "1 when the run has come to its end, else 0.");
        describe_counter!("popgym_learner_epochs_total", Unit::Count, "Epochs completed, this session.");
        describe_counter!("popgym_learner_passes_total", Unit::Count, "Passes over a batch, this session.");
        describe_counter!(
            "popgym_learner_nonfinite_updates_total",
            Unit::Count,
            "Updates that diverged; the run ends with the first."
        );
        describe_counter!(
            "popgym_learner_checkpoint_failures_total",
            Unit::Count,
            "Checkpoints that could not be written."
        );
        describe_gauge!(
            "popgym_learner_checkpoint_timestamp_seconds",
            Unit::Seconds,
            "When the last checkpoint was written, or, before the first, this session began; since 1970."
        );
        describe_gauge!("popgym_learner_disk_free_bytes", Unit::Bytes, "Free space where the run directory is.");
        describe_gauge!("popgym_learner_weights_version", Unit::Count, "Epochs of training in the newest weights.");
        describe_counter!(
            "popgym_learner_env_steps_total",
            Unit::Count,
            "Steps of the epochs completed, this session."
        );
        describe_gauge!(
            "popgym_learner_run_steps",
            Unit::Count,
            "Environment steps of the run, earlier sessions included."
        );
        describe_counter!(
            "popgym_learner_episodes_total",
            Unit::Count,
            "Episodes of the epochs completed, this session."
        );
        describe_counter!("popgym_learner_surplus_steps_total", Unit::Count, "Steps sampled and thrown away.");
        describe_gauge!(
            "popgym_learner_return_mean",
            "Mean return of the last epoch's episodes, or of the last 100 if it has fewer."
        );
        describe_gauge!("popgym_learner_return_min", "Smallest return of the last epoch.");
        describe_gauge!("popgym_learner_return_max", "Largest return of the last epoch.");
        describe_gauge!("popgym_learner_return_mmer", "Largest mean return of an epoch so far.");
        describe_gauge!("popgym_learner_episode_length_mean", Unit::Count, "Mean steps of the last epoch's episodes.");
        describe_gauge!("popgym_learner_policy_loss", "Clipped surrogate loss.");
        describe_gauge!("popgym_learner_value_loss", "Clamped squared error of the critic.");
        describe_gauge!("popgym_learner_kl_nats", "KL(old policy || new policy) per step.");
        describe_gauge!("popgym_learner_kl_coef", "Coefficient of the KL term.");
        describe_gauge!("popgym_learner_entropy_nats", "Entropy of the policy per step.");
        describe_gauge!("popgym_learner_explained_variance_ratio", "Variance of returns that the critic explains.");
        describe_gauge!("popgym_learner_grad_norm", "Norm of the gradient before clipping.");
        describe_gauge!("popgym_learner_learning_rate", "Learning rate.");
        describe_gauge!("popgym_learner_valid_ratio", "Steps the memory needed to compute, of those it computed.");
        describe_gauge!("popgym_learner_steps_per_second", "Environment steps per second of the last epoch.");
        describe_gauge!("popgym_learner_wall_seconds", Unit::Seconds, "Age of the run, earlier sessions included.");
        let seconds = |name, meaning| describe_histogram!(name, Unit::Seconds, meaning);
        seconds("popgym_learner_collect_seconds", "From the opening of an epoch's sampling to its completion.");
        describe_gauge!(
            "popgym_learner_activity_seconds_total",
            Unit::Seconds,
            "Seconds of the learner's thread by activity: waiting (for episodes), batching, learning, broadcasting, \
             reporting, checkpointing."
        );
        describe_gauge!(
            "popgym_learner_log_prob_difference",
            "Largest difference of log-probabilities between actors and learner; not small: a wrong actor build."
        );
    }
}

impl Observer for Prometheus {
    fn run_start(&mut self, start: &RunStart) -> anyhow::Result<()> {
        self.dir.clone_from(&start.dir);
        (self.env_steps, self.episodes) = (start.env_steps, start.episodes);
        checkpointed();
        counter!("popgym_learner_nonfinite_updates_total").increment(0);
        counter!("popgym_learner_checkpoint_failures_total").increment(0);
        self.labels = vec![
            ("env", start.env.clone()),
            ("memory", start.memory.clone()),
            ("preset", start.preset.clone()),
            ("seed", start.seed.to_string()),
        ];
        gauge!("popgym_learner_run_info", &self.labels).set(1.0);
        // With labels of its own: it is asked for when its program is gone, and another run may be at its address.
        gauge!("popgym_learner_complete", &self.labels).set(0.0);
        gauge!("popgym_learner_target_steps").set(start.total_steps as f64);
        counter!("popgym_learner_epochs_total").increment(0);
        counter!("popgym_learner_env_steps_total").increment(0);
        counter!("popgym_learner_episodes_total").increment(0);
        gauge!("popgym_learner_weights_version").set(start.epoch as f64);
        gauge!("popgym_learner_run_steps").set(start.env_steps as f64);
        if let Some(mmer) = start.mmer {
            gauge!("popgym_learner_return_mmer").set(mmer);
        }
        Ok(())
    }

    fn epoch(&mut self, EpochReport { metrics, timing }: &EpochReport) -> anyhow::Result<()> {
        // Not the run's totals: one that goes on from a checkpoint falls back, and would count twice what it does again.
        counter!("popgym_learner_epochs_total").increment(1);
        gauge!("popgym_learner_weights_version").set((metrics.epoch + 1) as f64);
        counter!("popgym_learner_env_steps_total").increment(metrics.env_steps - self.env_steps);
        counter!("popgym_learner_episodes_total").increment(metrics.episodes - self.episodes);
        (self.env_steps, self.episodes) = (metrics.env_steps, metrics.episodes);
        gauge!("popgym_learner_run_steps").set(metrics.env_steps as f64);
        counter!("popgym_learner_surplus_steps_total").increment(timing.surplus_steps);
        gauge!("popgym_learner_return_mean").set(metrics.mean_return);
        gauge!("popgym_learner_return_min").set(metrics.min_return);
        gauge!("popgym_learner_return_max").set(metrics.max_return);
        gauge!("popgym_learner_return_mmer").set(metrics.mmer);
        gauge!("popgym_learner_episode_length_mean").set(metrics.mean_length);
        gauge!("popgym_learner_policy_loss").set(metrics.policy_loss);
        gauge!("popgym_learner_value_loss").set(metrics.value_loss);
        gauge!("popgym_learner_kl_nats").set(metrics.kl);
        gauge!("popgym_learner_kl_coef").set(metrics.kl_coef);
        gauge!("popgym_learner_entropy_nats").set(metrics.entropy);
        gauge!("popgym_learner_explained_variance_ratio").set(metrics.explained_variance);
        gauge!("popgym_learner_grad_norm").set(metrics.grad_norm);
        gauge!("popgym_learner_learning_rate").set(metrics.learning_rate);
        gauge!("popgym_learner_valid_ratio").set(metrics.valid_fraction);
        gauge!("popgym_learner_steps_per_second").set(timing.steps_per_second);
        gauge!("popgym_learner_wall_seconds").set(timing.wall_seconds);
        histogram!("popgym_learner_collect_seconds").record(timing.collect_seconds);
        gauge!("popgym_learner_log_prob_difference").set(timing.log_prob_difference);
        let disk = rustix::fs::statvfs(&self.dir).with_context(|| format!("the disk of {}", self.dir.display()))?;
        gauge!("popgym_learner_disk_free_bytes").set(disk.f_bavail as f64 * disk.f_frsize as f64);
        Ok(())
    }

    fn checkpoint(&mut self, _epoch: u64, _path: &Path) -> anyhow::Result<()> {
        checkpointed();
        Ok(())
    }

    fn run_end(&mut self, summary: &Summary) -> anyhow::Result<()> {
        gauge!("popgym_learner_complete", &self.labels).set(f64::from(u8::from(summary.is_complete())));
        Ok(())
    }
}

fn checkpointed() {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    gauge!("popgym_learner_checkpoint_timestamp_seconds").set(now.as_secs_f64());
}

#[cfg(test)]
mod tests {
    use metrics_exporter_prometheus::PrometheusBuilder;

    use super::super::samples::{report, start, summary};
    use super::*;

    /// What a scrape returns after a resumed run's epochs 3 and 4.
    fn scrape() -> String {
        let recorder = PrometheusBuilder::new().build_recorder();
        metrics::with_local_recorder(&recorder, || {
            Prometheus::describe();
            let mut observer = Prometheus::new();
            observer.run_start(&start(Path::new("/"), 3)).unwrap();
            observer.epoch(&report(3)).unwrap();
            observer.epoch(&report(4)).unwrap();
            observer.run_end(&summary(5)).unwrap();
        });
        recorder.handle().render()
    }

    #[test]
    fn values() {
        let text = scrape();
        for line in [
            "popgym_learner_run_info{env=\"RepeatPreviousEasy\",memory=\"GRU\",preset=\"paper\",seed=\"0\"} 1",
            "# TYPE popgym_learner_env_steps_total counter",
            "popgym_learner_env_steps_total 2000",
            "popgym_learner_run_steps 5000",
            "popgym_learner_complete{env=\"RepeatPreviousEasy\",memory=\"GRU\",preset=\"paper\",seed=\"0\"} 1",
            "popgym_learner_epochs_total 2",
            "popgym_learner_weights_version 5",
            "popgym_learner_episodes_total 20",
            "popgym_learner_surplus_steps_total 80",
            "popgym_learner_return_mean 0.5",
            "popgym_learner_return_mmer 0.5",
            "popgym_learner_return_min -0.25",
            "popgym_learner_return_max 1.25",
            "popgym_learner_policy_loss 0.01",
            "popgym_learner_steps_per_second 500",
            "popgym_learner_collect_seconds_sum 3",
        ] {
            assert!(text.lines().any(|candidate| candidate == line), "no line `{line}` in\n{text}");
        }
    }

    #[test]
    fn every_metric_is_described() {
        let text = scrape();
        let words = |prefix: &str| -> Vec<String> {
            let lines = text.lines().filter_map(|line| line.strip_prefix(prefix));
            let mut names: Vec<_> = lines.map(|line| line.split(' ').next().unwrap().to_owned()).collect();
            names.sort();
            names
        };
        assert_eq!(words("# HELP "), words("# TYPE "));
        assert_eq!(words("# TYPE ").len(), 31);
    }
}
