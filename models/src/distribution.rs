//! Action distributions: what the numbers of the actor head mean.
//!
//! A discrete component is a categorical with its own logits; components are independent, so log-probabilities,
//! entropies and divergences add up. Real components are a diagonal Gaussian, unsquashed: its sample `a` is what is stored
//! and scored, and the environment receives `clip(low + (a + 1) (high - low) / 2, low, high)` (RLlib's
//! `normalize_actions`). Parameters of a row: all logits, then the means, then the logarithms of the standard deviations.

use popgym_envs::rng::EpisodeRng;
use popgym_envs::space::{Leaf, Space, Value, ValueMut};
use rand::RngExt;
use tch::{Kind, Tensor};

use crate::ModelError;

/// ln sqrt(2 pi), of the normal density.
const LN_SQRT_TAU: f64 = 0.918_938_533_204_672_8;

/// The distribution over an action space, given by a row of parameters.
#[derive(Clone, Debug)]
pub struct ActionDistribution {
    /// Number of classes of each discrete component.
    classes: Vec<usize>,
    /// Bounds of each real component.
    bounds: Vec<(f32, f32)>,
    /// Sum of `classes`: where the means start.
    logits: usize,
    log_std_bounds: (f64, f64),
}

/// Quantities of a batch of rows, each `[rows]`, summed over the components of the action.
pub struct Evaluation {
    /// Log-probability (density) of the given actions.
    pub log_prob: Tensor,
    /// Entropy, nats.
    pub entropy: Tensor,
    /// KL(old || new), nats, exact.
    pub kl: Tensor,
}

/// The distribution of each component of an action. Components are independent, so this is all there is to know of a row.
#[derive(Clone, Debug, PartialEq)]
pub struct Marginals {
    /// Of each discrete component: the probabilities of its classes.
    pub classes: Vec<Vec<f64>>,
    /// Of each real component: mean and standard deviation, in the environment's units and before clipping.
    pub reals: Vec<(f64, f64)>,
    /// Entropy of the action, nats: real components count as they are stored, like [`Evaluation::entropy`].
    pub entropy: f64,
}

impl ActionDistribution {
    /// The distribution over `action`, with log standard deviations kept within `log_std_bounds`.
    ///
    /// # Errors
    /// An action space without components.
    pub fn new(action: &Space, log_std_bounds: (f64, f64)) -> Result<Self, ModelError> {
        let mut distribution = Self { classes: Vec::new(), bounds: Vec::new(), logits: 0, log_std_bounds };
        for leaf in action.leaves() {
            match leaf {
                Leaf::Discrete { classes } => distribution.classes.push(usize::from(classes)),
                Leaf::Real { low, high } => distribution.bounds.push((low, high)),
            }
        }
        distribution.logits = distribution.classes.iter().sum();
        if distribution.width() == 0 {
            return Err(ModelError::Space { which: "action", problem: "it has no components".to_owned() });
        }
        Ok(distribution)
    }

    /// Number of parameters of a row.
    pub fn width(&self) -> usize {
        self.logits + 2 * self.bounds.len()
    }

    /// The space of the actions that are stored and scored: real components unbounded.
    pub fn stored_space(&self) -> Space {
        let discrete = Space::MultiDiscrete(self.classes.iter().map(|&classes| classes as u16).collect());
        let real = Space::uniform_box(self.bounds.len(), f32::NEG_INFINITY, f32::INFINITY);
        Space::Tuple(vec![discrete, real])
    }

    /// Draws an action from one row of parameters, writes its stored form, and returns its log-probability.
    pub fn sample(&self, params: &[f32], rng: &mut EpisodeRng, action: ValueMut<'_>) -> f32 {
        let (mut log_prob, mut at) = (0.0, 0);
        for (&classes, out) in self.classes.iter().zip(action.discrete) {
            let (class, class_log_prob) = sample_class(&params[at..at + classes], rng.random());
            *out = class as u8;
            log_prob += class_log_prob;
            at += classes;
        }
        let (means, log_stds) = params[at..].split_at(self.bounds.len());
        for ((&mean, &log_std), out) in means.iter().zip(log_stds).zip(action.real) {
            let (mean, std) = (f64::from(mean), f64::from(log_std).exp());
            *out = (mean + std * popgym_envs::Draws::normal_pair(rng, 1.0)[0]) as f32;
            // Of the number as it is stored: rounding may have moved it by many narrow standard deviations.
            let noise = (f64::from(*out) - mean) / std;
            log_prob += -0.5 * noise * noise - f64::from(log_std) - LN_SQRT_TAU;
        }
        log_prob as f32
    }

    /// Writes the stored form of the most probable action of one row of parameters: of each discrete component the likeliest
    /// class (the first of equals), of each real one the mean.
    pub fn mode(&self, params: &[f32], action: ValueMut<'_>) {
        let mut at = 0;
        for (&classes, out) in self.classes.iter().zip(action.discrete) {
            let logits = &params[at..at + classes];
            let likeliest = (1..classes).fold(0, |best, class| if logits[class] > logits[best] { class } else { best });
            *out = likeliest as u8;
            at += classes;
        }
        action.real.copy_from_slice(&params[at..at + self.bounds.len()]);
    }

