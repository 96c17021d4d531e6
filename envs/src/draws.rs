//! Per-step draws: the randomness of an episode after its reset (bandit payouts, observation noise).

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4};

use rand::RngExt;

use crate::rng::EpisodeRng;

/// Where an environment takes its per-step draws from: the episode's stream, or a recording.
pub trait Draws {
    /// Uniform in `[0, 1)`.
    fn uniform(&mut self) -> f64;

    /// Two independent normal numbers with mean 0 and standard deviation `sigma`.
    fn normal_pair(&mut self, sigma: f64) -> [f64; 2];
}

impl Draws for EpisodeRng {
    fn uniform(&mut self) -> f64 {
        self.random()
    }

    #[inline]
    fn normal_pair(&mut self, sigma: f64) -> [f64; 2] {
        // Box and Muller, "A Note on the Generation of Random Normal Deviates", 1958; 1 - u is in (0, 1], so that the
        // logarithm is finite.
        let (u, bits): (f64, u64) = (self.random(), self.random());
        let radius = sigma * (-2.0 * (1.0 - u).ln()).sqrt();
        // An angle within an eighth of a turn, where sine and cosine are fastest, and then 0 to 3 quarter turns.
        let within = (bits >> 11) as f64 * (0.5_f64.powi(53) * FRAC_PI_2) - FRAC_PI_4;
        let (sin, cos) = within.sin_cos();
        let turned = [cos, -sin, -cos, sin];
        let quarter = (bits & 3) as usize;
        [radius * turned[quarter], radius * turned[(quarter + 3) & 3]]
    }
}

/// An observation with independent normal noise on both numbers, clipped to plus or minus `limits`. The sum is formed in
/// f32, as the Python package does.
#[inline]
pub(crate) fn add_noise<D: Draws + ?Sized>(draws: &mut D, sigma: f64, clean: [f32; 2], limits: [f32; 2]) -> [f32; 2] {
    let noise = draws.normal_pair(sigma);
    [0, 1].map(|i| (clean[i] + noise[i] as f32).clamp(-limits[i], limits[i]))
}

/// A recorded list, handed out in order; `normal_pair` gives the recorded values as they are (recordings hold scaled
/// noise). Panics when nothing is left.
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

    fn normal_pair(&mut self, _sigma: f64) -> [f64; 2] {
        [self.next(), self.next()]
    }
}
