//! A run's epochs, one after the other: collect, evaluate, update, broadcast, save, report.
//!
//! Version `v` of the weights is the one after `v` updates. With lag 0 epoch `k` is sampled with version `k`, after its
//! update; with lag 1 with version `k - 1`, while the learner learns from epoch `k - 1`. Nothing here depends on who
//! sampled an episode, or when.

use std::cell::Cell;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context;
use bytes::Bytes;
use metrics::{counter, gauge};
use popgym_envs::space::Space;
use popgym_envs::{Purpose, stream};
use popgym_models::Policy;
use popgym_proto::{Episode, monitor};

use crate::adam::{Adam, AdamOptions, AdamState};
use crate::batch::Batch;
use crate::checkpoint::{self, Checkpoint, Progress};
use crate::config::{Config, LearningRateSchedule};
use crate::fail_point;
use crate::interrupt::Interrupt;
use crate::local_actors::Hopeless;
use crate::observer::{EpochMetrics, EpochReport, EpochTiming, Observer, Summary};
use crate::service::{Service, Target};
use crate::update::{self, Schedule, UpdateError, UpdateMeans};

/// Episodes over which a mean return is taken when an epoch has fewer (RLlib's window, which the paper used).
const RETURN_WINDOW: usize = 100;

/// What a run is made of.
pub struct Trainer<'a> {
    /// The resolved configuration.
    pub config: &'a Config,
    /// The environment's action space.
    pub action: Space,
    /// The policy that learns.
    pub policy: Policy,
    /// A second policy for the weights that sampled the epoch.
    pub behaviour: Policy,
    /// The actors.
    pub service: &'a Service,
    /// Who is told.
    pub observers: Vec<Box<dyn Observer>>,
    /// Where checkpoints go.
    pub checkpoints: PathBuf,
    /// What their manifests say of them ([`crate::manifest::describe`]).
    pub about: serde_json::Value,
    /// Set when the user wants to stop.
    pub interrupt: &'a Interrupt,
    /// Set when local actors cannot work.
    pub hopeless: Hopeless,
}

/// The state of a run while it goes on.
struct State {
    progress: Progress,
    adam: Adam,
    /// What a checkpoint would hold now.
    snapshot: Checkpoint,
    /// Epoch of the last checkpoint written.
    saved_epoch: Option<u64>,
    started: Instant,
    /// Wall-clock seconds of earlier sessions.
    earlier_seconds: f64,
}

/// Where the time of an epoch goes.
struct Laps(Cell<Instant>);

impl Laps {
    fn begin() -> Self {
        Self(Cell::new(Instant::now()))
    }

    /// What went by since the last lap's end went to `activity`.
    fn end(&self, activity: &'static str) {
        let now = Instant::now();
        let seconds = (now - self.0.replace(now)).as_secs_f64();
        gauge!("popgym_learner_activity_seconds_total", "activity" => activity).increment(seconds);
    }
}

