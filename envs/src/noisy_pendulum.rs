//! **NoisyPositionOnlyPendulum** (the paper's **NoisyStatelessPendulum**): swing up a pendulum without seeing its
//! velocity, and with noise on what is seen.
//!
//! | | |
//! |---|---|
//! | observation | `Box(2)`: cosine and sine of the angle from upright, each with normal noise |
//! | action | `Box(1)`: a torque in `[-2, 2]` N m; values beyond are clipped (a `VecEnv` refuses them) |
//! | reward | `(1 - cost / 8.1368022) / max_steps`, from `-1 / max_steps` to `1 / max_steps` |
//! | end | never terminates; truncates after exactly `max_steps` steps |
//! | state | `Box(3)`: cosine, sine, angular velocity (rad/s, within 8), without noise |
//!
//! Every observation, the first included, gets its own noise, which is then clipped with it to `[-1, 1]`. Quirk kept:
//! harder means noisier, not shorter as without noise: `max_steps` is 200 at every level.
//!
//! Source: Morad et al., ICLR 2023, the noisy environments; rules as in the Python package 1.0.7, which differs from the
//! version behind the paper's numbers only in the name. The pendulum and its rewards are those of [`crate::pendulum`].

use crate::canvas::{Canvas, View};
use crate::draws::{Draws, add_noise};
use crate::env::{Env, EnvSpec, Step, world_value};
use crate::pendulum::Pendulum;
pub use crate::pendulum::World;
use crate::rng::EpisodeRng;
use crate::space::{Slab, Value, ValueMut};

/// The size of a game.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Params {
    /// Length of every episode, in steps.
    pub max_steps: u32,
    /// Standard deviation of the noise on cosine and sine.
    pub sigma: f64,
}

/// Easy, medium, hard.
pub const LEVELS: [Params; 3] = [
    Params { max_steps: 200, sigma: 0.1 },
    Params { max_steps: 200, sigma: 0.2 },
    Params { max_steps: 200, sigma: 0.3 },
];

/// The game.
#[derive(Clone, Debug)]
pub struct NoisyPositionOnlyPendulum {
    spec: EnvSpec,
    rod: Pendulum,
    sigma: f64,
    /// The last observation.
    seen: [f32; 2],
}

impl NoisyPositionOnlyPendulum {
    /// A game of the given size, under the id `id`.
    ///
    /// # Panics
    /// If `sigma` is negative or not finite.
    pub fn new(id: &str, Params { max_steps, sigma }: Params) -> Self {
        assert!(sigma.is_finite() && sigma >= 0.0, "sigma is {sigma}");
        Self { spec: Pendulum::spec(id, max_steps), rod: Pendulum::new(max_steps), sigma, seen: [1.0, 0.0] }
    }

    #[inline]
    fn observe(&mut self, draws: &mut (impl Draws + ?Sized), out: &mut [f32]) {
        self.seen = add_noise(draws, self.sigma, self.rod.position(), [1.0; 2]);
        out.copy_from_slice(&self.seen);
    }
}

impl Env for NoisyPositionOnlyPendulum {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn draw_world(&mut self, rng: &mut EpisodeRng) {
        self.rod.draw_world(rng);
    }

    fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String> {
        self.rod.set_world(world)
    }

    fn world(&self) -> serde_json::Value {
        world_value(&self.rod.world())
    }

    fn begin(&mut self, draws: &mut dyn Draws, observation: ValueMut<'_>) {
        self.rod.begin();
        self.observe(draws, observation.real);
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let step = self.rod.step(action.real[0]);
        self.observe(draws, observation.real);
        step
    }

    fn step_all(
        envs: &mut [Self],
        rngs: &mut [EpisodeRng],
        actions: &Slab,
        observations: &mut Slab,
        steps: &mut [Step],
    ) {
        let rows = envs.iter_mut().zip(rngs).zip(&actions.real).zip(observations.real.chunks_exact_mut(2)).zip(steps);
        for ((((env, rng), &torque), out), step) in rows {
            *step = env.rod.step(torque);
            env.observe(rng, out);
        }
    }

    fn state(&self, state: ValueMut<'_>) {
        self.rod.write_state(state.real);
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        self.rod.render(view, self.seen, canvas);
    }
}
