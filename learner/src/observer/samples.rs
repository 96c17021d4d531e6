//! Events of an invented run, for the tests of this module.

use std::path::Path;

use super::{EpochMetrics, EpochReport, EpochTiming, RunStart, Summary};

/// A run of 10,000 steps in `dir` that has completed `epoch` epochs.
pub(crate) fn start(dir: &Path, epoch: u64) -> RunStart {
    RunStart {
        dir: dir.to_owned(),
        env: "RepeatPreviousEasy".into(),
        memory: "GRU".into(),
        preset: "paper".into(),
        seed: 0,
        epoch,
        env_steps: 1000 * epoch,
        episodes: 10 * epoch,
        total_steps: 10_000,
        mmer: (epoch > 0).then(|| report(epoch - 1).metrics.mmer),
    }
}

/// Epoch `epoch` of that run: 1000 steps, 10 episodes and 2 seconds; the mean return is a quarter more each epoch.
pub(crate) fn report(epoch: u64) -> EpochReport {
    let mean_return = -0.5 + 0.25 * epoch as f64;
    let env_steps = 1000 * (epoch + 1);
    EpochReport {
        metrics: EpochMetrics {
            epoch,
            env_steps,
            episodes: 10 * (epoch + 1),
            mean_return,
            epoch_return: mean_return + 0.125,
            min_return: mean_return - 0.75,
            max_return: mean_return + 0.75,
            mean_length: 48.0,
            mmer: mean_return,
            policy_loss: 0.01,
            value_loss: 0.5,
            kl: 0.002,
            kl_coef: 0.2,
            entropy: 1.25,
            explained_variance: 0.75,
            grad_norm: 3.5,
            learning_rate: 5e-5,
            valid_fraction: 0.9,
        },
        timing: EpochTiming {
            epoch,
            env_steps,
            wall_seconds: 2.0 * (epoch + 1) as f64,
            steps_per_second: 500.0,
            collect_seconds: 1.5,
            wait_seconds: 0.25,
            learn_seconds: 0.375,
            other_seconds: 0.125,
            surplus_steps: 40,
            log_prob_difference: 1e-6,
            actors: 4,
        },
    }
}

/// The end of that run after `epochs` epochs.
pub(crate) fn summary(epochs: u64) -> Summary {
    let last = epochs.checked_sub(1).map(|epoch| report(epoch).metrics);
    Summary {
        env: "RepeatPreviousEasy".into(),
        memory: "GRU".into(),
        preset: "paper".into(),
        seed: 0,
        lag: 0,
        epochs,
        env_steps: 1000 * epochs,
        episodes: 10 * epochs,
        mmer: last.as_ref().map(|last| last.mmer),
        final_mean_return: last.map(|last| last.mean_return),
        wall_seconds: 2.0 * epochs as f64,
        stopped_by: "steps".into(),
    }
}
