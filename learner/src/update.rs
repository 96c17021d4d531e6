//! One epoch's update: proximal policy optimisation (Schulman et al., 2017) on whole episodes.
//!
//! Per minibatch, `<.>` being the mean over its steps (reference: RLlib 2.0's PPO, which the paper ran):
//!
//! ```text
//! rho = exp(logp_new - logp_old)
//! L   = < -min(A rho, A clip(rho, 1 - clip, 1 + clip)) >  +  value_coef < clamp((V - R)^2, 0, value_clip) >
//!       - entropy_coef < H >  +  kl_coef < KL(old || new) >
//! ```

use popgym_envs::EpisodeRng;
use popgym_models::distribution::Evaluation;
use popgym_models::{Packing, Policy};
use tch::{Device, Kind, Tensor};

use crate::adam::Adam;
use crate::batch::{Batch, OldPolicy};
use crate::config::Ppo;

/// Means over all minibatches of all passes, weighted by steps.
#[derive(Clone, Copy, Debug, Default)]
pub struct UpdateMeans {
    /// Clipped surrogate loss.
    pub policy_loss: f64,
    /// Clamped squared error of the critic.
    pub value_loss: f64,
    /// KL(old || new), nats a step.
    pub kl: f64,
    /// Entropy, nats a step.
    pub entropy: f64,
    /// Norm of the gradient before it was scaled down.
    pub grad_norm: f64,
    /// Steps that the memory needed to compute, divided by those it computed.
    pub valid_fraction: f64,
}

/// Why an update did not end well.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum UpdateError {
    /// The user asked to stop; the weights are those of an unfinished update.
    #[error("interrupted")]
    Interrupted,
    /// The update diverged.
    #[error(
        "the update diverged: {tensor} is not finite in minibatch {minibatch} of pass {pass}; nothing of this update is \
         kept (a lower ppo.learning_rate may help)"
    )]
    NotFinite {
        /// What is not finite.
        tensor: String,
        /// The pass over the batch, from 1.
        pass: u32,
        /// The minibatch of the pass, from 1.
        minibatch: usize,
    },
}

/// Runs the passes of one epoch over `batch`, changing `policy` and `adam`.
///
/// # Errors
/// The update was interrupted or diverged; the weights must then be thrown away.
pub fn update(
    policy: &Policy,
    adam: &mut Adam,
    (batch, old): (&Batch, &OldPolicy),
    (ppo, schedule): (&Ppo, Schedule),
    rng: &mut EpisodeRng,
    interrupted: &dyn Fn() -> bool,
) -> Result<UpdateMeans, UpdateError> {
    let mut totals = Totals::new(policy.device());
    for pass in 1..=ppo.passes {
        for (episodes, number) in minibatches(&batch.lengths, ppo.minibatch_steps, rng).into_iter().zip(1..) {
            if interrupted() {
                return Err(UpdateError::Interrupted);
            }
            let minibatch = Minibatch::new(batch, old, &episodes, policy);
            let outputs = policy.scan(&minibatch.features, &minibatch.packing, ppo.bptt);
            let computed_steps = outputs.computed_steps;
            let scores = policy.distribution().evaluate(
                &outputs.params,
                &minibatch.old_params,
                &minibatch.actions.0,
                &minibatch.actions.1,
            );

            let losses = minibatch.losses(&scores, &outputs.values, ppo);
            let loss = &losses.policy + &losses.value * ppo.value_coef - &losses.entropy * ppo.entropy_coef
                + &losses.kl * schedule.kl_coef;

            adam.zero_grad();
            outputs.backward(&loss);
            let grad_norm = adam.step(schedule.learning_rate).map_err(|tensor| UpdateError::NotFinite {
                tensor,
                pass,
                minibatch: number,
            })?;
            let means = [&losses.policy, &losses.value, &losses.kl, &losses.entropy, &grad_norm];
            totals.add(&means, minibatch.packing.rows(), computed_steps);
        }
    }
    Ok(totals.means())
}

