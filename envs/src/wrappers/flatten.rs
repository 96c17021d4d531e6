//! Tuples as vectors.

use super::forward_to_env;
use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step};
use crate::space::{Leaf, Slab, Space, Value, ValueMut};

/// Turns a tuple into one vector.
///
/// An observation that is a tuple becomes a `Box`: its components in order, each discrete one one-hot and each real one
/// as it is. An action that is a tuple, nested or not, becomes a `MultiDiscrete` if all its components are discrete, a
/// `Box` if all are real. What is no tuple is left alone.
#[derive(Clone, Debug)]
pub struct Flatten<E> {
    env: E,
    spec: EnvSpec,
    /// The observation before it is flattened, one row; none if it is left alone.
    inner: Option<Slab>,
}

impl<E: Env> Flatten<E> {
    /// `env` without tuples.
    ///
    /// # Errors
    /// If its action is a tuple of discrete and real components.
    pub fn new(env: E) -> Result<Self, String> {
        let mut spec = env.spec().clone();
        if let Space::Tuple(_) = spec.action {
            spec.action = one_vector(&spec.action).map_err(|reason| format!("{}: {reason}", spec.id))?;
        }
        let mut inner = None;
        if let Space::Tuple(_) = spec.observation {
            inner = Some(Slab::new(&spec.observation, 1));
            spec.observation = one_hot(&spec.observation);
        }
        Ok(Self { env, spec, inner })
    }

    fn write<T>(&mut self, out: ValueMut<'_>, observe: impl FnOnce(&mut E, ValueMut<'_>) -> T) -> T {
        let Some(inner) = &mut self.inner else { return observe(&mut self.env, out) };
        let result = observe(&mut self.env, inner.row_mut(0));
        self.env.spec().observation.flatten_into(inner.row(0), out.real);
        result
    }
}

/// The box of the points that [`Space::flatten_into`] makes.
fn one_hot(space: &Space) -> Space {
    let (mut low, mut high) = (Vec::new(), Vec::new());
    for leaf in space.leaves() {
        let (from, to, places) = match leaf {
            Leaf::Discrete { classes } => (0.0, 1.0, usize::from(classes)),
            Leaf::Real { low, high } => (low, high, 1),
        };
        low.resize(low.len() + places, from);
        high.resize(high.len() + places, to);
    }
    Space::Box { low, high }
}

/// The components of `space`, which are all discrete or all real, as one vector: stored alike, so that no point of it
/// has to be converted.
fn one_vector(space: &Space) -> Result<Space, String> {
    let (mut classes, mut low, mut high) = (Vec::new(), Vec::new(), Vec::new());
    for leaf in space.leaves() {
        match leaf {
            Leaf::Discrete { classes: n } => classes.push(n),
            Leaf::Real { low: from, high: to } => {
                low.push(from);
                high.push(to);
            }
        }
    }
    match (classes.is_empty(), low.is_empty()) {
        (false, true) => Ok(Space::MultiDiscrete(classes)),
        (true, false) => Ok(Space::Box { low, high }),
        (false, false) => Err(format!(
            "an action of {} discrete and {} real components cannot be one vector",
            classes.len(),
            low.len()
        )),
        (true, true) => Err("an action without components cannot be one vector".to_owned()),
    }
}

impl<E: Env> Env for Flatten<E> {
    forward_to_env!();

    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn begin(&mut self, draws: &mut dyn Draws, observation: ValueMut<'_>) {
        self.write(observation, |env, out| env.begin(draws, out));
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        self.write(observation, |env, out| env.step(action, draws, out))
    }
}
