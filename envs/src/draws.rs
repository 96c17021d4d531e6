//! Per-step draws: the randomness of an episode after its reset (bandit payouts, observation noise).

use rand::RngExt;

use crate::rng::EpisodeRng;

/// Where an environment takes its per-step draws from: the episode's stream, or a recording.
pub trait Draws {
    /// Uniform in `[0, 1)`.
    fn uniform(&mut self) -> f64;

    /// Normal with mean 0 and standard deviation `sigma`.
    fn normal(&mut self, sigma: f64) -> f64;
}

impl Draws for EpisodeRng {
    fn uniform(&mut self) -> f64 {
        self.random()
    }

    fn normal(&mut self, sigma: f64) -> f64 {
        // Box-Muller; 1 - u is in (0, 1], so that the logarithm is finite.
        let (u, v): (f64, f64) = (self.random(), self.random());
        sigma * (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
    }
}

/// A recorded list, handed out in order; `normal` gives the recorded value as it is (recordings hold scaled noise).
#[derive(Clone, Debug, Default)]
pub struct Recorded {
    values: std::collections::VecDeque<f64>,
}

impl Recorded {
    /// Draws `values` from the first to the last.
    pub fn new(values: impl IntoIterator<Item = f64>) -> Self {
        Self { values: values.into_iter().collect() }
    }

    fn next(&mut self) -> f64 {
        self.values.pop_front().expect("the recording holds fewer draws than the episode makes")
    }
}

impl Draws for Recorded {
    fn uniform(&mut self) -> f64 {
        self.next()
    }

    fn normal(&mut self, _sigma: f64) -> f64 {
        self.next()
    }
}