impl Trainer<'_> {
    /// Runs epochs until the run's end, an interrupt, or a divergence; leaves a checkpoint in each case.
    ///
    /// # Errors
    /// The update diverged, or the checkpoint cannot be taken up.
    pub fn run(mut self, from: Option<Checkpoint>) -> anyhow::Result<Summary> {
        let mut state = self.start(from)?;
        self.open(&state)?;
        let stopped_by = loop {
            if let Some(reason) = self.reached(&state.progress) {
                break reason;
            }
            match self.epoch(&mut state) {
                Ok(true) => {}
                Ok(false) => break "interrupt",
                Err(error) => {
                    let _ = self.save(&mut state);
                    // What went wrong is in the metrics.
                    monitor::wait_for_scrape(|| self.interrupt.requested());
                    return Err(error);
                }
            }
        };
        if !self.save(&mut state) {
            monitor::wait_for_scrape(|| self.interrupt.requested());
            anyhow::bail!("the run ended, but its last checkpoint could not be written");
        }
        let summary = self.summary(&state, stopped_by);
        self.tell(|observer| observer.run_end(&summary));
        Ok(summary)
    }

    fn start(&mut self, from: Option<Checkpoint>) -> anyhow::Result<State> {
        let ppo = &self.config.ppo;
        let mut adam = Adam::new(
            self.policy.parameters(),
            AdamOptions {
                beta1: ppo.adam_beta1,
                beta2: ppo.adam_beta2,
                epsilon: ppo.adam_epsilon,
                max_grad_norm: ppo.max_grad_norm,
            },
        );
        let snapshot = if let Some(checkpoint) = from {
            self.policy.load(&checkpoint.weights).context("the checkpoint's weights do not fit")?;
            adam.restore(&checkpoint.optimizer).map_err(anyhow::Error::msg)?;
            checkpoint
        } else {
            let progress = Progress {
                epoch: 0,
                env_steps: 0,
                episodes: 0,
                kl_coef: ppo.kl_coef,
                mmer: None,
                mean_return: None,
                recent_returns: Vec::new(),
                wall_seconds: 0.0,
            };
            let weights = Bytes::from(self.policy.to_bytes());
            Checkpoint { progress, weights: weights.clone(), sampling: weights, optimizer: copy_moments(adam.state()) }
        };
        self.behaviour.load(&snapshot.sampling).context("the checkpoint's sampling weights do not fit")?;
        Ok(State {
            saved_epoch: (snapshot.progress.epoch > 0).then_some(snapshot.progress.epoch),
            earlier_seconds: snapshot.progress.wall_seconds,
            progress: snapshot.progress.clone(),
            adam,
            snapshot,
            started: Instant::now(),
        })
    }

    /// Opens the sampling of the session's first epoch.
    fn open(&self, state: &State) -> anyhow::Result<()> {
        let epoch = state.progress.epoch;
        if self.reached(&state.progress).is_some() {
            return Ok(());
        }
        self.open_epoch(epoch, epoch.saturating_sub(u64::from(self.config.lag)), state.snapshot.sampling.clone())
    }

    fn open_epoch(&self, epoch: u64, version: u64, weights: Bytes) -> anyhow::Result<()> {
        self.service.open(epoch, version, weights, Target::Steps(self.config.ppo.batch_steps as u64))
    }

    /// One epoch. False: interrupted, and the state is that before the epoch.
    fn epoch(&mut self, state: &mut State) -> anyhow::Result<bool> {
        let began = Instant::now();
        let laps = Laps::begin();
        // Both long activities are counted while they last.
        let stop = || {
            laps.end("waiting");
            self.interrupt.requested() || self.hopeless.is_set()
        };
        let Some(collected) = self.service.collect(stop) else {
            anyhow::ensure!(!self.hopeless.is_set(), "local actors fail again and again; see their messages above");
            anyhow::ensure!(self.interrupt.requested(), "the service for actors has died");
            return Ok(false);
        };
        let wait_seconds = began.elapsed().as_secs_f64();
        laps.end("waiting");
        let epoch = state.progress.epoch;
        let before = state.progress.clone();
        account(&mut state.progress, &collected.episodes);

        // COLLECTED: with lag 1 the next epoch is sampled from here on, with the weights as they are now.
        let pipelined = self.config.lag == 1;
        let newest = state.snapshot.weights.clone();
        if pipelined && self.reached(&state.progress).is_none() {
            self.open_epoch(epoch + 1, epoch, newest.clone())?;
        }

        // EVALUATE: by the version that sampled the epoch.
        let learning = Instant::now();
        let batch = Batch::new(&collected.episodes, &self.action, &self.policy);
        laps.end("batching");
        let old = batch.evaluate(&self.behaviour, &self.config.ppo);
        if pipelined {
            self.behaviour.load(&newest)?;
        }

        // UPDATE
        let schedule = self.schedule(&before);
        let means = update::update(
            &self.policy,
            &mut state.adam,
            (&batch, &old),
            (&self.config.ppo, schedule),
            &mut stream(self.config.seed, epoch, 0, Purpose::Shuffle),
            &|| {
                laps.end("learning");
                self.interrupt.requested()
            },
        );
        let means = match means {
            Ok(means) => means,
            Err(error) => {
                state.progress = before;
                if let UpdateError::NotFinite { .. } = error {
                    counter!("popgym_learner_nonfinite_updates_total").increment(1);
                }
                return if error == UpdateError::Interrupted { Ok(false) } else { Err(error.into()) };
            }
        };
        let learn_seconds = learning.elapsed().as_secs_f64();
        counter!("popgym_learner_passes_total").increment(u64::from(self.config.ppo.passes));
        laps.end("learning");

        // BROADCAST
        let weights = Bytes::from(self.policy.to_bytes());
        let sampling = if pipelined { newest } else { weights.clone() };
        let ppo = &self.config.ppo;
        state.progress.epoch += 1;
        state.progress.kl_coef = update::next_kl_coef(state.progress.kl_coef, means.minibatch_kl, ppo.kl_target);
        state.progress.wall_seconds = state.earlier_seconds + state.started.elapsed().as_secs_f64();
        let optimizer = copy_moments(state.adam.state());
        if !pipelined {
            // Refuses weights that are not finite, before the snapshot becomes what a checkpoint holds.
            self.behaviour.load(&sampling)?;
            if self.reached(&state.progress).is_none() {
                self.open_epoch(epoch + 1, epoch + 1, sampling.clone())?;
            }
        }
        laps.end("broadcasting");
        state.snapshot = Checkpoint { progress: state.progress.clone(), weights, sampling, optimizer };

        // REPORT AND SAVE: the row of metrics first, so that a checkpoint never stands without it.
        let metrics = epoch_metrics(epoch, state, &collected.episodes, &means, schedule, old.explained_variance);
        let epoch_seconds = state.progress.wall_seconds - before.wall_seconds;
        let timing = EpochTiming {
            epoch,
            env_steps: state.progress.env_steps,
            wall_seconds: state.progress.wall_seconds,
            steps_per_second: (state.progress.env_steps - before.env_steps) as f64 / epoch_seconds,
            collect_seconds: collected.seconds,
            wait_seconds,
            learn_seconds,
            other_seconds: (began.elapsed().as_secs_f64() - wait_seconds - learn_seconds).max(0.0),
            surplus_steps: collected.surplus_steps,
            log_prob_difference: old.log_prob_difference,
            actors: self.service.actors() as u64,
        };
        let report = EpochReport { metrics, timing };
        self.tell(|observer| observer.epoch(&report));
        laps.end("reporting");
        fail_point::reached("an epoch reported and not saved");
        if state.progress.epoch.is_multiple_of(self.config.checkpoint_epochs) {
            let _ = self.save(state);
        }
        laps.end("checkpointing");
        Ok(true)
    }

    /// Why the run has come to its end, if it has.
    fn reached(&self, progress: &Progress) -> Option<&'static str> {
        self.config.reached(progress.env_steps, progress.mmer)
    }

    fn schedule(&self, progress: &Progress) -> Schedule {
        let ppo = &self.config.ppo;
        let remaining = 1.0 - progress.env_steps as f64 / self.config.steps as f64;
        let factor = match ppo.learning_rate_schedule {
            LearningRateSchedule::Constant => 1.0,
            LearningRateSchedule::Linear => remaining.max(0.0),
        };
        Schedule { learning_rate: ppo.learning_rate * factor, kl_coef: progress.kl_coef }
    }

    /// Writes a checkpoint of the last completed epoch, if there is none yet. A failure is reported, and false.
    fn save(&mut self, state: &mut State) -> bool {
        let epoch = state.snapshot.progress.epoch;
        if epoch == 0 || state.saved_epoch == Some(epoch) {
            return true;
        }
        match state.snapshot.save(&self.checkpoints, &self.about) {
            Ok(path) => {
                state.saved_epoch = Some(epoch);
                self.tell(|observer| observer.checkpoint(epoch, &path));
                if let Err(error) = checkpoint::prune(&self.checkpoints, self.config.keep_checkpoints as usize) {
                    tracing::warn!("old checkpoints not removed: {error:#}");
                }
                true
            }
            Err(error) => {
                counter!("popgym_learner_checkpoint_failures_total").increment(1);
                tracing::error!("checkpoint of epoch {epoch} not written: {error:#}");
                false
            }
        }
    }

    fn tell(&mut self, mut event: impl FnMut(&mut dyn Observer) -> anyhow::Result<()>) {
        for observer in &mut self.observers {
            if let Err(error) = event(observer.as_mut()) {
                tracing::error!("{error:#}");
            }
        }
    }

    fn summary(&self, state: &State, stopped_by: &str) -> Summary {
        let progress = &state.progress;
        Summary {
            env: self.config.env.clone(),
            memory: self.config.memory_name().to_owned(),
            preset: self.config.preset.clone(),
            seed: self.config.seed,
            lag: self.config.lag,
            epochs: progress.epoch,
            env_steps: progress.env_steps,
            episodes: progress.episodes,
            mmer: progress.mmer,
            final_mean_return: progress.mean_return,
            wall_seconds: state.earlier_seconds + state.started.elapsed().as_secs_f64(),
            stopped_by: stopped_by.to_owned(),
        }
    }
}

