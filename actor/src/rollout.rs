//! The hot loop: one step of all live episodes at a time.
//!
//! - A **slot** is an environment with the storage of its episode; there are as many as the actor may step at a time.
//! - A **row** is a place in the batch of inference. A live row belongs to one slot; the others are padding.
//!
//! An episode's result depends on nothing but the run's seed, its epoch and index, and the weights: its two streams are
//! its own, and a row's result does not depend on the other rows ([`crate::invariance`]).

use std::collections::VecDeque;

use popgym_envs::{EnvSpec, EpisodeRng, Purpose, Slab, StepError, VecEnv, stream};
use popgym_models::{Policy, PolicySpec, State, memory};
use popgym_proto::{Episode, EpisodeBuilder, EpisodeSpec, Fingerprint, RunSpec, fingerprint, limits};
use tch::{Device, Tensor};
use tracing::warn;

use crate::invariance;
use crate::metrics::{Activity, Tally};

/// Samples the episodes it is given, with one version of the weights at a time.
pub struct Rollout {
    spec: RunSpec,
    policy: Policy,
    envs: VecEnv,
    fingerprint: Fingerprint,
    slots: Vec<Slot>,
    /// Slots without an episode.
    free: Vec<usize>,
    /// `[slots]` rows each: what the agent sees, what the policy drew, what the environment receives.
    observations: Slab,
    stored_actions: Slab,
    env_actions: Slab,
    /// Row of the batch -> its slot; `None`: padding.
    rows: Vec<Option<usize>>,
    live: usize,
    /// The memory's state, a row for each of `rows`.
    state: State,
    /// `[rows, input width]` and `[rows, parameters]`, reused.
    features: Vec<f32>,
    params: Vec<f32>,
    epoch: u64,
    version: Option<u64>,
    /// Leases that wait for a slot.
    waiting: VecDeque<u64>,
    /// Always this many rows, on a machine where a row's result depends on their number. Known with the first weights.
    padding: Padding,
    /// Where the time goes.
    pub tally: Tally,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Padding {
    NotMeasured,
    /// As many rows as are live, but enough for the kernels to be the same.
    AsLive,
    /// Always the number that the run's specification names.
    Fixed,
}

/// The storage of one slot.
struct Slot {
    actions: EpisodeRng,
    episode: EpisodeBuilder,
}

impl Rollout {
    /// Builds environments and policy for `spec`. The weights are yet to come.
    ///
    /// # Errors
    /// An unknown environment or memory, or options that are not legal; each names what is wrong.
    pub fn new(
        envs: &popgym_envs::Registry,
        memories: &memory::Registry,
        spec: RunSpec,
        slots: u32,
    ) -> anyhow::Result<Self> {
        let slots = slots as usize;
        let envs = VecEnv::observing(envs, &spec.env, spec.observability, slots)?;
        let EnvSpec { observation, action, max_steps, .. } = envs.spec();
        let policy_spec = PolicySpec {
            observation: observation.clone(),
            action: action.clone(),
            memory: spec.memory.clone(),
            memory_options: spec.memory_options.clone(),
            options: spec.policy_options.clone().try_into()?,
            max_steps: *max_steps,
        };
        let policy = Policy::new(&policy_spec, memories, Device::Cpu)?;
        let stored = policy.distribution().stored_space();
        let episodes =
            EpisodeSpec { observation: observation.clone(), action: stored.clone(), max_steps: spec.max_episode_steps };
        episodes.check()?;
        let fingerprint = fingerprint(&spec, &format!("{:?}", envs.spec()), &policy.signature());
        let slot = || Slot { actions: stream(0, 0, 0, Purpose::TrainAction), episode: EpisodeBuilder::default() };
        Ok(Self {
            fingerprint,
            slots: (0..slots).map(|_| slot()).collect(),
            free: (0..slots).rev().collect(),
            observations: envs.observations(),
            stored_actions: Slab::new(&stored, slots),
            env_actions: envs.actions(),
            rows: Vec::new(),
            live: 0,
            state: State::default(),
            features: Vec::new(),
            params: Vec::new(),
            epoch: 0,
            version: None,
            waiting: VecDeque::new(),
            padding: Padding::NotMeasured,
            tally: Tally::default(),
            spec,
            policy,
            envs,
        })
    }