/// What changes from epoch to epoch.
#[derive(Clone, Copy, Debug)]
pub struct Schedule {
    /// Adam's learning rate.
    pub learning_rate: f64,
    /// Coefficient of the KL term.
    pub kl_coef: f64,
}

/// The KL coefficient of the next epoch, given the mean KL of this one's update (a mean over steps, where RLlib takes one
/// over its minibatches): half again as large above twice the
/// target, half below half of it (Schulman et al., 2017, section 4, with RLlib's factors).
pub fn next_kl_coef(kl_coef: f64, kl: f64, kl_target: f64) -> f64 {
    if kl > 2.0 * kl_target {
        1.5 * kl_coef
    } else if kl < 0.5 * kl_target {
        0.5 * kl_coef
    } else {
        kl_coef
    }
}

/// Whole episodes, shuffled, cut into parts of about `budget` steps; every episode is in exactly one.
///
/// There are round(steps / budget) parts (1 at least), as equal as whole episodes allow: an episode belongs to the part
/// in which its middle falls when all are laid end to end.
pub fn minibatches(lengths: &[i64], budget: i64, rng: &mut EpisodeRng) -> Vec<Vec<usize>> {
    let mut order: Vec<usize> = (0..lengths.len()).collect();
    for last in (1..order.len()).rev() {
        order.swap(last, popgym_envs::rng::below(rng, last as u32 + 1) as usize);
    }
    let total: i64 = lengths.iter().sum();
    let parts = ((total + budget / 2) / budget).clamp(1, lengths.len() as i64);
    let mut minibatches = vec![Vec::new(); parts as usize];
    let mut before = 0;
    for episode in order {
        let middle = before + lengths[episode] / 2;
        minibatches[(middle * parts / total) as usize].push(episode);
        before += lengths[episode];
    }
    minibatches.retain(|episodes| !episodes.is_empty());
    minibatches
}

/// One minibatch, packed.
struct Minibatch {
    packing: Packing,
    features: Tensor,
    actions: (Tensor, Tensor),
    old_params: Tensor,
    old_log_probs: Tensor,
    advantages: Tensor,
    targets: Tensor,
}

impl Minibatch {
    fn new(batch: &Batch, old: &OldPolicy, episodes: &[usize], policy: &Policy) -> Self {
        let lengths: Vec<i64> = episodes.iter().map(|&episode| batch.lengths[episode]).collect();
        let starts: Vec<i64> = episodes.iter().map(|&episode| batch.starts[episode]).collect();
        let packing = Packing::new(&lengths);
        let index = packing.gather_index(&starts, policy.device());
        Self {
            features: batch.features(policy.encoder(), &index),
            actions: batch.actions(&index),
            old_params: old.params.index_select(0, &index),
            old_log_probs: old.log_probs.index_select(0, &index),
            advantages: old.advantages.index_select(0, &index),
            targets: old.targets.index_select(0, &index),
            packing,
        }
    }

    fn losses(&self, scores: &Evaluation, values: &Tensor, ppo: &Ppo) -> Losses {
        let ratio = (&scores.log_prob - &self.old_log_probs).exp();
        let clipped = ratio.clamp(1.0 - ppo.clip, 1.0 + ppo.clip) * &self.advantages;
        let surrogate = (ratio * &self.advantages).minimum(&clipped);
        let squared_error = (values - &self.targets).square();
        Losses {
            policy: -surrogate.mean(Kind::Float),
            value: squared_error.clamp_max(ppo.value_clip).mean(Kind::Float),
            entropy: scores.entropy.mean(Kind::Float),
            kl: scores.kl.mean(Kind::Float),
        }
    }
}

/// The terms of the loss, each a mean over the minibatch's steps.
struct Losses {
    policy: Tensor,
    value: Tensor,
    entropy: Tensor,
    kl: Tensor,
}

/// Sums of the reported quantities, kept on the device so that no minibatch waits for it.
struct Totals {
    sums: Tensor,
    steps: i64,
    computed_steps: i64,
}

impl Totals {
    fn new(device: Device) -> Self {
        Self { sums: Tensor::zeros([5], (Kind::Double, device)), steps: 0, computed_steps: 0 }
    }

