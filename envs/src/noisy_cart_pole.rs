//! **NoisyPositionOnlyCartPole** (the paper's **NoisyStatelessCartPole**): balance a pole on a cart without seeing
//! velocities, and with noise on what is seen.
//!
//! | | |
//! |---|---|
//! | observation | `Box(2)`: cart position (metres) and pole angle from upright (radians), each with normal noise |
//! | action | `Discrete(2)`: push with 10 N to the left (0) or to the right (1) |
//! | reward | `1 / max_steps` each step, the one in which the pole falls included |
//! | end | terminates when the cart is beyond 2.4 m or the pole beyond 12 degrees; truncates after `max_steps` steps |
//! | state | `Box(4)`: position, velocity (m/s), angle, angular velocity (rad/s), without noise |
//!
//! Every observation, the first included, gets its own noise, which is then clipped with it to the observation space.
//! Quirks kept: position and angle get the same standard deviation, although the angle of a standing pole stays within
//! 0.21 rad; harder means noisier, not longer: `max_steps` is 200 at every level.
//!
//! Source: Morad et al., ICLR 2023, the noisy environments; rules as in the Python package 1.0.7, which differs from the
//! version behind the paper's numbers only in the name. The cart and its pole are those of [`crate::cart_pole`].

use crate::canvas::{Canvas, View};
pub use crate::cart_pole::World;
use crate::cart_pole::{ACTIONS, CartPole, OBSERVED_LIMITS};
use crate::draws::{Draws, add_noise};
use crate::env::{Env, EnvSpec, Step, world_value};
use crate::rng::EpisodeRng;
use crate::space::{Slab, Value, ValueMut};

/// The size of a game.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Params {
    /// Length of an episode without a fall, in steps.
    pub max_steps: u32,
    /// Standard deviation of the noise, in metres and in radians.
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
pub struct NoisyPositionOnlyCartPole {
    spec: EnvSpec,
    cart: CartPole,
    sigma: f64,
    /// The last observation.
    seen: [f32; 2],
}

impl NoisyPositionOnlyCartPole {
    /// A game of the given size, under the id `id`.
    ///
    /// # Panics
    /// If `sigma` is negative or not finite.
    pub fn new(id: &str, Params { max_steps, sigma }: Params) -> Self {
        assert!(sigma.is_finite() && sigma >= 0.0, "sigma is {sigma}");
        let spec = CartPole::spec(id, OBSERVED_LIMITS, max_steps);
        Self { spec, cart: CartPole::new(max_steps), sigma, seen: [0.0; 2] }
    }

    #[inline]
    fn observe(&mut self, draws: &mut (impl Draws + ?Sized), out: &mut [f32]) {
        self.seen = add_noise(draws, self.sigma, self.cart.positions(), OBSERVED_LIMITS);
        out.copy_from_slice(&self.seen);
    }
}

impl Env for NoisyPositionOnlyCartPole {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn draw_world(&mut self, rng: &mut EpisodeRng) {
        self.cart.draw_world(rng);
    }

    fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String> {
        self.cart.set_world(world)
    }

    fn world(&self) -> serde_json::Value {
        world_value(&self.cart.world())
    }

    fn begin(&mut self, draws: &mut dyn Draws, observation: ValueMut<'_>) {
        self.cart.begin();
        self.observe(draws, observation.real);
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let step = self.cart.step(action.discrete[0]);
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
        CartPole::step_all(envs, |env| &mut env.cart, &actions.discrete, steps);
        for ((env, rng), out) in envs.iter_mut().zip(rngs).zip(observations.real.chunks_exact_mut(2)) {
            env.observe(rng, out);
        }
    }

    fn state(&self, state: ValueMut<'_>) {
        self.cart.write_state(state.real);
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        self.cart.render(view, self.seen, canvas);
    }

    fn action_names(&self) -> &'static [&'static str] {
        ACTIONS
    }
}
