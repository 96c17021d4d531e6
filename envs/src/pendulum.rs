//! **PositionOnlyPendulum** (the paper's **StatelessPendulum**): swing up a pendulum without seeing its velocity.
//!
//! | | |
//! |---|---|
//! | observation | `Box(2)`: cosine and sine of the angle from upright |
//! | action | `Box(1)`: a torque in `[-2, 2]` N m; values beyond are clipped (a `VecEnv` refuses them) |
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

use crate::canvas::{Canvas, Colour, Style, View};
use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step, parse_world, world_value};
use crate::rng::{EpisodeRng, uniform};
use crate::sketch;
use crate::space::{Slab, Space, Value, ValueMut};

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
    rod: Pendulum,
}

impl PositionOnlyPendulum {
    /// A game of the given size, under the id `id`.
    pub fn new(id: &str, Params { max_steps }: Params) -> Self {
        Self { spec: Pendulum::spec(id, max_steps), rod: Pendulum::new(max_steps) }
    }
}

impl Env for PositionOnlyPendulum {
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

    fn begin(&mut self, _draws: &mut dyn Draws, observation: ValueMut<'_>) {
        self.rod.begin();
        observation.real.copy_from_slice(&self.rod.position());
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let step = self.rod.step(action.real[0]);
        observation.real.copy_from_slice(&self.rod.position());
        step
    }

    fn step_all(
        envs: &mut [Self],
        _rngs: &mut [EpisodeRng],
        actions: &Slab,
        observations: &mut Slab,
        steps: &mut [Step],
    ) {
        let rows = envs.iter_mut().zip(&actions.real).zip(observations.real.as_chunks_mut().0).zip(steps);
        for (((env, &torque), out), step) in rows {
            *step = env.rod.step(torque);
            *out = env.rod.position();
        }
    }

    fn state(&self, state: ValueMut<'_>) {
        self.rod.write_state(state.real);
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        self.rod.render(view, self.rod.position(), canvas);
    }
}

/// The pendulum and the end of an episode: what the pendulum games share, whatever they show of it.
#[derive(Clone, Debug)]
pub(crate) struct Pendulum {
    world: World,
    theta: f64,
    theta_dot: f64,
    /// Of `theta`: each is needed for an observation and again for the next step.
    sin_cos: (f64, f64),
    steps: u32,
    max_steps: u32,
    /// The last one, within its bounds, if there were steps.
    torque: f32,
}

impl Pendulum {
    pub(crate) fn new(max_steps: u32) -> Self {
        let world = World { theta: 0.0, theta_dot: 0.0 };
        Self { world, theta: 0.0, theta_dot: 0.0, sin_cos: (0.0, 1.0), steps: 0, max_steps, torque: 0.0 }
    }

    /// The spec of a game that shows the position.
    pub(crate) fn spec(id: &str, max_steps: u32) -> EnvSpec {
        let max_speed = MAX_SPEED as f32;
        EnvSpec {
            id: id.to_owned(),
            observation: Space::uniform_box(2, -1.0, 1.0),
            action: Space::uniform_box(1, -MAX_TORQUE, MAX_TORQUE),
            state: Space::Box { low: vec![-1.0, -1.0, -max_speed], high: vec![1.0, 1.0, max_speed] },
            max_steps,
            return_range: (-1.0, 1.0),
        }
    }

    pub(crate) fn draw_world(&mut self, rng: &mut EpisodeRng) {
        self.world = World { theta: uniform(rng, -PI, PI), theta_dot: uniform(rng, -1.0, 1.0) };
    }

