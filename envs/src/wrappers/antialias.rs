//! A flag for the first step.

use super::{append, forward_to_env};
use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step};
use crate::space::{Space, Value, ValueMut};

/// Appends a `Discrete(2)` to each observation: 1 in the first of an episode, 0 in all others.
///
/// It tells a null action from a real one, and an episode's first observation from later ones that look like it.
#[derive(Clone, Debug)]
pub struct Antialias<E> {
    env: E,
    spec: EnvSpec,
    /// Discrete and real components of the observation within.
    inner: (usize, usize),
}

impl<E: Env> Antialias<E> {
    /// `env` with the flag.
    pub fn new(env: E) -> Self {
        let spec = env.spec();
        let inner = spec.observation.widths();
        let spec = EnvSpec { observation: append(&spec.observation, Space::Discrete(2)), ..spec.clone() };
        Self { env, spec, inner }
    }
}

impl<E: Env> Env for Antialias<E> {
    forward_to_env!();

    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn begin(&mut self, draws: &mut dyn Draws, observation: ValueMut<'_>) {
        let [inner, flag] = observation.split_at(self.inner);
        self.env.begin(draws, inner);
        flag.discrete[0] = 1;
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let [inner, flag] = observation.split_at(self.inner);
        let step = self.env.step(action, draws, inner);
        flag.discrete[0] = 0;
        step
    }
}
