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

use crate::canvas::{Canvas, Colour, Style, View};
use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step, parse_world, world_value};
use crate::rng::{EpisodeRng, uniform};
use crate::sketch;
use crate::space::{Slab, Space, Value, ValueMut};

/// The size of a game.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Params {
    /// Length of an episode without a fall, in steps.
    pub max_steps: u32,
}

/// Easy, medium, hard.
pub const LEVELS: [Params; 3] = [Params { max_steps: 200 }, Params { max_steps: 400 }, Params { max_steps: 600 }];

/// What the actions are called.
pub(crate) const ACTIONS: &[&str] = &["left", "right"];

const GRAVITY: f64 = 9.8;
/// Newtons, to the right, by action.
const FORCES: [f64; 2] = [-10.0, 10.0];
const POLE_MASS: f64 = 0.1;
const TOTAL_MASS: f64 = 1.1;
const HALF_LENGTH: f64 = 0.5;
const POLE_MASS_LENGTH: f64 = 0.05;
const SECONDS_A_STEP: f64 = 0.02;
const X_LIMIT: f64 = 2.4;
const THETA_LIMIT: f64 = 12.0 * 2.0 * PI / 360.0;

/// Largest numbers of a given world: it is no fall yet, and so slow that the fall is seen within the observation space.
const WORLD_LIMITS: [(&str, f64); 4] =
    [("position", X_LIMIT), ("velocity", 100.0), ("angle", THETA_LIMIT), ("angular velocity", 8.0)];

/// Largest position (m) and angle (rad) of the observation space: twice where an episode ends.
pub(crate) const OBSERVED_LIMITS: [f32; 2] = [(2.0 * X_LIMIT) as f32, (2.0 * THETA_LIMIT) as f32];

/// What a reset draws.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// Position (m), velocity (m/s), angle (rad), angular velocity (rad/s); each uniform in `[-0.05, 0.05)` if drawn,
    /// within 2.4 m, 100 m/s, 12 degrees and 8 rad/s if given.
    pub state: [f64; 4],
}

/// The game.
#[derive(Clone, Debug)]
pub struct PositionOnlyCartPole {
    spec: EnvSpec,
    cart: CartPole,
}

impl PositionOnlyCartPole {
    /// A game of the given size, under the id `id`.
    pub fn new(id: &str, Params { max_steps }: Params) -> Self {
        Self { spec: CartPole::spec(id, OBSERVED_LIMITS, max_steps), cart: CartPole::new(max_steps) }
    }
}

impl Env for PositionOnlyCartPole {
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
        world_value(&self.cart.world)
    }

    fn begin(&mut self, _draws: &mut dyn Draws, observation: ValueMut<'_>) {
        self.cart.begin();
        observation.real.copy_from_slice(&self.cart.positions());
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let step = self.cart.step(action.discrete[0]);
        observation.real.copy_from_slice(&self.cart.positions());
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
            *out = env.cart.positions();
        }
    }

    fn state(&self, state: ValueMut<'_>) {
        self.cart.write_state(state.real);
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        self.cart.render(view, self.cart.positions(), canvas);
    }

    fn action_names(&self) -> &'static [&'static str] {
        ACTIONS
    }
}

/// The cart, its pole and the end of an episode: what the cart-pole games share, whatever they show of it.
#[derive(Clone, Debug)]
pub(crate) struct CartPole {
    world: World,
    /// As in [`World`].
    state: [f64; 4],
    steps: u32,
    max_steps: u32,
    reward: f64,
    /// The last one, if there were steps.
    action: u8,
}

impl CartPole {
    pub(crate) fn new(max_steps: u32) -> Self {
        let world = World { state: [0.0; 4] };
        Self { world, state: world.state, steps: 0, max_steps, reward: 1.0 / f64::from(max_steps), action: 0 }
    }

    /// The spec of a game in which two numbers are observed, each within the limit given.
    pub(crate) fn spec(id: &str, limits: [f32; 2], max_steps: u32) -> EnvSpec {
        let symmetric = |high: &[f32]| Space::Box { low: high.iter().map(|x| -x).collect(), high: high.to_vec() };
        EnvSpec {
            id: id.to_owned(),
            observation: symmetric(&limits),
            action: Space::Discrete(2),
            state: symmetric(&[OBSERVED_LIMITS[0], f32::INFINITY, OBSERVED_LIMITS[1], f32::INFINITY]),
            max_steps,
            return_range: (0.0, 1.0),
        }
    }

