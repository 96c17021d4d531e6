//! PPO's hyper-parameters: each is written once here, and from that come the configuration's `[ppo]` table, the flag
//! and the value in both presets.

use popgym_envs::EnvSpec;
use serde::{Deserialize, Serialize};

use crate::minibatches::Minibatches;

macro_rules! ppo_keys {
    ($( $(#[doc = $doc:literal])+ $name:ident: $type:ty = $paper:expr, $quick:expr; )+) => {
        /// Hyper-parameters of PPO: the configuration's `[ppo]` table.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct Ppo {
            $( $(#[doc = $doc])+ pub $name: $type, )+
        }

        /// The same as flags: what is given wins over file and preset.
        #[derive(Clone, Debug, Default, clap::Args, Serialize)]
        #[command(next_help_heading = "PPO")]
        pub struct PpoFlags {
            $( $(#[doc = $doc])+
            #[arg(long, value_name = "X", allow_hyphen_values = true)]
            #[serde(skip_serializing_if = "Option::is_none")]
            pub $name: Option<$type>, )+
        }

        impl Ppo {
            /// The paper's hyper-parameters, as in its code.
            pub fn paper() -> Self {
                Self { $( $name: $paper, )+ }
            }

            /// Tuned for wall-clock time on two cores. What must differ by environment follows from its specification; what each
            /// departure from the paper buys was measured, see `learner/studies/ablation.md`.
            pub fn quick(env: &EnvSpec) -> Self {
                let quick = Quick::new(env);
                Self { $( $name: ($quick)(&quick), )+ }
            }
        }
    };
}

ppo_keys! {
    /// Steps of an epoch: its batch is the shortest prefix of its episodes that has as many
    batch_steps: i64 = 65_536, |quick: &Quick| quick.batch_steps;
    /// Steps of a minibatch, about: whole episodes, shuffled
    minibatch_steps: i64 = 8_192, |quick: &Quick| quick.batch_steps / 8;
    /// fixed: episodes share a minibatch with the same ones in every pass, and what is left of the last is not used (as in
    /// the paper); shuffled: every pass cuts all episodes anew
    minibatches: Minibatches = Minibatches::Fixed, |_: &Quick| Minibatches::Shuffled;
    /// Passes over an epoch's batch
    passes: u32 = 30, |_: &Quick| 3;
    /// Discount of a step
    gamma: f64 = 0.99, |quick: &Quick| 1.0 - 1.0 / quick.horizon;
    /// Lambda of generalised advantage estimation
    gae_lambda: f64 = 1.0, |_: &Quick| 0.95;
    /// The surrogate's ratio is clipped to 1 - clip .. 1 + clip
    clip: f64 = 0.3, |_: &Quick| 0.3;
    /// The critic's squared error is clamped to 0 .. value_clip (inf: never)
    value_clip: f64 = 10.0, |_: &Quick| f64::INFINITY;
    /// Weight of the critic's loss
    value_coef: f64 = 1.0, |_: &Quick| 0.5;
    /// Weight of the entropy bonus
    entropy_coef: f64 = 0.0, |_: &Quick| 0.01;
    /// First coefficient of the KL term
    kl_coef: f64 = 0.2, |_: &Quick| 0.0;
    /// KL that the coefficient is adapted to, nats a step
    kl_target: f64 = 0.01, |_: &Quick| 0.01;
    /// Adam's learning rate
    learning_rate: f64 = 5e-5, |_: &Quick| 7e-4;
    /// constant, or linear: falling to 0 at the run's last step
    learning_rate_schedule: LearningRateSchedule = LearningRateSchedule::Constant, |_: &Quick| LearningRateSchedule::Constant;
    /// Adam's decay of the first moment
    adam_beta1: f64 = 0.9, |_: &Quick| 0.9;
    /// Adam's decay of the second moment
    adam_beta2: f64 = 0.999, |_: &Quick| 0.999;
    /// Adam's epsilon
    adam_epsilon: f64 = 1e-8, |_: &Quick| 1e-8;
    /// The gradient is scaled down to this norm (0: never)
    max_grad_norm: f64 = 0.0, |_: &Quick| 0.5;
    /// Rewards are multiplied by this before returns and values are computed
    reward_scale: f64 = 1.0, |quick: &Quick| quick.reward_scale;
    /// At a mere truncation, continue with the value of the last observation (false: a time limit is an end, as in the paper)
    bootstrap_at_truncation: bool = false, |_: &Quick| true;
    /// Cut gradients every so many steps of an episode while the state is carried (0: never)
    bptt: i64 = 0, |_: &Quick| 0;
}

/// How the learning rate changes over a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum LearningRateSchedule {
    /// Always the same.
    Constant,
    /// Falling linearly to 0 at the run's last step.
    Linear,
}

/// What `quick` derives from an environment.
struct Quick {
    batch_steps: i64,
    /// The discount's, in steps.
    horizon: f64,
    reward_scale: f64,
}

impl Quick {
    fn new(env: &EnvSpec) -> Self {
        let longest = i64::from(env.max_steps);
        // 64 of the longest episodes, but never so few steps that an update is noise, nor more than a second or two of
        // sampling.
        // A batch ends with a whole episode, so it may be an episode longer.
        let most = (16 * longest).max(16_384) - (longest - 1);
        let batch_steps = (64 * longest).clamp(8_192.min(most), most);
        // A tenth of the episode: the longer the game, the farther its consequences.
        let horizon = (longest as f64 / 10.0).clamp(10.0, 100.0);
        // Returns are within about +-1 and earned over the whole episode: this makes what is earned within the horizon, which
        // is what the critic predicts, of order 1 too.
        let (low, high) = env.return_range;
        let reward_scale = 2.0 * longest as f64 / (horizon * (high - low));
        Self { batch_steps, horizon, reward_scale }
    }
}

impl Ppo {
    /// Checks every value.
    ///
    /// # Errors
    /// The first key that is impossible, its value, and what is allowed.
    pub fn validate(&self) -> Result<(), String> {
        let check = |key: &str, value: f64, ok: bool, allowed: &str| {
            if ok { Ok(()) } else { Err(format!("ppo.{key} is {value}, allowed is {allowed}")) }
        };
        let unit = |key: &str, value: f64| check(key, value, (0.0..=1.0).contains(&value), "0 to 1");
        let positive = |key: &str, value: f64| check(key, value, value > 0.0 && value.is_finite(), "more than 0");
        let not_negative = |key: &str, value: f64| check(key, value, value >= 0.0 && value.is_finite(), "0 or more");
        let count = |key: &str, value: i64, least: i64| {
            check(key, value as f64, (least..=1 << 30).contains(&value), &format!("{least} to 1073741824"))
        };
        count("batch_steps", self.batch_steps, 1)?;
        count("minibatch_steps", self.minibatch_steps, 1)?;
        if self.minibatch_steps > self.batch_steps {
            return Err(format!(
                "ppo.minibatch_steps is {}, allowed is at most ppo.batch_steps, {}",
                self.minibatch_steps, self.batch_steps
            ));
        }
        count("passes", i64::from(self.passes), 1)?;
        count("bptt", self.bptt, 0)?;
        unit("gamma", self.gamma)?;
        unit("gae_lambda", self.gae_lambda)?;
        check("clip", self.clip, self.clip > 0.0 && self.clip < 1.0, "between 0 and 1, both excluded")?;
        check("value_clip", self.value_clip, self.value_clip > 0.0, "more than 0")?;
        not_negative("value_coef", self.value_coef)?;
        not_negative("entropy_coef", self.entropy_coef)?;
        not_negative("kl_coef", self.kl_coef)?;
        positive("kl_target", self.kl_target)?;
        positive("learning_rate", self.learning_rate)?;
        for (key, beta) in [("adam_beta1", self.adam_beta1), ("adam_beta2", self.adam_beta2)] {
            check(key, beta, (0.0..1.0).contains(&beta), "0 up to, but not, 1")?;
        }
        positive("adam_epsilon", self.adam_epsilon)?;
        not_negative("max_grad_norm", self.max_grad_norm)?;
        positive("reward_scale", self.reward_scale)
    }
}
