//! How much of an environment the agent is shown: what the game shows, its hidden state, or both.

use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step};
use crate::space::{Slab, Space, Value, ValueMut};
use crate::wrappers::forward_to_env;

/// The four levels of the Python package's `Markovian` wrapper.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "&'static str")]
pub enum Observability {
    /// The observation: the benchmark's task.
    #[default]
    Partial,
    /// The observation; the hidden state is at hand beside it ([`crate::VecEnv::info`]), but not for the agent.
    FullInInfo,
    /// The hidden state in place of the observation.
    Full,
    /// The observation, and after it the hidden state.
    FullAndPartial,
}

impl Observability {
    /// All four.
    pub const ALL: [Self; 4] = [Self::Partial, Self::FullInInfo, Self::Full, Self::FullAndPartial];

    /// `partial`, `full-in-info`, `full` or `full-and-partial`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Partial => "partial",
            Self::FullInInfo => "full-in-info",
            Self::Full => "full",
            Self::FullAndPartial => "full-and-partial",
        }
    }

    /// The spec of an environment as an agent at this level meets it.
    pub fn apply(self, spec: &EnvSpec) -> EnvSpec {
        let observation = match self {
            Self::Partial | Self::FullInInfo => spec.observation.clone(),
            Self::Full => spec.state.clone(),
            Self::FullAndPartial => Space::Tuple(vec![spec.observation.clone(), spec.state.clone()]),
        };
        EnvSpec { observation, ..spec.clone() }
    }
}

impl From<Observability> for &'static str {
    fn from(level: Observability) -> Self {
        level.name()
    }
}

impl TryFrom<String> for Observability {
    type Error = UnknownObservability;

    fn try_from(name: String) -> Result<Self, Self::Error> {
        name.parse()
    }
}

impl std::fmt::Display for Observability {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// No level has this name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("observability is `{}`, allowed are partial, full-in-info, full, full-and-partial", .0.escape_debug())]
pub struct UnknownObservability(pub String);

impl FromStr for Observability {
    type Err = UnknownObservability;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        Self::ALL.into_iter().find(|level| level.name() == name).ok_or_else(|| UnknownObservability(name.to_owned()))
    }
}

/// An environment at another level of observability.
#[derive(Clone, Debug)]
pub struct Observed<E> {
    env: E,
    level: Observability,
    spec: EnvSpec,
    /// Discrete and real components of the observation, before the state's.
    partial: (usize, usize),
    /// Where a replaced observation goes, one row.
    unseen: Slab,
}

impl<E: Env> Observed<E> {
    /// `env` at `level`.
    ///
    /// # Errors
    /// If the agent would see nothing: the level shows a state that has no component.
    pub fn new(env: E, level: Observability) -> Result<Self, String> {
        let spec = level.apply(env.spec());
        spec.validate().map_err(|reason| format!("{} at observability {level}: {reason}", spec.id))?;
        let partial = &env.spec().observation;
        Ok(Self { unseen: Slab::new(partial, 1), partial: partial.widths(), spec, level, env })
    }

    /// Writes what the agent sees; `observe` writes the observation.
    fn write<T>(&mut self, out: ValueMut<'_>, observe: impl FnOnce(&mut E, ValueMut<'_>) -> T) -> T {
        match self.level {
            Observability::Partial | Observability::FullInInfo => observe(&mut self.env, out),
            Observability::Full => {
                let result = observe(&mut self.env, self.unseen.row_mut(0));
                self.env.state(out);
                result
            }
            Observability::FullAndPartial => {
                let [partial, state] = out.split_at(self.partial);
                let result = observe(&mut self.env, partial);
                self.env.state(state);
                result
            }
        }
    }
}

impl<E: Env> Env for Observed<E> {
    forward_to_env!();

    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn begin(&mut self, draws: &mut dyn Draws, observation: ValueMut<'_>) {
        self.write(observation, |env, out| env.begin(draws, out));
    }

    fn step(&mut self, action: Value<'_>, draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        self.write(observation, |env, out| env.step(action, draws, out))
    }
}
