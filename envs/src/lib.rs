//! POPGym's partially observable environments (Morad et al., "POPGym: Benchmarking Partially Observable Reinforcement
//! Learning", ICLR 2023): exact, fast, and free of everything but numbers.
//!
//! | module | what it holds |
//! |---|---|
//! | [`space`] | what observations, actions and hidden states are, and how they are stored |
//! | [`mod@env`] | the [`Env`] trait: a world, then steps |
//! | [`rng`] | one random stream for each episode and purpose |
//! | [`draws`] | per-step randomness, from a stream or a recording |
//! | [`registry`] | environments by name; the place to add one's own |
//! | [`vec_env`] | many environments, stepped into storage that the caller owns |
//! | [`deck`] | the cards of the card games |
//! | [`repeat_first`], [`repeat_previous`] | diagnostic games |
//! | [`cart_pole`], [`pendulum`] | control with hidden velocities |
//! | [`battleship`] | board game |
//!
//! One file is one game, with its difficulties as a table at the top. Rules, rewards and quirks are those of the Python
//! package, version 1.0.7, replayed step by step in the tests.
//!
//! ```
//! use popgym_envs::{Purpose, Registry, VecEnv, stream};
//!
//! let registry = Registry::standard();
//! let mut envs = VecEnv::new(&registry, "RepeatPreviousEasy", 1)?;
//! let (mut observations, mut actions) = (envs.observations(), envs.actions());
//! let mut policy = stream(0, 0, 0, Purpose::TrainAction);
//! envs.begin(0, stream(0, 0, 0, Purpose::TrainEnv), &mut observations);
//! let mut episode_return = 0.0;
//! loop {
//!     envs.spec().action.sample_into(&mut policy, actions.row_mut(0));
//!     let step = envs.step(0, actions.row(0), &mut observations);
//!     episode_return += step.reward;
//!     if step.done() {
//!         break;
//!     }
//! }
//! assert!((-1.0..=1.0).contains(&episode_return));
//! # Ok::<(), popgym_envs::UnknownEnv>(())
//! ```
#![forbid(unsafe_code)]

pub mod battleship;
pub mod cart_pole;
pub mod deck;
pub mod draws;
pub mod env;
pub mod pendulum;
pub mod registry;
pub mod repeat_first;
pub mod repeat_previous;
pub mod rng;
pub mod space;
pub mod vec_env;

pub use draws::{Draws, Recorded};
pub use env::{Difficulty, Env, EnvSpec, Step, parse_world};
pub use registry::{Entry, RegisterError, Registry, UnknownEnv};
pub use rng::{EpisodeRng, Purpose, stream};
pub use space::{Leaf, Slab, Space, SpaceError, Value, ValueMut};
pub use vec_env::VecEnv;
