//! Many environments of one id, stepped into storage that the caller owns.

use crate::canvas::{Canvas, View};
use crate::env::{Env, EnvSpec, Step};
use crate::observability::Observability;
use crate::registry::{MakeError, Registry};
use crate::rng::{EpisodeRng, Purpose, stream};
use crate::space::{Slab, Space, SpaceError, Value, ValueMut};

/// `rows` independent environments of one id, each with the random stream of its present episode.
///
/// Nothing here restarts an episode by itself: when a row's [`Step::done`] is true, the caller begins its next episode.
/// Beginning and stepping do not allocate. What a caller of `step` may get wrong is an error, and then no row has moved.
pub struct VecEnv {
    spec: EnvSpec,
    observability: Observability,
    rows: Box<dyn Rows>,
    phases: Vec<Phase>,
    /// How many of them are running.
    running: usize,
    /// The hidden states, where the level of observability asks for them.
    info: Option<Slab>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    New,
    Running,
    Over,
}

/// Why nothing was stepped.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum StepError {
    /// There is no such row.
    #[error("row {row} of a VecEnv of {rows} rows")]
    NoRow {
        /// The row asked for.
        row: usize,
        /// How many there are.
        rows: usize,
    },
    /// No episode was begun in this row.
    #[error("row {row} was stepped before its first episode was begun")]
    NotBegun {
        /// The row.
        row: usize,
    },
    /// The row's episode has ended.
    #[error("row {row} was stepped after the end of its episode")]
    Over {
        /// The row.
        row: usize,
    },
    /// The action is no point of the action space.
    #[error("row {row}: the action is outside its space: {error}")]
    Action {
        /// The row.
        row: usize,
        /// What is wrong with the action.
        error: SpaceError,
    },
    /// A slab does not have a row of the right width for each environment, or there are too few places for steps.
    #[error("the {what} have {found}, expected {expected}")]
    Shape {
        /// Which argument.
        what: &'static str,
        /// What was given.
        found: String,
        /// What fits.
        expected: String,
    },
}

impl VecEnv {
    /// `rows` environments that answer to `name`, as the benchmark shows them.
    ///
    /// # Errors
    /// If `registry` has no such environment.
    pub fn new(registry: &Registry, name: &str, rows: usize) -> Result<Self, MakeError> {
        Self::observing(registry, name, Observability::Partial, rows)
    }

    /// `rows` environments that answer to `name`, at a level of observability.
    ///
    /// # Errors
    /// If `registry` has no such environment, or it has no hidden state to show.
    pub fn observing(
        registry: &Registry,
        name: &str,
        observability: Observability,
        rows: usize,
    ) -> Result<Self, MakeError> {
        let entry = registry.get(name)?;
        let spec = entry.observed(observability)?;
        let info = (observability == Observability::FullInInfo).then(|| Slab::new(&spec.state, rows));
        Ok(Self {
            rows: entry.make_rows(observability, rows)?,
            phases: vec![Phase::New; rows],
            running: 0,
            spec,
            observability,
            info,
        })
    }

    /// Id, spaces and limits of each row; the observation is that of the level of observability.
    pub fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    /// How much the observations show.
    pub fn observability(&self) -> Observability {
        self.observability
    }

    /// Number of environments.
    pub fn rows(&self) -> usize {
        self.phases.len()
    }

    /// Number of rows whose episode is running.
    pub fn running(&self) -> usize {
        self.running
    }

    /// A slab with a row for each environment's observation.
    pub fn observations(&self) -> Slab {
        Slab::new(&self.spec.observation, self.rows())
    }

    /// A slab with a row for each environment's action.
    pub fn actions(&self) -> Slab {
        Slab::new(&self.spec.action, self.rows())
    }

    /// A slab with a row for each environment's hidden state.
    pub fn states(&self) -> Slab {
        Slab::new(&self.spec.state, self.rows())
    }

    /// Begins an episode in row `row`: draws its world from `rng`, which then serves the episode's per-step draws, and
    /// writes the first observation into the same row of `observations`.
    ///
    /// # Panics
    /// If there is no such row, or `observations` is not of the shape of [`VecEnv::observations`].
    pub fn begin(&mut self, row: usize, rng: EpisodeRng, observations: &mut Slab) {
        self.demand_row(row);
        self.demand_shape("observations", observations, &self.spec.observation);
        self.rows.begin(row, rng, observations.row_mut(row));
        self.running += usize::from(self.phases[row] != Phase::Running);
        self.phases[row] = Phase::Running;
        self.inform(row);
    }

    /// Takes `action` in row `row` and writes the next observation into the same row of `observations`.
    ///
    /// # Errors
    /// No such row, no episode there or one that has ended, an action outside its space, or a slab of another shape.
    pub fn step(&mut self, row: usize, action: Value<'_>, observations: &mut Slab) -> Result<Step, StepError> {
        self.check_shape("observations", observations, &self.spec.observation)?;
        self.check(row, action)?;
        let step = self.rows.step(row, action, observations.row_mut(row));
        self.arrive(row, step);
        Ok(step)
    }

