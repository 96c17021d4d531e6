//! **PositionOnlyPendulum** (the paper's **StatelessPendulum**): swing up a pendulum without seeing its velocity.
//!
//! | | |
//! |---|---|
//! | observation | `Box(2)`: cosine and sine of the angle from upright |
//! | action | `Box(1)`: a torque in `[-2, 2]` N m; values beyond are clipped |
//! | reward | `(1 - cost / 8.1368022) / max_steps`, from `-1 / max_steps` to `1 / max_steps` |
//! | end | never terminates; truncates after exactly `max_steps` steps |
//! | state | `Box(3)`: cosine, sine, angular velocity (rad/s, within 8) |
//!
//! The cost, `angle^2 + 0.1 velocity^2 + 0.001 torque^2`, is that of the state before the step. Quirks kept: harder
//! means shorter; the paper's prose says that positions are hidden, but the environment hides the velocity.
//!
//! Source: Morad et al., ICLR 2023, the control environments, after Gymnasium's Pendulum; rules as in the Python package
//! 1.0.7, which differs from the version behind the paper's numbers only in the name. Arithmetic is in f64 except for
//! two terms of the torque, which the package rounds to f32: the task is chaotic, and one different last bit is another
//! episode some hundred steps later.

use std::f64::consts::{PI, TAU};

use serde::{Deserialize, Serialize};

use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step, parse_world};
use crate::rng::{EpisodeRng, uniform};
use crate::space::{Space, Value, ValueMut};

/// The size of a game.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Params {
    /// Length of every episode, in steps.
    pub max_steps: u32,
}

/// Easy, medium, hard.
pub const LEVELS: [Params; 3] = [Params { max_steps: 200 }, Params { max_steps: 150 }, Params { max_steps: 100 }];

/// Largest torque (N m).
pub const MAX_TORQUE: f32 = 2.0;
const MAX_SPEED: f64 = 8.0;
const SECONDS_A_STEP: f64 = 0.05;
/// `3 g / (2 l)` with `g = 10`, `l = 1`.
const GRAVITY_TERM: f64 = 15.0;
/// Half of the largest cost, pi^2 + 0.1 * 8^2 + 0.001 * 2^2.
const HALF_COST: f64 = 8.136_802_2;

/// What a reset draws.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// Angle from upright (rad), uniform in `[-pi, pi)` if drawn.
    pub theta: f64,
    /// Angular velocity (rad/s), uniform in `[-1, 1)` if drawn.
    pub theta_dot: f64,
}

/// The game.
#[derive(Clone, Debug)]
pub struct PositionOnlyPendulum {
    spec: EnvSpec,
    world: World,
    theta: f64,
    theta_dot: f64,
    /// Of `theta`: each is needed for an observation and again for the next step.
    sin_cos: (f64, f64),
    steps: u32,
}

impl PositionOnlyPendulum {
    /// A game of the given size, under the id `id`.
    pub fn new(id: &str, Params { max_steps }: Params) -> Self {
        let max_speed = MAX_SPEED as f32;
        let spec = EnvSpec {
            id: id.to_owned(),
            observation: Space::uniform_box(2, -1.0, 1.0),
            action: Space::uniform_box(1, -MAX_TORQUE, MAX_TORQUE),
            state: Space::Box { low: vec![-1.0, -1.0, -max_speed], high: vec![1.0, 1.0, max_speed] },
            max_steps,
            return_range: (-1.0, 1.0),
        };
        let world = World { theta: 0.0, theta_dot: 0.0 };
        Self { spec, world, theta: 0.0, theta_dot: 0.0, sin_cos: (0.0, 1.0), steps: 0 }
    }

    fn observe(&mut self, out: &mut [f32]) {
        self.sin_cos = self.theta.sin_cos();
        out[0] = self.sin_cos.1 as f32;
        out[1] = self.sin_cos.0 as f32;
    }
}

/// The angle's representative in `[-pi, pi)`.
fn wrap(angle: f64) -> f64 {
    (angle + PI).rem_euclid(TAU) - PI
}

impl Env for PositionOnlyPendulum {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn draw_world(&mut self, rng: &mut EpisodeRng) {
        self.world = World { theta: uniform(rng, -PI, PI), theta_dot: uniform(rng, -1.0, 1.0) };
    }

    fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String> {
        let world: World = parse_world(world)?;
        if !world.theta.is_finite() {
            return Err(format!("theta is {}", world.theta));
        }
        if !(-MAX_SPEED..=MAX_SPEED).contains(&world.theta_dot) {
            return Err(format!("theta_dot is {}, allowed is {}..={MAX_SPEED}", world.theta_dot, -MAX_SPEED));
        }
        self.world = world;
        Ok(())
    }

    fn begin(&mut self, _draws: &mut dyn Draws, observation: ValueMut<'_>) {
        (self.theta, self.theta_dot) = (self.world.theta, self.world.theta_dot);
        self.steps = 0;
        self.observe(observation.real);
    }

    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let torque = action.real[0].clamp(-MAX_TORQUE, MAX_TORQUE);
        // Rounded to f32 before they are widened: see the module's note on the last bit.
        let (push, effort) = (f64::from(3.0 * torque), f64::from(0.001 * (torque * torque)));
        let angle = wrap(self.theta);
        let cost = angle * angle + 0.1 * (self.theta_dot * self.theta_dot) + effort;
        let theta_dot = self.theta_dot + (GRAVITY_TERM * self.sin_cos.0 + push) * SECONDS_A_STEP;
        self.theta_dot = theta_dot.clamp(-MAX_SPEED, MAX_SPEED);
        self.theta += self.theta_dot * SECONDS_A_STEP;
        self.steps += 1;
        self.observe(observation.real);
        Step {
            reward: (-cost + HALF_COST) / HALF_COST / f64::from(self.spec.max_steps),
            terminated: false,
            truncated: self.steps >= self.spec.max_steps,
        }
    }

    fn state(&self, state: ValueMut<'_>) {
        let (sin, cos) = self.sin_cos;
        state.real.copy_from_slice(&[cos as f32, sin as f32, self.theta_dot as f32]);
    }
}
