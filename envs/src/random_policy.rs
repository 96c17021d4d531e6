//! What acting at random returns: the baseline that any score stands beside.

use crate::registry::{MakeError, Registry};
use crate::rng::{Purpose, stream};
use crate::space::Slab;
use crate::vec_env::VecEnv;

/// The returns of one episode after the other, acted in uniformly at random. Has no end.
///
/// ```
/// use popgym_envs::{Registry, random_policy::random_returns};
///
/// let returns: Vec<f64> = random_returns(&Registry::standard(), "RepeatFirstEasy", 0)?.take(100).collect();
/// let mean = returns.iter().sum::<f64>() / 100.0;
/// assert!((-1.0..0.0).contains(&mean));
/// # Ok::<(), popgym_envs::MakeError>(())
/// ```
pub struct RandomReturns {
    envs: VecEnv,
    observations: Slab,
    actions: Slab,
    seed: u64,
    episode: u64,
}

/// The returns of uniformly random actions in the environment that answers to `name`; the same for the same seed.
///
/// # Errors
/// If `registry` has no such environment.
pub fn random_returns(registry: &Registry, name: &str, seed: u64) -> Result<RandomReturns, MakeError> {
    let envs = VecEnv::new(registry, name, 1)?;
    Ok(RandomReturns { observations: envs.observations(), actions: envs.actions(), seed, episode: 0, envs })
}

impl Iterator for RandomReturns {
    type Item = f64;

    fn next(&mut self) -> Option<f64> {
        let stream = |purpose| stream(self.seed, 0, self.episode, purpose);
        let mut policy = stream(Purpose::EvalAction);
        self.envs.begin(0, stream(Purpose::EvalEnv), &mut self.observations);
        self.episode += 1;
        let mut total = 0.0;
        // An environment that goes on beyond its own limit is cut off there.
        for _ in 0..self.envs.spec().max_steps {
            self.envs.spec().action.sample_into(&mut policy, self.actions.row_mut(0));
            let step = self.envs.step(0, self.actions.row(0), &mut self.observations);
            let step = step.expect("the episode has begun, and a sample of the action space is an action");
            total += step.reward;
            if step.done() {
                break;
            }
        }
        Some(total)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repeat_first_at_random() {
        // One answer in four is right: 1/4 - 3/4, whatever the size.
        for name in ["RepeatFirstEasy", "RepeatFirstMedium", "RepeatFirstHard"] {
            let returns: Vec<f64> = random_returns(&Registry::standard(), name, 3).unwrap().take(400).collect();
            let mean = returns.iter().sum::<f64>() / 400.0;
            let variance = returns.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 399.0;
            let standard_error = (variance / 400.0).sqrt();
            assert!(standard_error > 0.0 && (mean + 0.5).abs() < 4.0 * standard_error, "{name}: {mean}");
        }
    }

    #[test]
    fn the_seed_decides() {
        let returns = |seed| random_returns(&Registry::standard(), "BattleshipEasy", seed).unwrap().take(3);
        assert!(returns(1).eq(returns(1)));
        assert!(!returns(1).eq(returns(2)));
        assert!(random_returns(&Registry::standard(), "Battleships", 0).is_err());
    }
}
