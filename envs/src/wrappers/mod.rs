//! Wrappers: what agents outside this crate expect of an environment.
//!
//! | wrapper | observation | action |
//! |---|---|---|
//! | [`PreviousAction`] | the previous action is appended; a null action at the start | as it is |
//! | [`Antialias`] | a flag is appended: 1 in an episode's first observation, then 0 | as it is |
//! | [`Flatten`] | a tuple becomes one vector of reals, its discrete components one-hot | a nested tuple becomes one vector |
//! | [`DiscreteAction`] | as it is | several discrete components become one |
//! | [`crate::Observed`] | the hidden state is shown in place of the observation, or after it | as it is |
//!
//! Each is an [`Env`](crate::Env) around another, so they compose. Everything else (id, limits, worlds, hidden states,
//! pictures) is that of the environment within, and stepping still does not allocate. This is what the paper's agents
//! saw:
//!
//! ```
//! use popgym_envs::battleship::{self, Battleship};
//! use popgym_envs::wrappers::{Antialias, Flatten, PreviousAction};
//! use popgym_envs::{Env, Space};
//!
//! let env = Battleship::new("popgym-BattleshipEasy-v0", battleship::LEVELS[0]);
//! let env = Flatten::new(Antialias::new(PreviousAction::new(env)))?;
//! // Hit or miss (2), row (8) and column (8) of the previous shot, first step (2).
//! assert_eq!(env.spec().observation, Space::uniform_box(20, 0.0, 1.0));
//! # Ok::<(), String>(())
//! ```
//!
//! The Python package appends previous action and flag *inside* the observation when the hidden state is shown beside
//! it: `{obs: (obs, action, flag), state}`. Here that is had by wrapping the other way round,
//! `Observed::new(Antialias::new(PreviousAction::new(env)), Observability::FullAndPartial)`, or by registering the
//! wrapped environment and asking for [`VecEnv::observing`](crate::VecEnv::observing); wrapped as above around an
//! `Observed`, the order is `(obs, state, action, flag)`.

mod antialias;
mod discrete_action;
mod flatten;
mod previous_action;

pub use antialias::Antialias;
pub use discrete_action::DiscreteAction;
pub use flatten::Flatten;
pub use previous_action::PreviousAction;

use crate::space::Space;

/// `space` with one more part at its end.
fn append(space: &Space, part: Space) -> Space {
    let mut parts = match space {
        Space::Tuple(parts) => parts.clone(),
        single => vec![single.clone()],
    };
    parts.push(part);
    Space::Tuple(parts)
}

/// The methods of [`crate::Env`] that a wrapper leaves to its field `env`: all but those of spec and steps.
macro_rules! forward_to_env {
    () => {
        fn draw_world(&mut self, rng: &mut $crate::rng::EpisodeRng) {
            self.env.draw_world(rng);
        }

        fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String> {
            self.env.set_world(world)
        }

        fn world(&self) -> serde_json::Value {
            self.env.world()
        }

        fn state(&self, state: $crate::space::ValueMut<'_>) {
            self.env.state(state);
        }

        fn render(&self, view: $crate::canvas::View, canvas: &mut $crate::canvas::Canvas) {
            self.env.render(view, canvas);
        }

        fn action_names(&self) -> &'static [&'static str] {
            self.env.action_names()
        }
    };
}
pub(crate) use forward_to_env;
