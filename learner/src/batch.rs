//! An epoch's episodes as columns on the learner's device, and what the old policy says of them.

use popgym_envs::space::{Slab, Space, Value};
use popgym_models::{Encoder, Packing, Policy};
use popgym_proto::Episode;
use tch::{Device, Kind, Tensor};

use crate::config::Ppo;
use crate::gae;

/// The episodes of one epoch, in index order, copied to the device once.
///
/// An episode of T steps occupies T + 1 rows, one for each of o_0 .. o_T; the last has no action and is only used to
/// bootstrap.
pub struct Batch {
    /// Steps of each episode.
    pub lengths: Vec<i64>,
    /// First row of each episode.
    pub starts: Vec<i64>,
    rewards: Vec<Vec<f64>>,
    terminated: Vec<bool>,
    actor_log_probs: Vec<f32>,
    /// Input components that are discrete, u8 `[rows, encoder's discrete width]`.
    discrete: Tensor,
    /// Input components that are real, f32 `[rows, encoder's real width]`.
    real: Tensor,
    /// Stored actions, discrete components, i64 `[rows, ..]`.
    actions_discrete: Tensor,
    /// Stored actions, real components, f32 `[rows, ..]`.
    actions_real: Tensor,
}

/// What the version that sampled an epoch says of it: the constants of the epoch's update, one row each.
pub struct OldPolicy {
    /// Distribution parameters, `[rows, parameters]`.
    pub params: Tensor,
    /// Log-probabilities of the actions, `[rows]`.
    pub log_probs: Tensor,
    /// Advantages, standardised over the epoch, `[rows]`.
    pub advantages: Tensor,
    /// Value targets: advantage + value, not standardised, `[rows]`.
    pub targets: Tensor,
    /// 1 - Var(target - value) / Var(target); 0 where the targets do not vary.
    pub explained_variance: f64,
    /// Largest difference between the actors' log-probabilities and ours.
    pub log_prob_difference: f64,
}

impl Batch {
    /// Lays out `episodes` for `policy`; `action` is the environment's action space.
    pub fn new(episodes: &[Episode], action: &Space, policy: &Policy) -> Self {
        let encoder = policy.encoder();
        let rows: usize = episodes.iter().map(|episode| episode.steps + 1).sum();
        let mut columns = Columns::with_rows(rows, encoder);
        let mut batch_starts = Vec::with_capacity(episodes.len());
        let mut start = 0;
        for episode in episodes {
            batch_starts.push(start);
            start += episode.steps as i64 + 1;
            columns.append(episode, action, policy);
        }
        let device = policy.device();
        let stored = policy.distribution().stored_space();
        let (action_discrete, action_real) = (stored.discrete_width(), stored.real_width());
        Self {
            lengths: episodes.iter().map(|episode| episode.steps as i64).collect(),
            starts: batch_starts,
            rewards: episodes.iter().map(|episode| episode.rewards.clone()).collect(),
            terminated: episodes.iter().map(|episode| episode.terminated).collect(),
            actor_log_probs: columns.log_probs,
            discrete: matrix(&columns.discrete, rows, encoder.discrete_width(), device),
            real: matrix(&columns.real, rows, encoder.real_width(), device),
            actions_discrete: matrix(&columns.actions_discrete, rows, action_discrete, device).to_kind(Kind::Int64),
            actions_real: matrix(&columns.actions_real, rows, action_real, device),
        }
    }

    /// Steps of all episodes.
    pub fn steps(&self) -> i64 {
        self.lengths.iter().sum()
    }

    /// Input vectors of the rows `index` names, `[index length, encoder's width]`.
    pub fn features(&self, encoder: &Encoder, index: &Tensor) -> Tensor {
        encoder.features(&self.discrete.index_select(0, index), &self.real.index_select(0, index))
    }

    /// Stored actions of the rows `index` names: discrete and real components.
    pub fn actions(&self, index: &Tensor) -> (Tensor, Tensor) {
        (self.actions_discrete.index_select(0, index), self.actions_real.index_select(0, index))
    }

