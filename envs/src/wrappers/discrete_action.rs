//! One discrete action in place of several.

use super::forward_to_env;
use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step};
use crate::space::{MAX_CLASSES, Space, Value, ValueMut};

/// Turns an action of several discrete components into one, which counts their combinations row by row: of two
/// components, `a` stands for `(a / n1, a % n1)`. An action that is `Discrete` already is left alone.
#[derive(Clone, Debug)]
pub struct DiscreteAction<E> {
    env: E,
    spec: EnvSpec,
    /// Classes of the components within; none if the action is left alone.
    classes: Vec<u16>,
    /// Where the action is taken apart.
    parts: Vec<u8>,
}

impl<E: Env> DiscreteAction<E> {
    /// `env` with one discrete action.
    ///
    /// # Errors
    /// If its action is neither `MultiDiscrete` nor `Discrete`, or has more than [`MAX_CLASSES`] combinations.
    pub fn new(env: E) -> Result<Self, String> {
        let mut spec = env.spec().clone();
        let mut classes = Vec::new();
        match &spec.action {
            Space::Discrete(_) => {}
            Space::MultiDiscrete(n) => {
                let combinations = n.iter().try_fold(1_u16, |product, &n| product.checked_mul(n));
                let combinations =
                    combinations.filter(|&combinations| combinations <= MAX_CLASSES).ok_or_else(|| {
                        format!("{}: more than {MAX_CLASSES} combinations of the actions' {n:?} classes", spec.id)
                    })?;
                classes.clone_from(n);
                spec.action = Space::Discrete(combinations);
            }
            Space::Box { .. } | Space::Tuple(_) => {
                return Err(format!("{}: the action is {:?}, expected discrete components", spec.id, spec.action));
            }
        }
        Ok(Self { env, spec, parts: vec![0; classes.len()], classes })
    }
}

impl<E: Env> Env for DiscreteAction<E> {
    forward_to_env!();

    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn begin(&mut self, draws: &mut dyn Draws, observation: ValueMut<'_>) {
        self.env.begin(draws, observation);
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        if self.classes.is_empty() {
            return self.env.step(action, draws, observation);
        }
        let mut rest = u16::from(action.discrete[0]);
        for (part, n) in self.parts.iter_mut().zip(&self.classes).rev() {
            *part = (rest % n) as u8;
            rest /= n;
        }
        self.env.step(Value { discrete: &self.parts, real: &[] }, draws, observation)
    }
}