    fn add(&mut self, means: &[&Tensor; 5], steps: i64, computed_steps: i64) {
        tch::no_grad(|| self.sums += Tensor::stack(means, 0).to_kind(Kind::Double) * steps as f64);
        self.steps += steps;
        self.computed_steps += computed_steps;
    }

    fn means(self) -> UpdateMeans {
        let means = Vec::<f64>::try_from((self.sums / self.steps as f64).to_device(Device::Cpu))
            .expect("five f64 numbers on the CPU are a vector");
        UpdateMeans {
            policy_loss: means[0],
            value_loss: means[1],
            kl: means[2],
            entropy: means[3],
            grad_norm: means[4],
            valid_fraction: self.steps as f64 / self.computed_steps as f64,
        }
    }
}

#[cfg(test)]
mod tests {
    use popgym_envs::{Purpose, stream};
    use popgym_models::Packing;
    use popgym_models::distribution::Evaluation;
    use proptest::prelude::*;
    use tch::Tensor;

    use super::{Minibatch, minibatches, next_kl_coef};
    use crate::config::Ppo;

    /// Reference 3.5, by hand: clip 0.3, squared error clamped at 10. The three steps are: ratio 2 clipped to 1.3 with a
    /// gain; ratio 2 not clipped with a loss; ratio 0.5 clipped to 0.7 with a loss.
    #[test]
    fn losses_by_hand() {
        let column = |values: &[f32]| Tensor::from_slice(values);
        let minibatch = Minibatch {
            packing: Packing::new(&[3]),
            features: Tensor::new(),
            actions: (Tensor::new(), Tensor::new()),
            old_params: Tensor::new(),
            old_log_probs: column(&[-1.0, -1.0, -1.0]),
            advantages: column(&[1.0, -1.0, -2.0]),
            targets: column(&[0.0, 1.0, 5.0]),
        };
        let ln2 = std::f32::consts::LN_2;
        let scores = Evaluation {
            log_prob: column(&[-1.0 + ln2, -1.0 + ln2, -1.0 - ln2]),
            entropy: column(&[0.25, 0.5, 0.75]),
            kl: column(&[0.0, 0.3, 0.6]),
        };
        let losses = minibatch.losses(&scores, &column(&[0.5, 3.0, 1.0]), &Ppo::paper());
        let near = |found: &Tensor, expected: f64| (found.double_value(&[]) - expected).abs() < 1e-6;
        assert!(near(&losses.policy, -(1.3 - 2.0 - 1.4) / 3.0));
        assert!(near(&losses.value, (0.25 + 4.0 + 10.0) / 3.0));
        assert!(near(&losses.entropy, 0.5));
        assert!(near(&losses.kl, 0.3));
    }

    #[test]
    fn kl_coefficient_follows_the_reference() {
        let near = |a: f64, b: f64| (a - b).abs() < 1e-12;
        assert!(near(next_kl_coef(0.2, 0.021, 0.01), 0.3));
        assert!(near(next_kl_coef(0.2, 0.020, 0.01), 0.2));
        assert!(near(next_kl_coef(0.2, 0.005, 0.01), 0.2));
        assert!(near(next_kl_coef(0.2, 0.0049, 0.01), 0.1));
    }

    proptest! {
        #[test]
        fn every_episode_is_in_one_minibatch(
            lengths in proptest::collection::vec(1..300i64, 1..80), budget in 1..5000i64, seed in 0..1000u64,
        ) {
            let mut rng = stream(seed, 0, 0, Purpose::Shuffle);
            let parts = minibatches(&lengths, budget, &mut rng);
            let mut seen: Vec<usize> = parts.concat();
            seen.sort_unstable();
            prop_assert_eq!(seen, (0..lengths.len()).collect::<Vec<_>>());
            // A part is the budget, give or take what rounding to whole parts and whole episodes makes of it.
            let longest = lengths.iter().max().unwrap();
            for part in &parts {
                let steps: i64 = part.iter().map(|&episode| lengths[episode]).sum();
                prop_assert!(steps <= budget + budget / 2 + 2 * longest + 1);
            }
        }
    }
}