    /// The run that it was built for.
    pub fn spec(&self) -> &RunSpec {
        &self.spec
    }

    /// The policy; its weights are those of the present version.
    pub fn policy(&self) -> &Policy {
        &self.policy
    }

    /// What the handshake compares.
    pub fn fingerprint(&self) -> Fingerprint {
        self.fingerprint
    }

    /// The epoch that is being sampled.
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// The version of the weights; `None` before the first.
    pub fn version(&self) -> Option<u64> {
        self.version
    }

    /// Episodes being stepped.
    pub fn live(&self) -> usize {
        self.live
    }

    /// Leases that wait for a slot.
    pub fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Whether there is nothing to do.
    pub fn is_idle(&self) -> bool {
        self.live == 0 && self.waiting.is_empty()
    }

    /// Drops all episodes and leases, finished or not.
    pub fn drop_episodes(&mut self) {
        self.waiting.clear();
        self.free.extend(self.rows.drain(..).flatten());
        self.live = 0;
    }

    /// Turns to `epoch` and `version`; whatever was sampled for another epoch is dropped. `weights`: safetensors of the
    /// version, if it is not the present one.
    ///
    /// # Errors
    /// Weights that are missing or do not fit the policy.
    pub fn open(&mut self, epoch: u64, version: u64, weights: Option<&[u8]>) -> anyhow::Result<()> {
        self.drop_episodes();
        if let Some(weights) = weights {
            self.version = None;
            self.policy.load(weights)?;
            self.version = Some(version);
        }
        anyhow::ensure!(self.version == Some(version), "the weights of version {version} were not sent");
        self.epoch = epoch;
        if self.padding == Padding::NotMeasured {
            self.measure_padding();
        }
        Ok(())
    }

    fn measure_padding(&mut self) {
        if invariance::rows_are_independent(&self.policy, self.slots.len() as u32) {
            self.padding = Padding::AsLive;
            return;
        }
        self.padding = Padding::Fixed;
        let rows = self.spec.rows;
        warn!(memory = self.spec.memory, rows, "on this machine a row's result depends on the number of rows: fixed");
        let (used, free) = ((rows as usize).min(self.slots.len()), &mut self.free);
        free.retain(|&slot| slot < used);
    }

    /// Takes leases of the present epoch; they start as slots become free, in this order.
    pub fn lease(&mut self, indices: impl IntoIterator<Item = u64>) {
        self.waiting.extend(indices);
    }

    /// One step of every live episode; the episodes that it ended are added to `finished`.
    ///
    /// # Errors
    /// The policy chose what is no action: its weights or its arithmetic are broken.
    pub fn step(&mut self, finished: &mut Vec<Episode>) -> Result<(), StepError> {
        self.arrange_rows();
        if self.live == 0 {
            return Ok(());
        }
        self.tally.lap(Activity::Env);
        self.encode();
        self.tally.lap(Activity::Encoding);
        self.infer();
        self.tally.lap(Activity::Inference);
        self.tally.steps(self.live);
        self.advance(finished)?;
        self.tally.lap(Activity::Env);
        Ok(())
    }

    /// Number of rows to compute for `live` live ones.
    fn batch_rows(&self, live: usize) -> usize {
        match self.padding {
            _ if live == 0 => 0,
            Padding::Fixed => self.spec.rows as usize,
            Padding::AsLive | Padding::NotMeasured => live.max(limits::MIN_ROWS as usize),
        }
    }

    /// Starts waiting episodes in free slots, makes room for them in the batch, and shrinks it where many rows have
    /// become padding.
    fn arrange_rows(&mut self) {
        let starting = self.waiting.len().min(self.free.len());
        let target = self.batch_rows(self.live + starting);
        // A copy of the state costs about as much as a few rows of inference: wait until it pays.
        let shrinks = target < self.rows.len() && self.rows.len() - target >= (self.rows.len() / 8).max(4);
        let resized = target > self.rows.len() || shrinks;
        if resized {
            self.resize(target);
        }
        if starting > 0 {
            self.start_episodes(starting);
        }
        if resized || starting > 0 {
            self.reset_states();
        }
    }