    /// One pass without gradients by the version that sampled the epoch: log-probabilities, distribution parameters and
    /// values, in index order and in fixed packing; from them advantages and value targets.
    pub fn evaluate(&self, behaviour: &Policy, ppo: &Ppo) -> OldPolicy {
        let rows = self.discrete.size()[0];
        let device = behaviour.device();
        let width = behaviour.distribution().width() as i64;
        let mut params = Tensor::zeros([rows, width], (Kind::Float, device));
        let mut values = Tensor::zeros([rows], (Kind::Float, device));
        let mut log_probs = Tensor::zeros([rows], (Kind::Float, device));
        tch::no_grad(|| {
            for episodes in chunks_by_steps(&self.lengths, ppo.minibatch_steps) {
                let lengths: Vec<i64> = self.lengths[episodes.clone()].iter().map(|length| length + 1).collect();
                let packing = Packing::new(&lengths);
                let index = packing.gather_index(&self.starts[episodes], device);
                let outputs = behaviour.scan(&self.features(behaviour.encoder(), &index), &packing, 0);
                let (discrete, real) = self.actions(&index);
                let scores = behaviour.distribution().evaluate(&outputs.params, &outputs.params, &discrete, &real);
                let _ = log_probs.index_copy_(0, &index, &scores.log_prob);
                let _ = values.index_copy_(0, &index, &outputs.values);
                let _ = params.index_copy_(0, &index, &outputs.params);
            }
        });
        self.old_policy(params, log_probs, &to_vec(&values), ppo)
    }

    fn old_policy(&self, params: Tensor, log_probs: Tensor, values: &[f32], ppo: &Ppo) -> OldPolicy {
        let mut advantages = Vec::with_capacity(self.steps() as usize);
        let mut old_values = Vec::with_capacity(advantages.capacity());
        for (episode, rewards) in self.rewards.iter().enumerate() {
            let start = self.starts[episode] as usize;
            let values: Vec<f64> =
                values[start..=start + rewards.len()].iter().map(|&value| f64::from(value)).collect();
            let (&last, values) = values.split_last().expect("an episode of T steps has T + 1 values");
            let bootstrap = gae::bootstrap(self.terminated[episode], ppo.bootstrap_at_truncation, last);
            let scaled: Vec<f64> = rewards.iter().map(|reward| reward * ppo.reward_scale).collect();
            advantages.extend(gae::advantages(&scaled, values, bootstrap, ppo.gamma, ppo.gae_lambda));
            old_values.extend_from_slice(values);
        }
        let targets = gae::value_targets(&advantages, &old_values);
        let (_, target_variance) = gae::mean_and_variance(&targets);
        let (_, residual_variance) = gae::mean_and_variance(&advantages);
        let log_prob_difference = self.log_prob_difference(&log_probs);
        gae::standardise(&mut advantages);
        OldPolicy {
            advantages: self.spread(&advantages, params.device()),
            targets: self.spread(&targets, params.device()),
            explained_variance: if target_variance > 0.0 { 1.0 - residual_variance / target_variance } else { 0.0 },
            log_prob_difference,
            params,
            log_probs,
        }
    }

    /// A column of steps as one of rows: each episode's last row is 0.
    fn spread(&self, steps: &[f64], device: Device) -> Tensor {
        let mut rows = Vec::with_capacity(steps.len() + self.lengths.len());
        let mut steps = steps.iter();
        for &length in &self.lengths {
            rows.extend(steps.by_ref().take(length as usize).map(|&value| value as f32));
            rows.push(0.0);
        }
        Tensor::from_slice(&rows).to_device(device)
    }

    fn log_prob_difference(&self, log_probs: &Tensor) -> f64 {
        let ours = to_vec(log_probs);
        let mut actors = self.actor_log_probs.iter();
        let mut largest = 0.0f64;
        for (&start, &length) in self.starts.iter().zip(&self.lengths) {
            let ours = &ours[start as usize..(start + length) as usize];
            for (ours, actors) in ours.iter().zip(actors.by_ref()) {
                largest = largest.max(f64::from((ours - actors).abs()));
            }
        }
        largest
    }
}

