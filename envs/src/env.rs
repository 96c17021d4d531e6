//! What an environment is.
//!
//! The world comes first: all that a reset draws is one plain value, drawn from a stream ([`Env::draw_world`]) or given
//! ([`Env::set_world`]). From there on an episode is a function of the world, the actions and the per-step draws.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::canvas::{Canvas, View};
use crate::draws::Draws;
use crate::rng::EpisodeRng;
use crate::space::{Slab, Space, Value, ValueMut};

/// The three sizes of every game of the benchmark; difficulty tables are in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Difficulty {
    /// The smallest.
    Easy,
    /// The middle one.
    Medium,
    /// The largest.
    Hard,
}

impl Difficulty {
    /// All three, from easy to hard.
    pub const ALL: [Self; 3] = [Self::Easy, Self::Medium, Self::Hard];
}

impl std::fmt::Display for Difficulty {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Easy => "Easy",
            Self::Medium => "Medium",
            Self::Hard => "Hard",
        })
    }
}

/// What an environment tells of itself.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvSpec {
    /// The canonical id, for example `popgym-RepeatPreviousEasy-v0`.
    pub id: String,
    /// What the agent sees.
    pub observation: Space,
    /// What the agent does.
    pub action: Space,
    /// The hidden state. Of some games it lacks what is observed (the agent's place in a maze): see there.
    pub state: Space,
    /// No episode is longer, in steps.
    pub max_steps: u32,
    /// Smallest and largest possible return (undiscounted sum of an episode's rewards).
    pub return_range: (f64, f64),
}

impl EnvSpec {
    /// Checks that the spec makes sense: a name, valid spaces, at least one component to see and one to do, at least
    /// one step, and ordered, finite returns.
    ///
    /// # Errors
    /// A sentence that names what is wrong.
    pub fn validate(&self) -> Result<(), String> {
        if self.id.is_empty() || self.id.contains(char::is_whitespace) {
            return Err(format!("the id `{}` is empty or holds white space", self.id));
        }
        for (name, space) in [("observation", &self.observation), ("action", &self.action), ("state", &self.state)] {
            space.validate().map_err(|error| format!("the {name} space is not valid: {error}"))?;
            if name != "state" && space.flat_width() == 0 {
                return Err(format!("the {name} space has no component"));
            }
        }
        if self.max_steps == 0 {
            return Err("max_steps is 0".to_owned());
        }
        let (low, high) = self.return_range;
        if !low.is_finite() || !high.is_finite() || low > high {
            return Err(format!("return_range is {low}..={high}"));
        }
        Ok(())
    }
}

/// Reads an environment's `World` from a recording (for [`Env::set_world`]).
///
/// # Errors
/// What does not fit, in serde's words.
pub fn parse_world<World: DeserializeOwned>(world: &serde_json::Value) -> Result<World, String> {
    World::deserialize(world).map_err(|error| error.to_string())
}

/// An environment's `World` as a recording (for [`Env::world`]).
///
/// # Panics
/// If `world` is not plain data: its maps must have texts as keys.
pub fn world_value<World: Serialize>(world: &World) -> serde_json::Value {
    serde_json::to_value(world).expect("a world is plain data")
}

/// [`Env::step_all`] of environments whose action is one class, and whose observation is `SEEN` classes: with the widths
/// known beforehand, hardly anything is left to check.
pub(crate) fn step_all_classes<E: Env, const SEEN: usize>(
    envs: &mut [E],
    rngs: &mut [EpisodeRng],
    actions: &Slab,
    observations: &mut Slab,
    steps: &mut [Step],
) {
    let (observations, _) = observations.discrete.as_chunks_mut::<SEEN>();
    let classes = actions.discrete.iter().zip(observations);
    for (((env, rng), step), (action, observation)) in envs.iter_mut().zip(rngs).zip(steps).zip(classes) {
        let action = Value { discrete: std::slice::from_ref(action), real: &[] };
        let observation = ValueMut { discrete: observation, real: &mut [] };
        let Step { reward, terminated, truncated } = env.step(action, rng, observation);
        (step.reward, step.terminated, step.truncated) = (reward, terminated, truncated);
    }
}