    /// Steps every row: row `r` takes the action in row `r` of `actions`, and writes into row `r` of `observations` and
    /// into `steps[r]`. Gives the number of episodes that this ended.
    ///
    /// # Errors
    /// As [`VecEnv::step`], for the first row that is wrong.
    pub fn step_all(
        &mut self,
        actions: &Slab,
        observations: &mut Slab,
        steps: &mut [Step],
    ) -> Result<usize, StepError> {
        self.check_shape("actions", actions, &self.spec.action)?;
        self.check_shape("observations", observations, &self.spec.observation)?;
        if steps.len() != self.rows() {
            let (found, expected) = (steps.len().to_string(), self.rows().to_string());
            return Err(StepError::Shape { what: "steps", found, expected });
        }
        if self.running < self.rows() || !self.spec.action.holds_all(actions) {
            (0..self.rows()).try_for_each(|row| self.check(row, actions.row(row)))?;
        }
        let ended = self.rows.step_all(actions, observations, steps);
        if ended > 0 {
            self.running -= ended;
            for (phase, step) in self.phases.iter_mut().zip(&*steps) {
                *phase = if step.done() { Phase::Over } else { Phase::Running };
            }
        }
        if self.info.is_some() {
            (0..self.rows()).for_each(|row| self.inform(row));
        }
        Ok(ended)
    }

    /// Writes the hidden state of row `row` into the same row of `states`.
    ///
    /// # Panics
    /// If there is no such row, or `states` is not of the shape of [`VecEnv::states`].
    pub fn state(&self, row: usize, states: &mut Slab) {
        self.demand_row(row);
        self.demand_shape("states", states, &self.spec.state);
        self.rows.env(row).state(states.row_mut(row));
    }

    /// The hidden state of row `row` as of its last observation, at the level [`Observability::FullInInfo`].
    ///
    /// # Panics
    /// If there is no such row.
    pub fn info(&self, row: usize) -> Option<Value<'_>> {
        self.info.as_ref().map(|info| info.row(row))
    }

    /// Draws row `row` on an empty canvas.
    ///
    /// # Panics
    /// If there is no such row.
    pub fn render(&self, row: usize, view: View, canvas: &mut Canvas) {
        self.rows.env(row).render(view, canvas);
    }

    /// What the classes of a `Discrete` action are called, in order; empty if they have no names.
    pub fn action_names(&self) -> &'static [&'static str] {
        if self.phases.is_empty() { &[] } else { self.rows.env(0).action_names() }
    }

    #[inline]
    fn check(&self, row: usize, action: Value<'_>) -> Result<(), StepError> {
        match self.phases.get(row) {
            Some(Phase::Running) => {}
            Some(Phase::Over) => return Err(StepError::Over { row }),
            Some(Phase::New) => return Err(StepError::NotBegun { row }),
            None => return Err(StepError::NoRow { row, rows: self.rows() }),
        }
        self.spec.action.check(action).map_err(|error| StepError::Action { row, error })
    }

    fn check_shape(&self, what: &'static str, slab: &Slab, space: &Space) -> Result<(), StepError> {
        let widths = space.widths();
        if slab.widths() == widths
            && slab.discrete.len() == self.rows() * widths.0
            && slab.real.len() == self.rows() * widths.1
        {
            return Ok(());
        }
        let shape = |discrete: usize, real: usize, (wide, real_wide): (usize, usize)| {
            format!("{discrete} classes in rows of {wide} and {real} reals in rows of {real_wide}")
        };
        let found = shape(slab.discrete.len(), slab.real.len(), slab.widths());
        Err(StepError::Shape { what, found, expected: shape(self.rows() * widths.0, self.rows() * widths.1, widths) })
    }

    fn demand_row(&self, row: usize) {
        assert!(row < self.rows(), "{}", StepError::NoRow { row, rows: self.rows() });
    }

    fn demand_shape(&self, what: &'static str, slab: &Slab, space: &Space) {
        self.check_shape(what, slab, space).unwrap_or_else(|error| panic!("{error}"));
    }

    #[inline]
    fn arrive(&mut self, row: usize, step: Step) {
        if step.done() {
            self.phases[row] = Phase::Over;
            self.running -= 1;
        }
        self.inform(row);
    }

    #[inline]
    fn inform(&mut self, row: usize) {
        if let Some(info) = &mut self.info {
            self.rows.env(row).state(info.row_mut(row));
        }
    }
}

/// Environments of one type, so that a step of many is one dynamic call and not one a row.
pub(crate) trait Rows: Send {
    fn begin(&mut self, row: usize, rng: EpisodeRng, observation: ValueMut<'_>);
    fn step(&mut self, row: usize, action: Value<'_>, observation: ValueMut<'_>) -> Step;
    fn step_all(&mut self, actions: &Slab, observations: &mut Slab, steps: &mut [Step]) -> usize;
    fn env(&self, row: usize) -> &dyn Env;
}

/// The rows of a [`VecEnv`]. Environments and streams lie apart, so that neither is in the way of the other in the cache.
pub(crate) struct Typed<E> {
    envs: Vec<E>,
    rngs: Vec<EpisodeRng>,
}

impl<E: Env> Typed<E> {
    pub(crate) fn new(envs: impl Iterator<Item = E>) -> Self {
        let envs: Vec<E> = envs.collect();
        // Placeholders: `begin` brings the stream of the episode.
        let rngs = envs.iter().map(|_| stream(0, 0, 0, Purpose::TrainEnv)).collect();
        Self { envs, rngs }
    }
}

impl<E: Env> Rows for Typed<E> {
    fn begin(&mut self, row: usize, rng: EpisodeRng, observation: ValueMut<'_>) {
        let (env, own) = (&mut self.envs[row], &mut self.rngs[row]);
        *own = rng;
        env.draw_world(own);
        env.begin(own, observation);
    }

    fn step(&mut self, row: usize, action: Value<'_>, observation: ValueMut<'_>) -> Step {
        self.envs[row].step(action, &mut self.rngs[row], observation)
    }

    fn step_all(&mut self, actions: &Slab, observations: &mut Slab, steps: &mut [Step]) -> usize {
        E::step_all(&mut self.envs, &mut self.rngs, actions, observations, steps);
        steps.iter().filter(|step| step.done()).count()
    }

    fn env(&self, row: usize) -> &dyn Env {
        &self.envs[row]
    }
}