/// The columns while they are laid out.
struct Columns {
    discrete: Vec<u8>,
    real: Vec<f32>,
    actions_discrete: Vec<u8>,
    actions_real: Vec<f32>,
    log_probs: Vec<f32>,
}

impl Columns {
    fn with_rows(rows: usize, encoder: &Encoder) -> Self {
        Self {
            discrete: Vec::with_capacity(rows * encoder.discrete_width()),
            real: Vec::with_capacity(rows * encoder.real_width()),
            actions_discrete: Vec::new(),
            actions_real: Vec::new(),
            log_probs: Vec::with_capacity(rows),
        }
    }

    fn append(&mut self, episode: &Episode, action: &Space, policy: &Policy) {
        let (encoder, distribution) = (policy.encoder(), policy.distribution());
        let mut env_action = Slab::new(action, 1);
        for t in 0..=episode.steps {
            let observation = row(&episode.observations.discrete, &episode.observations.real, t, episode.steps + 1);
            encoder.append_row(observation, env_action.row(0), t == 0, &mut self.discrete, &mut self.real);
            if t < episode.steps {
                let stored = row(&episode.actions.discrete, &episode.actions.real, t, episode.steps);
                distribution.to_env(stored, env_action.row_mut(0));
                self.actions_discrete.extend_from_slice(stored.discrete);
                self.actions_real.extend_from_slice(stored.real);
            }
        }
        // The row of o_T has no action: any legal one will do, since nothing reads its score.
        self.actions_discrete.extend(std::iter::repeat_n(0, action.discrete_width()));
        self.actions_real.extend(std::iter::repeat_n(0.0, action.real_width()));
        self.log_probs.extend_from_slice(&episode.log_probs);
    }
}

/// Row `t` of columns that have `rows` rows.
fn row<'a>(discrete: &'a [u8], real: &'a [f32], t: usize, rows: usize) -> Value<'a> {
    let (discrete_width, real_width) = (discrete.len() / rows, real.len() / rows);
    Value { discrete: &discrete[t * discrete_width..][..discrete_width], real: &real[t * real_width..][..real_width] }
}

fn matrix<T: tch::kind::Element>(values: &[T], rows: usize, width: usize, device: Device) -> Tensor {
    Tensor::from_slice(values).view([rows as i64, width as i64]).to_device(device)
}

fn to_vec(column: &Tensor) -> Vec<f32> {
    Vec::try_from(column.to_device(Device::Cpu)).expect("an f32 column on the CPU is a vector")
}

/// Consecutive episodes in groups of about `budget` steps, each episode in one.
fn chunks_by_steps(lengths: &[i64], budget: i64) -> Vec<std::ops::Range<usize>> {
    let (mut chunks, mut first, mut steps) = (Vec::new(), 0, 0);
    for (episode, length) in lengths.iter().enumerate() {
        steps += length;
        if steps >= budget || episode + 1 == lengths.len() {
            chunks.push(first..episode + 1);
            (first, steps) = (episode + 1, 0);
        }
    }
    chunks
}

#[cfg(test)]
pub(crate) mod tests {
    use bytes::Bytes;
    use popgym_envs::space::{Space, Value};
    use popgym_models::{Policy, PolicyOptions, PolicySpec, memory};
    use popgym_proto::{Columns, Episode};
    use tch::{Device, Kind, Tensor};

    use super::{Batch, chunks_by_steps, to_vec};
    use crate::config::Ppo;

    /// For episodes of 3 observations and 2 actions.
    pub(crate) fn policy(memory: &str, memory_options: &str) -> Policy {
        let spec = PolicySpec {
            observation: Space::Discrete(3),
            action: Space::Discrete(2),
            memory: memory.to_owned(),
            memory_options: memory_options.parse().unwrap(),
            options: PolicyOptions { log_std_min: f64::NEG_INFINITY, log_std_max: f64::INFINITY },
            max_steps: 10,
        };
        tch::manual_seed(3);
        Policy::new(&spec, &memory::Registry::standard(), Device::Cpu).unwrap()
    }