    /// Starts the first `count` waiting episodes; as many slots are free and rows vacant.
    fn start_episodes(&mut self, count: usize) {
        let (env, action) = if self.spec.evaluation {
            (Purpose::EvalEnv, Purpose::EvalAction)
        } else {
            (Purpose::TrainEnv, Purpose::TrainAction)
        };
        let vacant = (0..self.rows.len()).filter(|&row| self.rows[row].is_none()).collect::<Vec<_>>();
        let slots = self.free.drain(self.free.len() - count..);
        for ((index, row), slot) in self.waiting.drain(..count).zip(vacant).zip(slots) {
            let stream = |purpose| stream(self.spec.seed, self.epoch, index, purpose);
            self.envs.begin(slot, stream(env), &mut self.observations);
            self.slots[slot].actions = stream(action);
            self.slots[slot].episode.begin(index, self.observations.row(slot));
            self.rows[row] = Some(slot);
            self.live += 1;
        }
    }

    /// Makes the batch `target` rows long, live rows first.
    fn resize(&mut self, target: usize) {
        let live = (0..self.rows.len()).filter(|&row| self.rows[row].is_some());
        let mut kept: Vec<i64> = live.map(|row| row as i64).collect();
        self.rows.retain(Option::is_some);
        self.rows.resize(target, None);
        if kept.is_empty() {
            self.state = self.policy.initial_state(target as i64);
            return;
        }
        // Padding takes a copy of any row.
        kept.resize(target, kept[0]);
        self.state = self.state.select(&kept);
    }

    /// The states of episodes at their first step, and of padding (so that it stays finite), are zero.
    fn reset_states(&mut self) {
        let new = |&row: &usize| self.rows[row].is_none_or(|slot| self.slots[slot].episode.steps() == 0);
        let rows: Vec<i64> = (0..self.rows.len()).filter(new).map(|row| row as i64).collect();
        self.state.reset_rows(&rows);
    }

    /// Observations and previous actions to input vectors; zeros for padding.
    fn encode(&mut self) {
        let encoder = self.policy.encoder();
        let width = encoder.width();
        self.features.resize(self.rows.len() * width, 0.0);
        for (row, features) in self.rows.iter().zip(self.features.chunks_exact_mut(width)) {
            match *row {
                Some(slot) => {
                    let first = self.slots[slot].episode.steps() == 0;
                    encoder.encode(self.observations.row(slot), self.env_actions.row(slot), first, features);
                }
                None => features.fill(0.0),
            }
        }
    }

    fn infer(&mut self) {
        let (rows, width) = (self.rows.len(), self.policy.encoder().width());
        let features = Tensor::from_slice(&self.features).view([rows as i64, width as i64]);
        let (params, state) = self.policy.act(&features, &self.state);
        self.state = state;
        let numbers = rows * self.policy.distribution().width();
        self.params.resize(numbers, 0.0);
        params.contiguous().copy_data(&mut self.params, numbers);
    }

    /// Draws the actions, steps the environments, stores what happened, and retires rows whose episode has ended.
    fn advance(&mut self, finished: &mut Vec<Episode>) -> Result<(), StepError> {
        let distribution = self.policy.distribution();
        for (row, params) in self.rows.iter_mut().zip(self.params.chunks_exact(distribution.width())) {
            let Some(slot) = *row else { continue };
            let Slot { actions, episode } = &mut self.slots[slot];
            let stored = self.stored_actions.row_mut(slot);
            let log_prob = if self.spec.greedy {
                distribution.mode(params, stored);
                // What this policy is certain to do.
                0.0
            } else {
                distribution.sample(params, actions, stored)
            };
            distribution.to_env(self.stored_actions.row(slot), self.env_actions.row_mut(slot));
            let step = self.envs.step(slot, self.env_actions.row(slot), &mut self.observations)?;
            episode.push(self.stored_actions.row(slot), log_prob, step.reward, self.observations.row(slot));
            let out_of_time = episode.steps() >= self.spec.max_episode_steps as usize;
            if step.done() || out_of_time {
                finished.push(episode.finish(step.terminated, step.truncated || out_of_time));
                *row = None;
                self.free.push(slot);
                self.live -= 1;
            }
        }
        Ok(())
    }
}