    /// What one row of parameters says of each component.
    pub fn marginals(&self, params: &[f32]) -> Marginals {
        let mut marginals = Marginals { classes: Vec::new(), reals: Vec::new(), entropy: 0.0 };
        let mut at = 0;
        for &classes in &self.classes {
            let probabilities = softmax(&params[at..at + classes]);
            let terms = probabilities.iter().filter(|&&p| p > 0.0).map(|p| -p * p.ln());
            marginals.entropy += terms.sum::<f64>();
            marginals.classes.push(probabilities);
            at += classes;
        }
        let (means, log_stds) = params[at..].split_at(self.bounds.len());
        for ((&mean, &log_std), &(low, high)) in means.iter().zip(log_stds).zip(&self.bounds) {
            let [mean, log_std, low, high] = [mean, log_std, low, high].map(f64::from);
            marginals.entropy += log_std + LN_SQRT_TAU + 0.5;
            // As `to_env` maps them.
            let bounded = low.is_finite() && high.is_finite();
            let (middle, half) = if bounded { (f64::midpoint(low, high), (high - low) / 2.0) } else { (0.0, 1.0) };
            marginals.reals.push((middle + mean * half, log_std.exp() * half));
        }
        marginals
    }

    /// The environment's form of a stored action: discrete components as they are, real ones mapped and clipped.
    pub fn to_env(&self, action: Value<'_>, out: ValueMut<'_>) {
        out.discrete.copy_from_slice(action.discrete);
        for ((&a, &(low, high)), out) in action.real.iter().zip(&self.bounds).zip(out.real) {
            *out = if low.is_finite() && high.is_finite() {
                (low + (a + 1.0) * (high - low) / 2.0).clamp(low, high)
            } else {
                a.clamp(low, high)
            };
        }
    }

    /// Keeps the log standard deviations of `params [rows, width]` within their bounds.
    pub(crate) fn bound(&self, params: Tensor) -> Tensor {
        let (low, high) = self.log_std_bounds;
        if self.bounds.is_empty() || (low == f64::NEG_INFINITY && high == f64::INFINITY) {
            return params;
        }
        let reals = self.bounds.len() as i64;
        let log_std_at = self.logits as i64 + reals;
        let log_std = params.narrow(1, log_std_at, reals).clamp(low, high);
        Tensor::cat(&[params.narrow(1, 0, log_std_at), log_std], 1)
    }

    /// Scores stored actions (`discrete` i64 `[rows, discrete components]`, `real` f32 `[rows, real components]`) under
    /// `params [rows, width]`, and measures the divergence of `params` from `old_params`.
    pub fn evaluate(&self, params: &Tensor, old_params: &Tensor, discrete: &Tensor, real: &Tensor) -> Evaluation {
        let zero = || Tensor::zeros([params.size()[0]], (Kind::Float, params.device()));
        let mut sum = Evaluation { log_prob: zero(), entropy: zero(), kl: zero() };
        let mut at = 0;
        for (component, &classes) in self.classes.iter().enumerate() {
            let log_p = params.narrow(1, at, classes as i64).log_softmax(-1, Kind::Float);
            let old_log_p = old_params.narrow(1, at, classes as i64).log_softmax(-1, Kind::Float);
            let chosen = discrete.narrow(1, component as i64, 1);
            sum.log_prob += log_p.gather(1, &chosen, false).squeeze_dim(1);
            sum.entropy -= (log_p.exp() * &log_p).sum_dim_intlist(1, false, Kind::Float);
            sum.kl += (old_log_p.exp() * (old_log_p - log_p)).sum_dim_intlist(1, false, Kind::Float);
            at += classes as i64;
        }
        if !self.bounds.is_empty() {
            let reals = self.bounds.len() as i64;
            let (mean, log_std) = (params.narrow(1, at, reals), params.narrow(1, at + reals, reals));
            let (old_mean, old_log_std) = (old_params.narrow(1, at, reals), old_params.narrow(1, at + reals, reals));
            let noise = (real - &mean) * (-&log_std).exp();
            let log_prob: Tensor = -(noise.square() * 0.5 + &log_std + LN_SQRT_TAU);
            let entropy = &log_std + (LN_SQRT_TAU + 0.5);
            let variance_ratio = ((&old_log_std - &log_std) * 2.0).exp();
            let shift = (&old_mean - &mean) * (-&log_std).exp();
            let kl = (variance_ratio + shift.square() - 1.0) * 0.5 + &log_std - &old_log_std;
            let total = |x: Tensor| x.sum_dim_intlist(1, false, Kind::Float);
            sum.log_prob += total(log_prob);
            sum.entropy += total(entropy);
            sum.kl += total(kl);
        }
        sum
    }
}

/// The probabilities of classes with these logits.
fn softmax(logits: &[f32]) -> Vec<f64> {
    let largest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let weights: Vec<f64> = logits.iter().map(|&logit| f64::from(logit - largest).exp()).collect();
    let total: f64 = weights.iter().sum();
    weights.iter().map(|weight| weight / total).collect()
}

/// The class that `uniform` in `[0, 1)` falls on when the classes' probabilities are laid end to end, and its log-probability.
fn sample_class(logits: &[f32], uniform: f64) -> (usize, f64) {
    let largest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let weight = |logit: f32| f64::from((logit - largest).exp());
    let total: f64 = logits.iter().map(|&logit| weight(logit)).sum();
    let mut rest = uniform * total;
    let mut chosen = 0;
    for (class, &logit) in logits.iter().enumerate() {
        let weight = weight(logit);
        // Rounding may leave a rest after the last class: then the last one that is possible at all is taken.
        if weight > 0.0 {
            chosen = class;
            if rest < weight {
                break;
            }
        }
        rest -= weight;
    }
    (chosen, f64::from(logits[chosen] - largest) - total.ln())
}
