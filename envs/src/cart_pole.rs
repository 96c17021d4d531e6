//! **PositionOnlyCartPole** (the paper's **StatelessCartPole**): balance a pole on a cart without seeing velocities.
//!
//! | | |
//! |---|---|
//! | observation | `Box(2)`: cart position (metres), pole angle from upright (radians) |
//! | action | `Discrete(2)`: push with 10 N to the left (0) or to the right (1) |
//! | reward | `1 / max_steps` each step, the one in which the pole falls included |
//! | end | terminates when the cart is beyond 2.4 m or the pole beyond 12 degrees; truncates after `max_steps` steps |
//! | state | `Box(4)`: position, velocity (m/s), angle, angular velocity (rad/s) |
//!
//! Both flags can be set in the same step. Quirks kept: the falling step is rewarded like any other, so a return is the
//! episode's length over `max_steps`; the paper's prose says that positions are hidden, but the environment hides the
//! velocities.
//!
//! Source: Morad et al., ICLR 2023, the control environments, after Barto, Sutton and Anderson (1983) as in Gymnasium's
//! CartPole; rules as in the Python package 1.0.7, which differs from the version behind the paper's numbers only in
//! the name. Arithmetic is in f64, in Gymnasium's order of operations: the task is chaotic, and one different last bit
//! is another episode some hundred steps later.

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step, parse_world};
use crate::rng::{EpisodeRng, uniform};
use crate::space::{Space, Value, ValueMut};

/// The size of a game.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Params {
    /// Length of an episode without a fall, in steps.
    pub max_steps: u32,
}

/// Easy, medium, hard.
pub const LEVELS: [Params; 3] = [Params { max_steps: 200 }, Params { max_steps: 400 }, Params { max_steps: 600 }];

const GRAVITY: f64 = 9.8;
const FORCE: f64 = 10.0;
const POLE_MASS: f64 = 0.1;
const TOTAL_MASS: f64 = 1.1;
const HALF_LENGTH: f64 = 0.5;
const POLE_MASS_LENGTH: f64 = 0.05;
const SECONDS_A_STEP: f64 = 0.02;
const X_LIMIT: f64 = 2.4;
const THETA_LIMIT: f64 = 12.0 * 2.0 * PI / 360.0;

/// What a reset draws.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// Position (m), velocity (m/s), angle (rad), angular velocity (rad/s); each uniform in `[-0.05, 0.05)` if drawn.
    pub state: [f64; 4],
}

/// The game.
#[derive(Clone, Debug)]
pub struct PositionOnlyCartPole {
    spec: EnvSpec,
    world: World,
    state: [f64; 4],
    steps: u32,
    reward: f64,
}

impl PositionOnlyCartPole {
    /// A game of the given size, under the id `id`.
    pub fn new(id: &str, Params { max_steps }: Params) -> Self {
        let (x, theta) = ((2.0 * X_LIMIT) as f32, (2.0 * THETA_LIMIT) as f32);
        let state = vec![x, f32::INFINITY, theta, f32::INFINITY];
        let spec = EnvSpec {
            id: id.to_owned(),
            observation: Space::Box { low: vec![-x, -theta], high: vec![x, theta] },
            action: Space::Discrete(2),
            state: Space::Box { low: state.iter().map(|bound| -bound).collect(), high: state },
            max_steps,
            return_range: (0.0, 1.0),
        };
        let world = World { state: [0.0; 4] };
        Self { spec, world, state: world.state, steps: 0, reward: 1.0 / f64::from(max_steps) }
    }

    fn observe(&self, out: &mut [f32]) {
        out[0] = self.state[0] as f32;
        out[1] = self.state[2] as f32;
    }
}

fn fallen(x: f64, theta: f64) -> bool {
    x.abs() > X_LIMIT || theta.abs() > THETA_LIMIT
}

/// One explicit Euler step under `force` (newtons, to the right).
fn advance([x, x_dot, theta, theta_dot]: [f64; 4], force: f64) -> [f64; 4] {
    let (sin, cos) = theta.sin_cos();
    // Squares first, then products from the left: see the module's note on the last bit.
    let push = (force + POLE_MASS_LENGTH * (theta_dot * theta_dot) * sin) / TOTAL_MASS;
    let theta_acc = (GRAVITY * sin - cos * push) / (HALF_LENGTH * (4.0 / 3.0 - POLE_MASS * (cos * cos) / TOTAL_MASS));
    let x_acc = push - POLE_MASS_LENGTH * theta_acc * cos / TOTAL_MASS;
    [
        x + SECONDS_A_STEP * x_dot,
        x_dot + SECONDS_A_STEP * x_acc,
        theta + SECONDS_A_STEP * theta_dot,
        theta_dot + SECONDS_A_STEP * theta_acc,
    ]
}

impl Env for PositionOnlyCartPole {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn draw_world(&mut self, rng: &mut EpisodeRng) {
        for part in &mut self.world.state {
            *part = uniform(rng, -0.05, 0.05);
        }
    }

    fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String> {
        let world: World = parse_world(world)?;
        if !world.state.iter().all(|part| part.is_finite()) {
            return Err(format!("the state {:?} is not finite", world.state));
        }
        if fallen(world.state[0], world.state[2]) {
            return Err(format!("the state {:?} is a fall already", world.state));
        }
        self.world = world;
        Ok(())
    }

    fn begin(&mut self, _draws: &mut dyn Draws, observation: ValueMut<'_>) {
        self.state = self.world.state;
        self.steps = 0;
        self.observe(observation.real);
    }

    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let force = if action.discrete[0] == 1 { FORCE } else { -FORCE };
        self.state = advance(self.state, force);
        self.steps += 1;
        self.observe(observation.real);
        Step {
            reward: self.reward,
            terminated: fallen(self.state[0], self.state[2]),
            truncated: self.steps >= self.spec.max_steps,
        }
    }

    fn state(&self, state: ValueMut<'_>) {
        for (out, &part) in state.real.iter_mut().zip(&self.state) {
            *out = part as f32;
        }
    }
}