/// Adds an epoch's episodes to the run's numbers.
fn account(progress: &mut Progress, episodes: &[Episode]) {
    let returns: Vec<f64> = episodes.iter().map(Episode::total_return).collect();
    progress.env_steps += episodes.iter().map(|episode| episode.steps as u64).sum::<u64>();
    progress.episodes += episodes.len() as u64;
    progress.recent_returns.extend_from_slice(&returns);
    let surplus = progress.recent_returns.len().saturating_sub(RETURN_WINDOW.max(returns.len()));
    progress.recent_returns.drain(..surplus);
    let mean_return = mean(&progress.recent_returns);
    let surplus = progress.recent_returns.len().saturating_sub(RETURN_WINDOW);
    progress.recent_returns.drain(..surplus);
    progress.mean_return = Some(mean_return);
    progress.mmer = Some(progress.mmer.map_or(mean_return, |mmer| mmer.max(mean_return)));
}

fn epoch_metrics(
    epoch: u64,
    state: &State,
    episodes: &[Episode],
    means: &UpdateMeans,
    schedule: Schedule,
    explained_variance: f64,
) -> EpochMetrics {
    let progress = &state.progress;
    let returns: Vec<f64> = episodes.iter().map(Episode::total_return).collect();
    let lengths: Vec<f64> = episodes.iter().map(|episode| episode.steps as f64).collect();
    EpochMetrics {
        epoch,
        env_steps: progress.env_steps,
        episodes: progress.episodes,
        mean_return: progress.mean_return.unwrap_or_default(),
        epoch_return: mean(&returns),
        min_return: returns.iter().copied().fold(f64::INFINITY, f64::min),
        max_return: returns.iter().copied().fold(f64::NEG_INFINITY, f64::max),
        mean_length: mean(&lengths),
        mmer: progress.mmer.unwrap_or_default(),
        policy_loss: means.policy_loss,
        value_loss: means.value_loss,
        kl: means.kl,
        kl_coef: schedule.kl_coef,
        entropy: means.entropy,
        explained_variance,
        grad_norm: means.grad_norm,
        learning_rate: schedule.learning_rate,
        valid_fraction: means.valid_fraction,
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// A copy of the optimiser's state as it is now.
fn copy_moments(state: &AdamState) -> AdamState {
    AdamState { first_moment: state.first_moment.copy(), second_moment: state.second_moment.copy(), steps: state.steps }
}
