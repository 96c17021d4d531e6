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
use crate::loss::{clamped_squared_error, surrogate};
use crate::minibatches::minibatches;

/// Means over all minibatches of all passes, weighted by steps.
#[derive(Clone, Copy, Debug, Default)]
pub struct UpdateMeans {
    /// Clipped surrogate loss.
    pub policy_loss: f64,
    /// Clamped squared error of the critic.
    pub value_loss: f64,
    /// KL(old || new), nats a step.
    pub kl: f64,
    /// The same, but each minibatch counts as much as any other: what the adaptive coefficient follows.
    pub minibatch_kl: f64,
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
        for (episodes, number) in minibatches(&batch.lengths, ppo, rng).into_iter().zip(1..) {
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
            policy.constrain();
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

/// The KL coefficient of the next epoch, given the mean KL of this one's minibatches: half again as large above twice the
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
        let surrogate = surrogate(&scores.log_prob, &self.old_log_probs, &self.advantages, ppo.clip);
        Losses {
            policy: -surrogate.mean(Kind::Float),
            value: clamped_squared_error(values, &self.targets, ppo.value_clip).mean(Kind::Float),
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
    /// Of the minibatches' KL, each once.
    kl: Tensor,
    minibatches: i64,
    steps: i64,
    computed_steps: i64,
}

impl Totals {
    fn new(device: Device) -> Self {
        let zeros = |count: i64| Tensor::zeros([count], (Kind::Double, device));
        Self { sums: zeros(5), kl: zeros(1), minibatches: 0, steps: 0, computed_steps: 0 }
    }

    fn add(&mut self, means: &[&Tensor; 5], steps: i64, computed_steps: i64) {
        tch::no_grad(|| {
            let means = Tensor::stack(means, 0).to_kind(Kind::Double);
            self.kl += means.narrow(0, 2, 1);
            self.sums += means * steps as f64;
        });
        self.minibatches += 1;
        self.steps += steps;
        self.computed_steps += computed_steps;
    }

    fn means(self) -> UpdateMeans {
        let means = Tensor::cat(&[self.sums / self.steps as f64, self.kl / self.minibatches as f64], 0);
        let means = Vec::<f64>::try_from(means.to_device(Device::Cpu)).expect("f64 numbers on the CPU are a vector");
        UpdateMeans {
            policy_loss: means[0],
            value_loss: means[1],
            kl: means[2],
            minibatch_kl: means[5],
            entropy: means[3],
            grad_norm: means[4],
            valid_fraction: self.steps as f64 / self.computed_steps as f64,
        }
    }
}

#[cfg(test)]
mod tests {
    use popgym_envs::space::Space;
    use popgym_envs::{Purpose, stream};
    use popgym_models::distribution::Evaluation;
    use popgym_models::{Packing, Policy};
    use popgym_proto::Episode;
    use tch::Tensor;

    use super::{Minibatch, Schedule, UpdateMeans, next_kl_coef, update};
    use crate::adam::{Adam, AdamOptions};
    use crate::batch::{Batch, tests};
    use crate::config::Ppo;
    use crate::minibatches::Minibatches;

    /// 60 episodes of 1 to 12 steps, from number `first` on and around.
    fn episodes(first: usize) -> Vec<Episode> {
        let episode = |k: usize| {
            let steps = 1 + k * 7 % 12;
            let observations: Vec<u8> = (0..=steps).map(|t| ((k + t * t) % 3) as u8).collect();
            let actions: Vec<u8> = (0..steps).map(|t| ((k + t) % 5 % 2) as u8).collect();
            tests::episode(k as u64, &observations, &actions, k.is_multiple_of(4))
        };
        (0..60).map(|k| episode((k + first) % 60)).collect()
    }

    /// One epoch's losses at learning rate 0, where the sampling policy has 1.8 times the weights.
    fn losses_at_rest(memory: &str, policy: &Policy, first: usize, seed: u64, ppo: &Ppo) -> UpdateMeans {
        let mut behaviour = tests::policy(memory, "");
        behaviour.load(&policy.to_bytes()).unwrap();
        tch::no_grad(|| {
            for weights in behaviour.parameters().values() {
                let _ = weights.shallow_clone().g_mul_scalar_(1.8);
            }
        });
        let ppo = Ppo { reward_scale: 0.1, ..ppo.clone() };
        let batch = Batch::new(&episodes(first), &Space::Discrete(2), policy);
        let old = batch.evaluate(&behaviour, &ppo);
        let options = AdamOptions { beta1: 0.9, beta2: 0.999, epsilon: 1e-8, max_grad_norm: 0.0 };
        let mut adam = Adam::new(policy.parameters(), options);
        let schedule = Schedule { learning_rate: 0.0, kl_coef: 0.5 };
        let mut rng = stream(seed, 0, 0, Purpose::Shuffle);
        update(policy, &mut adam, (&batch, &old), (&ppo, schedule), &mut rng, &|| false).unwrap()
    }

    /// Neither the order of episodes and minibatches nor what shares a minibatch, and so a packing, changes what is lost.
    #[test]
    fn losses_are_those_of_the_episodes() {
        for memory in ["gru", "fart", "tcn"] {
            let policy = tests::policy(memory, "");
            let losses = |first: usize, minibatch_steps: i64, minibatches: Minibatches, seed: u64| {
                let ppo = Ppo { minibatch_steps, minibatches, passes: 1, ..Ppo::paper() };
                losses_at_rest(memory, &policy, first, seed, &ppo)
            };
            let whole = losses(0, 1 << 20, Minibatches::Shuffled, 0);
            assert!(whole.kl > 1e-4 && whole.value_loss > 0.1, "the policies differ: {whole:?}");
            for (first, minibatch_steps, minibatches, seed) in [
                (0, 30, Minibatches::Shuffled, 0),
                (0, 30, Minibatches::Shuffled, 1),
                (0, 13, Minibatches::Fixed, 0),
                (0, 13, Minibatches::Fixed, 1),
                (17, 4, Minibatches::Shuffled, 2),
                (41, 1 << 20, Minibatches::Fixed, 3),
            ] {
                let parts = losses(first, minibatch_steps, minibatches, seed);
                for (name, found, expected) in [
                    ("policy loss", parts.policy_loss, whole.policy_loss),
                    ("value loss", parts.value_loss, whole.value_loss),
                    ("KL", parts.kl, whole.kl),
                    ("entropy", parts.entropy, whole.entropy),
                ] {
                    let what = format!("{memory}, {name}, minibatches of {minibatch_steps} steps, {minibatches:?}");
                    assert!(
                        (found - expected).abs() < 1e-5 * expected.abs().max(0.1),
                        "{what}: {found} and {expected}"
                    );
                }
            }
        }
    }

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
}