    pub(crate) fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String> {
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

    pub(crate) fn world(&self) -> World {
        self.world
    }

    pub(crate) fn begin(&mut self) {
        (self.theta, self.theta_dot) = (self.world.theta, self.world.theta_dot);
        self.sin_cos = self.theta.sin_cos();
        self.steps = 0;
    }

    /// Cosine and sine of the angle.
    #[inline]
    pub(crate) fn position(&self) -> [f32; 2] {
        [self.sin_cos.1 as f32, self.sin_cos.0 as f32]
    }

    pub(crate) fn write_state(&self, out: &mut [f32]) {
        let [cos, sin] = self.position();
        out.copy_from_slice(&[cos, sin, self.theta_dot as f32]);
    }

    #[inline]
    pub(crate) fn step(&mut self, torque: f32) -> Step {
        self.torque = torque.clamp(-MAX_TORQUE, MAX_TORQUE);
        // Rounded to f32 before they are widened: see the module's note on the last bit.
        let (push, effort) = (f64::from(3.0 * self.torque), f64::from(0.001 * (self.torque * self.torque)));
        let angle = wrap(self.theta);
        let cost = angle * angle + 0.1 * (self.theta_dot * self.theta_dot) + effort;
        let theta_dot = self.theta_dot + (GRAVITY_TERM * self.sin_cos.0 + push) * SECONDS_A_STEP;
        self.theta_dot = theta_dot.clamp(-MAX_SPEED, MAX_SPEED);
        self.theta += self.theta_dot * SECONDS_A_STEP;
        self.sin_cos = self.theta.sin_cos();
        self.steps += 1;
        Step {
            reward: (-cost + HALF_COST) / HALF_COST / f64::from(self.max_steps),
            terminated: false,
            truncated: self.steps >= self.max_steps,
        }
    }

    /// Draws a game that shows `seen` (cosine and sine).
    pub(crate) fn render(&self, view: View, seen: [f32; 2], canvas: &mut Canvas) {
        let torque = (self.steps > 0).then_some(f64::from(self.torque));
        match view {
            View::Observed => draw(canvas, seen.map(f64::from), torque),
            View::Revealed => {
                draw(canvas, [self.sin_cos.1, self.sin_cos.0], torque);
                let (degrees, speed) = (wrap(self.theta).to_degrees(), self.theta_dot.to_degrees());
                canvas.put(NUMBERS_ROW + 2, 0, &format!("angle {degrees:+.2} deg"), Style::PLAIN);
                canvas.put(NUMBERS_ROW + 3, 0, &format!("angular velocity {speed:+.2} deg/s"), Style::PLAIN);
                canvas.put(NUMBERS_ROW + 4, 0, &format!("step {} of {}", self.steps, self.max_steps), Style::PLAIN);
            }
        }
    }
}

/// The angle's representative in `[-pi, pi)`.
fn wrap(angle: f64) -> f64 {
    (angle + PI).rem_euclid(TAU) - PI
}

/// Of the circle that the rod's end moves on, in characters: one is about twice as high as wide.
const RADIUS_ROWS: f64 = 7.0;
const RADIUS_COLUMNS: f64 = 14.0;
/// Row and column of the pivot.
const PIVOT: (f64, f64) = (7.0, 15.0);
const NUMBERS_ROW: usize = 16;

/// Draws the rod of this cosine and sine, and the torque that brought it there.
fn draw(canvas: &mut Canvas, [cos, sin]: [f64; 2], torque: Option<f64>) {
    // As in Gymnasium: upright is up, and a positive angle leans to the left.
    let place = |cos: f64, sin: f64| (PIVOT.0 - RADIUS_ROWS * cos, PIVOT.1 - RADIUS_COLUMNS * sin);
    let put = |canvas: &mut Canvas, (row, column): (f64, f64), symbol: &str, style: Style| {
        canvas.put(row.round() as usize, column.round() as usize, symbol, style);
    };
    for part in 0..96 {
        let (sin, cos) = (TAU * f64::from(part) / 96.0).sin_cos();
        put(canvas, place(cos, sin), "·", Style::ink(Colour::Grey));
    }
    let end = place(cos, sin);
    sketch::line(canvas, PIVOT, end, Style::ink(Colour::Yellow).bold());
    put(canvas, end, "●", Style::ink(Colour::Yellow).bold());
    put(canvas, PIVOT, "○", Style::PLAIN);
    canvas.put(NUMBERS_ROW, 0, &format!("cosine {cos:+.3}   sine {sin:+.3}"), Style::PLAIN);
    let torque = torque.map_or_else(|| "none yet".to_owned(), |torque| format!("{torque:+.3} N m"));
    canvas.put(NUMBERS_ROW + 1, 0, &format!("torque {torque}"), Style::PLAIN);
}