    pub(crate) fn draw_world(&mut self, rng: &mut EpisodeRng) {
        for part in &mut self.world.state {
            *part = uniform(rng, -0.05, 0.05);
        }
    }

    pub(crate) fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String> {
        let world: World = parse_world(world)?;
        for ((name, limit), part) in WORLD_LIMITS.into_iter().zip(world.state) {
            if !(-limit..=limit).contains(&part) {
                return Err(format!("the {name} is {part}, allowed is {}..={limit}", -limit));
            }
        }
        self.world = world;
        Ok(())
    }

    pub(crate) fn world(&self) -> World {
        self.world
    }

    pub(crate) fn begin(&mut self) {
        self.state = self.world.state;
        self.steps = 0;
    }

    /// Whether no step was taken yet.
    #[inline]
    pub(crate) fn is_new(&self) -> bool {
        self.steps == 0
    }

    /// Position and angle.
    #[inline]
    pub(crate) fn positions(&self) -> [f32; 2] {
        [self.state[0] as f32, self.state[2] as f32]
    }

    /// Velocity and angular velocity.
    #[inline]
    pub(crate) fn velocities(&self) -> [f32; 2] {
        [self.state[1] as f32, self.state[3] as f32]
    }

    pub(crate) fn write_state(&self, out: &mut [f32]) {
        for (out, &part) in out.iter_mut().zip(&self.state) {
            *out = part as f32;
        }
    }

    #[inline]
    pub(crate) fn step(&mut self, action: u8) -> Step {
        let (sin, cos) = self.state[2].sin_cos();
        self.arrive(action, advance(self.state, sin, cos, FORCES[usize::from(action)]))
    }

    /// Steps the cart-pole of every game in `envs`, as [`CartPole::step`] does.
    ///
    /// A step is one long chain of divisions. Here they are those of several carts at a time, side by side, which the
    /// compiler turns into vector instructions.
    #[inline]
    pub(crate) fn step_all<E>(envs: &mut [E], cart: impl Fn(&mut E) -> &mut Self, actions: &[u8], steps: &mut [Step]) {
        const LANES: usize = 8;
        let (chunks, rest) = envs.as_chunks_mut::<LANES>();
        let (action_chunks, rest_actions) = actions.as_chunks::<LANES>();
        let (step_chunks, rest_steps) = steps.as_chunks_mut::<LANES>();
        for ((envs, actions), steps) in chunks.iter_mut().zip(action_chunks).zip(step_chunks) {
            let [mut x, mut x_dot, mut theta, mut theta_dot] = [[0.0; LANES]; 4];
            let [mut sin, mut cos, mut force] = [[0.0; LANES]; 3];
            for i in 0..LANES {
                [x[i], x_dot[i], theta[i], theta_dot[i]] = cart(&mut envs[i]).state;
                (sin[i], cos[i]) = theta[i].sin_cos();
                force[i] = FORCES[usize::from(actions[i])];
            }
            for i in 0..LANES {
                [x[i], x_dot[i], theta[i], theta_dot[i]] =
                    advance([x[i], x_dot[i], theta[i], theta_dot[i]], sin[i], cos[i], force[i]);
            }
            for i in 0..LANES {
                steps[i] = cart(&mut envs[i]).arrive(actions[i], [x[i], x_dot[i], theta[i], theta_dot[i]]);
            }
        }
        for ((env, &action), step) in rest.iter_mut().zip(rest_actions).zip(rest_steps) {
            *step = cart(env).step(action);
        }
    }

    #[inline]
    fn arrive(&mut self, action: u8, state: [f64; 4]) -> Step {
        self.state = state;
        self.action = action;
        self.steps += 1;
        Step { reward: self.reward, terminated: fallen(&state), truncated: self.steps >= self.max_steps }
    }

    /// The last action; none at the start.
    fn last_action(&self) -> Option<u8> {
        (!self.is_new()).then_some(self.action)
    }

    /// Draws a game that shows `seen` (position and angle).
    pub(crate) fn render(&self, view: View, seen: [f32; 2], canvas: &mut Canvas) {
        match view {
            View::Observed => {
                let [x, theta] = seen.map(f64::from);
                draw(canvas, x, theta, self.last_action());
                canvas.put(NUMBERS_ROW, 0, &format!("position {x:+.3} m   angle {:+.2} deg", theta.to_degrees()), INK);
            }
            View::Revealed => self.reveal(canvas),
        }
    }

