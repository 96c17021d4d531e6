//! The previous action, shown with each observation.

use super::{append, forward_to_env};
use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step};
use crate::space::{Slab, Space, SpaceError, Value, ValueMut};

/// Appends the previous action to each observation, and a null action to the first one.
///
/// A tuple gets one more part; any other observation becomes the first part of a pair. Without the previous action the
/// observations of some games (Battleship, MineSweeper) do not tell what they are about.
#[derive(Clone, Debug)]
pub struct PreviousAction<E> {
    env: E,
    spec: EnvSpec,
    /// Discrete and real components of the observation within.
    inner: (usize, usize),
    /// One row.
    null: Slab,
}

impl<E: Env> PreviousAction<E> {
    /// `env` with the usual null action: class 0 for each discrete component; for a box zeros if they lie in it, else
    /// its lower bounds.
    pub fn new(env: E) -> Self {
        let space = &env.spec().action;
        let mut null = Slab::new(space, 1);
        write_null(space, &mut null.real);
        Self::wrap(env, null)
    }

    /// `env` with another null action.
    ///
    /// # Errors
    /// If `null` is no point of the action space.
    pub fn with_null(env: E, null: Value<'_>) -> Result<Self, SpaceError> {
        let space = &env.spec().action;
        space.check(null)?;
        let mut slab = Slab::new(space, 1);
        slab.set(0, null);
        Ok(Self::wrap(env, slab))
    }

    fn wrap(env: E, null: Slab) -> Self {
        let spec = env.spec();
        let inner = spec.observation.widths();
        let spec = EnvSpec { observation: append(&spec.observation, spec.action.clone()), ..spec.clone() };
        Self { env, spec, inner, null }
    }
}

/// Writes the reals of the null action of `space` to the front of `out`, and gives the rest of `out`.
fn write_null<'a>(space: &Space, out: &'a mut [f32]) -> &'a mut [f32] {
    match space {
        Space::Discrete(_) | Space::MultiDiscrete(_) => out,
        Space::Box { low, high } => {
            let zero = low.iter().zip(high).all(|(&low, &high)| low <= 0.0 && 0.0 <= high);
            let (own, rest) = out.split_at_mut(low.len());
            for ((out, &low), &high) in own.iter_mut().zip(low).zip(high) {
                // A component without a lower bound gets the number nearest to zero.
                *out = if zero || low == f32::NEG_INFINITY { high.min(0.0) } else { low };
            }
            rest
        }
        Space::Tuple(parts) => parts.iter().fold(out, |out, part| write_null(part, out)),
    }
}

impl<E: Env> Env for PreviousAction<E> {
    forward_to_env!();

    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn begin(&mut self, draws: &mut dyn Draws, observation: ValueMut<'_>) {
        let [inner, mut previous] = observation.split_at(self.inner);
        self.env.begin(draws, inner);
        previous.copy_from(self.null.row(0));
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let [inner, mut previous] = observation.split_at(self.inner);
        let step = self.env.step(action, draws, inner);
        previous.copy_from(action);
        step
    }
}
