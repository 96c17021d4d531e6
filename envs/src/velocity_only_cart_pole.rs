//! **VelocityOnlyCartPole** (not in the paper): balance a pole on a cart without seeing where they are.
//!
//! | | |
//! |---|---|
//! | observation | `Box(2)`: the cart's velocity (m/s), the pole's angular velocity (rad/s); at first position and angle |
//! | action | `Discrete(2)`: push with 10 N to the left (0) or to the right (1) |
//! | reward | `1 / max_steps` each step, the one in which the pole falls included |
//! | end | terminates when the cart is beyond 2.4 m or the pole beyond 12 degrees; truncates after `max_steps` steps |
//! | state | `Box(4)`: position, velocity (m/s), angle, angular velocity (rad/s) |
//!
//! Quirks kept: the first observation of an episode holds the cart's position (m) and the pole's angle (rad), where
//! every later one holds velocities; the bounds of the observation space are infinite; the falling step is rewarded like
//! any other. The id alone spells the name with a lower-case p: `popgym-VelocityOnlyCartpoleEasy-v0`.
//!
//! Source: the Python package 1.0.7. The cart and its pole are those of [`crate::cart_pole`].

use crate::canvas::{Canvas, View};
use crate::cart_pole::{ACTIONS, CartPole};
use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step, world_value};
use crate::rng::EpisodeRng;
use crate::space::{Slab, Value, ValueMut};

pub use crate::cart_pole::{LEVELS, Params, World};

/// The game.
#[derive(Clone, Debug)]
pub struct VelocityOnlyCartPole {
    spec: EnvSpec,
    cart: CartPole,
}

impl VelocityOnlyCartPole {
    /// A game of the given size, under the id `id`.
    pub fn new(id: &str, Params { max_steps }: Params) -> Self {
        Self { spec: CartPole::spec(id, [f32::INFINITY; 2], max_steps), cart: CartPole::new(max_steps) }
    }
}

impl Env for VelocityOnlyCartPole {
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

    fn begin(&mut self, _draws: &mut dyn Draws, observation: ValueMut<'_>) {
        self.cart.begin();
        observation.real.copy_from_slice(&self.cart.positions());
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let step = self.cart.step(action.discrete[0]);
        observation.real.copy_from_slice(&self.cart.velocities());
        step
    }

    fn step_all(
        envs: &mut [Self],
        _rngs: &mut [EpisodeRng],
        actions: &Slab,
        observations: &mut Slab,
        steps: &mut [Step],
    ) {
        CartPole::step_all(envs, |env| &mut env.cart, &actions.discrete, steps);
        for (env, out) in envs.iter().zip(observations.real.as_chunks_mut().0) {
            *out = env.cart.velocities();
        }
    }

    fn state(&self, state: ValueMut<'_>) {
        self.cart.write_state(state.real);
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        match view {
            View::Observed if self.cart.is_new() => self.cart.render(view, self.cart.positions(), canvas),
            View::Observed => self.cart.draw_velocities(self.cart.velocities(), canvas),
            View::Revealed => self.cart.reveal(canvas),
        }
    }

    fn action_names(&self) -> &'static [&'static str] {
        ACTIONS
    }
}