/// The outcome of one step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Step {
    /// The reward of the action.
    pub reward: f64,
    /// The task itself ended.
    pub terminated: bool,
    /// The time limit was reached. Both flags can be set together.
    pub truncated: bool,
}

impl Step {
    /// Whether the episode is over.
    pub fn done(&self) -> bool {
        self.terminated || self.truncated
    }
}

/// A partially observable environment.
///
/// An episode is `draw_world` (or `set_world`), `begin`, then `step` until [`Step::done`]. Between construction and the
/// end of an episode only `set_world`, `world` and `render` may allocate. Those who implement this trait may rely on it that
/// actions are points of the action space and that nothing is stepped beyond its end: [`crate::VecEnv`] checks both.
pub trait Env: Send {
    /// Spaces and limits, the same for the environment's whole life.
    fn spec(&self) -> &EnvSpec;

    /// Draws the next episode's world.
    fn draw_world(&mut self, rng: &mut EpisodeRng);

    /// Takes the next episode's world from a recording (its format: the environment's `World`).
    ///
    /// # Errors
    /// What is wrong with the recorded world; the world is then as before.
    fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String>;

    /// The present world, as `set_world` takes it.
    fn world(&self) -> serde_json::Value;

    /// Starts an episode in the present world and writes the first observation.
    fn begin(&mut self, draws: &mut dyn Draws, observation: ValueMut<'_>);

    /// Takes `action` and writes the next observation.
    fn step(&mut self, action: Value<'_>, draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step;

    /// Steps many environments: `envs[i]` draws from `rngs[i]`, takes row `i` of `actions`, and writes into row `i` of
    /// `observations` and into `steps[i]`; all are of one length. Unless overridden, which is only for speed, it steps
    /// them one by one.
    fn step_all(envs: &mut [Self], rngs: &mut [EpisodeRng], actions: &Slab, observations: &mut Slab, steps: &mut [Step])
    where
        Self: Sized,
    {
        let slabs = actions.each_row().zip(observations.each_row_mut());
        for (((env, rng), step), (action, observation)) in envs.iter_mut().zip(rngs).zip(steps).zip(slabs) {
            let Step { reward, terminated, truncated } = env.step(action, rng, observation);
            // One part at a time, as they were written: a wider load would have to wait for those stores.
            (step.reward, step.terminated, step.truncated) = (reward, terminated, truncated);
        }
    }

    /// Writes the hidden state of the episode that was begun last.
    fn state(&self, state: ValueMut<'_>);

    /// Draws the present moment on an empty canvas. Unless overridden, nothing.
    fn render(&self, _view: View, _canvas: &mut Canvas) {}

    /// What the classes of a `Discrete` action are called, in order. Unless overridden, nothing.
    fn action_names(&self) -> &'static [&'static str] {
        &[]
    }
}

impl<E: Env + ?Sized> Env for Box<E> {
    fn spec(&self) -> &EnvSpec {
        (**self).spec()
    }

    fn draw_world(&mut self, rng: &mut EpisodeRng) {
        (**self).draw_world(rng);
    }

    fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String> {
        (**self).set_world(world)
    }

    fn world(&self) -> serde_json::Value {
        (**self).world()
    }

    fn begin(&mut self, draws: &mut dyn Draws, observation: ValueMut<'_>) {
        (**self).begin(draws, observation);
    }

    fn step(&mut self, action: Value<'_>, draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        (**self).step(action, draws, observation)
    }

    fn state(&self, state: ValueMut<'_>) {
        (**self).state(state);
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        (**self).render(view, canvas);
    }

    fn action_names(&self) -> &'static [&'static str] {
        (**self).action_names()
    }
}
