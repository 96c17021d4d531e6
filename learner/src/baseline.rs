//! What acting at random scores, measured where it is asked for.

use std::time::{Duration, Instant};

use popgym_envs::random_policy::random_returns;
use popgym_envs::{MakeError, Registry};
use serde::Serialize;

use crate::gae::mean_and_variance;

/// Episodes of a measurement.
pub const EPISODES: usize = 200;

/// The returns of the random policy in an environment.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Baseline {
    /// Their mean.
    pub mean: f64,
    /// The standard error of the mean; of one episode it is not a number.
    pub standard_error: f64,
    /// Of how many episodes.
    pub episodes: usize,
}

impl Baseline {
    /// Plays [`EPISODES`] episodes, or, where an environment is slow, as many as end within `budget`; at least one.
    ///
    /// # Errors
    /// If `envs` has no such environment.
    pub fn measure(envs: &Registry, name: &str, budget: Duration) -> Result<Self, MakeError> {
        let start = Instant::now();
        let mut all = random_returns(envs, name, 0)?.take(EPISODES);
        let mut returns: Vec<f64> = all.by_ref().take(1).collect();
        returns.extend(all.take_while(|_| start.elapsed() < budget));
        Ok(Self::of(&returns))
    }

    fn of(returns: &[f64]) -> Self {
        let (mean, variance) = mean_and_variance(returns);
        let episodes = returns.len();
        // Of the mean, from the sample variance; a single episode tells nothing of it.
        let standard_error = if episodes > 1 { (variance / (episodes - 1) as f64).sqrt() } else { f64::NAN };
        Self { mean, standard_error, episodes }
    }
}

impl std::fmt::Display for Baseline {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.3}", self.mean)?;
        if self.standard_error.is_finite() { write!(f, " +- {:.3}", self.standard_error) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_returns() {
        let found = Baseline::of(&[1.0, 2.0, 6.0]);
        // Sample variance 7, of the mean 7 / 3.
        assert_eq!((found.mean, found.episodes), (3.0, 3));
        assert!((found.standard_error - (7.0_f64 / 3.0).sqrt()).abs() < 1e-12);
        assert_eq!(found.to_string(), "3.000 +- 1.528");
        assert_eq!(Baseline::of(&[0.5]).to_string(), "0.500");
    }

    #[test]
    fn within_the_budget() {
        let envs = Registry::standard();
        let measure = |budget| Baseline::measure(&envs, "RepeatFirstEasy", budget).unwrap();
        assert_eq!(measure(Duration::ZERO).episodes, 1);
        let whole = measure(Duration::from_mins(1));
        assert_eq!(whole.episodes, EPISODES);
        assert!((whole.mean + 0.5).abs() < 4.0 * whole.standard_error);
    }
}
