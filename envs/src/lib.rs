#![doc = include_str!("../README.md")]
//!
//! # Modules
//!
//! | module | what it holds |
//! |---|---|
//! | [`space`] | what observations, actions and hidden states are, and how they are stored |
//! | [`mod@env`] | the [`Env`] trait: a world, then steps |
//! | [`rng`] | one random stream for each episode and purpose |
//! | [`draws`] | per-step randomness, from a stream or a recording |
//! | [`registry`] | environments by name; the place to add one's own |
//! | [`vec_env`] | many environments, stepped into storage that the caller owns |
//! | [`observability`], [`wrappers`] | other observations and actions around an environment |
//! | [`canvas`] | pictures of environments |
//! | [`random_policy`] | what acting at random returns |
//! | [`deck`] | the cards of the card games |
//! | [`repeat_first`], [`repeat_previous`], [`autoencode`], [`count_recall`] | diagnostic games, with cards |
//! | [`cart_pole`], [`pendulum`], [`velocity_only_cart_pole`] | control with hidden velocities, or hidden positions |
//! | [`noisy_cart_pole`], [`noisy_pendulum`], [`multiarmed_bandit`] | noisy tasks |
//! | [`battleship`], [`concentration`], [`higher_lower`], [`mine_sweeper`] | games |
//! | [`labyrinth_escape`], [`labyrinth_explore`], [`maze`] | navigation, and its mazes |
//!
//! One file is one game, with its difficulties as a table at the top. Rules, rewards and quirks are those of the Python
//! package, version 1.0.7, replayed step by step in the tests.
#![forbid(unsafe_code)]

pub mod autoencode;
pub mod battleship;
mod board;
pub mod canvas;
pub mod cart_pole;
pub mod concentration;
pub mod count_recall;
pub mod deck;
pub mod draws;
pub mod env;
pub mod higher_lower;
pub mod labyrinth_escape;
pub mod labyrinth_explore;
pub mod maze;
pub mod mine_sweeper;
pub mod multiarmed_bandit;
pub mod noisy_cart_pole;
pub mod noisy_pendulum;
pub mod observability;
pub mod pendulum;
mod pictures;
pub mod random_policy;
pub mod registry;
pub mod repeat_first;
pub mod repeat_previous;
pub mod rng;
mod sketch;
pub mod space;
mod standard;
pub mod vec_env;
pub mod velocity_only_cart_pole;
pub mod wrappers;

pub use canvas::{Canvas, Colour, Glyph, Style, View};
pub use draws::{Draws, Recorded};
pub use env::{Difficulty, Env, EnvSpec, Step, parse_world, world_value};
pub use observability::{Observability, Observed};
pub use registry::{Entry, MakeError, RegisterError, Registry, UnknownEnv};
pub use rng::{EpisodeRng, Purpose, stream};
pub use space::{Leaf, Slab, Space, SpaceError, Value, ValueMut};
pub use vec_env::{StepError, VecEnv};
pub use wrappers::{Antialias, DiscreteAction, Flatten, PreviousAction};