    /// Its rewards are 1, 2, 3...
    pub(crate) fn episode(index: u64, observations: &[u8], actions: &[u8], terminated: bool) -> Episode {
        let columns = |classes: &[u8]| Columns { discrete: Bytes::copy_from_slice(classes), real: Vec::new() };
        Episode {
            index,
            steps: actions.len(),
            observations: columns(observations),
            actions: columns(actions),
            rewards: (0..actions.len()).map(|t| (t + 1) as f64).collect(),
            log_probs: vec![-0.5; actions.len()],
            terminated,
            truncated: !terminated,
        }
    }

    /// Log-probabilities and values of one episode, played step by step: what the packed pass must find.
    fn step_by_step(policy: &Policy, episode: &Episode) -> (Vec<f64>, Vec<f64>) {
        let (mut log_probs, mut values) = (Vec::new(), Vec::new());
        let mut state = policy.initial_state(1);
        let mut features = vec![0.0; policy.encoder().width()];
        for (t, observation) in episode.observations.discrete.iter().enumerate() {
            let previous = [if t == 0 { 0 } else { episode.actions.discrete[t - 1] }];
            let value = |discrete| Value { discrete, real: &[] };
            policy.encoder().encode(value(&[*observation]), value(&previous), t == 0, &mut features);
            let (params, critic, next) = policy.step(&Tensor::from_slice(&features).unsqueeze(0), &state);
            values.push(critic.double_value(&[0]));
            if t < episode.steps {
                let action = i64::from(episode.actions.discrete[t]);
                log_probs.push(params.log_softmax(-1, Kind::Float).double_value(&[0, action]));
            }
            state = next;
        }
        (log_probs, values)
    }

    #[test]
    fn the_packed_pass_finds_what_single_steps_find() {
        let policy = policy("gru", "hidden_size = 8");
        let episodes = [
            episode(0, &[0, 1, 2], &[1, 0], true),
            episode(1, &[2, 2, 1, 0, 1], &[0, 1, 1, 0], false),
            episode(2, &[1, 0], &[1], false),
        ];
        let ppo =
            Ppo { minibatch_steps: 5, gae_lambda: 1.0, gamma: 0.5, bootstrap_at_truncation: true, ..Ppo::paper() };
        let batch = Batch::new(&episodes, &Space::Discrete(2), &policy);
        let old = batch.evaluate(&policy, &ppo);
        let (log_probs, targets) = (to_vec(&old.log_probs), to_vec(&old.targets));
        for (episode, &start) in episodes.iter().zip(&batch.starts) {
            let (expected, values) = step_by_step(&policy, episode);
            // With lambda 1 the target is the discounted return, with V(o_T) behind a mere truncation.
            let mut discounted = if episode.terminated { 0.0 } else { values[episode.steps] };
            for t in (0..episode.steps).rev() {
                discounted = episode.rewards[t] + 0.5 * discounted;
                let row = start as usize + t;
                assert!((f64::from(log_probs[row]) - expected[t]).abs() < 1e-5);
                assert!((f64::from(targets[row]) - discounted).abs() < 1e-5, "{} {discounted}", targets[row]);
            }
        }
        let advantages = to_vec(&old.advantages);
        assert!(advantages.iter().sum::<f32>().abs() < 1e-5);
        assert!((advantages.iter().map(|x| x * x).sum::<f32>() - batch.steps() as f32).abs() < 1e-4);
        let differences =
            (0..3).flat_map(|e| step_by_step(&policy, &episodes[e]).0).map(|log_prob| (log_prob + 0.5).abs());
        assert!((old.log_prob_difference - differences.fold(0.0, f64::max)).abs() < 1e-5);
    }

    #[test]
    fn chunks_hold_every_episode_once() {
        assert_eq!(chunks_by_steps(&[3, 3, 3, 1], 5), [0..2, 2..4]);
        assert_eq!(chunks_by_steps(&[9], 5), vec![0..1]);
        assert_eq!(chunks_by_steps(&[1, 1], 5), vec![0..2]);
    }
}