    /// Draws the hidden state.
    pub(crate) fn reveal(&self, canvas: &mut Canvas) {
        let [x, x_dot, theta, theta_dot] = self.state;
        draw(canvas, x, theta, self.last_action());
        let (degrees, speed) = (theta.to_degrees(), theta_dot.to_degrees());
        let rows = [
            format!("position {x:+.3} m   angle {degrees:+.2} deg"),
            format!("velocity {x_dot:+.3} m/s   angular velocity {speed:+.2} deg/s"),
            format!("step {} of at most {}", self.steps, self.max_steps),
        ];
        for (row, text) in (NUMBERS_ROW..).zip(rows) {
            canvas.put(row, 0, &text, INK);
        }
    }

    /// Draws two velocities as bars, and the last action.
    pub(crate) fn draw_velocities(&self, [x_dot, theta_dot]: [f32; 2], canvas: &mut Canvas) {
        // Wide enough for what is seen before a fall; a faster one fills its bar.
        sketch::bar(canvas, 0, "velocity", f64::from(x_dot), 4.0, "m/s");
        sketch::bar(canvas, 1, "angular velocity", f64::from(theta_dot), 4.0, "rad/s");
        draw_actions(canvas, 3, self.last_action());
    }
}

fn fallen(&[x, _, theta, _]: &[f64; 4]) -> bool {
    // Not `||`: a branch on the first would be one that cannot be predicted.
    (x.abs() > X_LIMIT) | (theta.abs() > THETA_LIMIT)
}

/// One explicit Euler step under `force` (newtons, to the right); `sin` and `cos` are the angle's.
#[inline]
fn advance([x, x_dot, theta, theta_dot]: [f64; 4], sin: f64, cos: f64, force: f64) -> [f64; 4] {
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

const INK: Style = Style::PLAIN;
/// Characters a metre: a character is about twice as high as wide.
const COLUMNS_A_METRE: f64 = 14.0;
const ROWS_A_METRE: f64 = 7.0;
/// Of the track's middle.
const MIDDLE_COLUMN: usize = 39;
/// Of the cart, below the pole.
const CART_ROW: usize = 7;
const ACTIONS_ROW: usize = CART_ROW + 3;
const NUMBERS_ROW: usize = ACTIONS_ROW + 1;

/// Draws the cart at `x` (m) with its pole at `theta` (rad, to the right), and the action that pushed it there.
fn draw(canvas: &mut Canvas, x: f64, theta: f64, action: Option<u8>) {
    let column = |x: f64| (MIDDLE_COLUMN as f64 + COLUMNS_A_METRE * x).round().clamp(0.0, 2.0 * MIDDLE_COLUMN as f64);
    let (left, right) = (column(-X_LIMIT) as usize, column(X_LIMIT) as usize);
    let track = CART_ROW + 1;
    canvas.put(track, 0, &"─".repeat(2 * MIDDLE_COLUMN + 1), Style::ink(Colour::Grey));
    for limit in [left, right] {
        canvas.put(track, limit, "┴", Style::ink(Colour::Red));
    }
    canvas.put(track, MIDDLE_COLUMN, "┴", Style::ink(Colour::Grey));

    // What is beyond the picture (noise can show it there) is drawn at its edge.
    let foot = column(x).clamp(4.0, 2.0 * MIDDLE_COLUMN as f64 - 4.0);
    let cart = foot as usize;
    let tip_row = CART_ROW as f64 - 1.0 - (2.0 * HALF_LENGTH * ROWS_A_METRE * theta.cos() - 1.0);
    let tip_column = foot + 2.0 * HALF_LENGTH * COLUMNS_A_METRE * theta.sin();
    let inside = tip_column.clamp(0.0, 2.0 * MIDDLE_COLUMN as f64);
    sketch::line(canvas, (CART_ROW as f64 - 1.0, foot), (tip_row.max(0.0), inside), Style::ink(Colour::Yellow).bold());
    canvas.put(CART_ROW, cart - 3, "▐█████▌", Style::ink(Colour::Blue));
    match action {
        Some(0) => canvas.put(CART_ROW, cart + 4, "←", Style::ink(Colour::Green).bold()),
        Some(_) => canvas.put(CART_ROW, cart - 4, "→", Style::ink(Colour::Green).bold()),
        None => {}
    }
    draw_actions(canvas, ACTIONS_ROW, action);
}

/// The two actions, to be pointed at; the last one is marked.
fn draw_actions(canvas: &mut Canvas, row: usize, last: Option<u8>) {
    for (action, (column, text)) in [(0, "← left"), (9, "right →")].into_iter().enumerate() {
        let style = if last == Some(action as u8) { Style::ink(Colour::Green).bold() } else { INK };
        canvas.put_action(row, column, text, style, action as u16);
    }
}
