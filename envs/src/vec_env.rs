//! Many environments of one id, stepped into storage that the caller owns.

use crate::env::{Env, EnvSpec, Step};
use crate::registry::{Registry, UnknownEnv};
use crate::rng::{EpisodeRng, Purpose, stream};
use crate::space::{Slab, Value};

/// `rows` independent environments of one id, each with the random stream of its present episode.
///
/// Nothing here restarts an episode by itself: when a row's [`Step::done`] is true, the caller begins its next episode.
/// Beginning and stepping do not allocate.
pub struct VecEnv {
    spec: EnvSpec,
    rows: Vec<Row>,
}

struct Row {
    env: Box<dyn Env>,
    rng: EpisodeRng,
}

impl VecEnv {
    /// `rows` environments that answer to `name`.
    ///
    /// # Errors
    /// If `registry` has no such environment.
    pub fn new(registry: &Registry, name: &str, rows: usize) -> Result<Self, UnknownEnv> {
        let entry = registry.get(name)?;
        // A placeholder: `begin` brings the stream of the episode.
        let row = || Row { env: entry.make(), rng: stream(0, 0, 0, Purpose::TrainEnv) };
        Ok(Self { spec: entry.spec.clone(), rows: (0..rows).map(|_| row()).collect() })
    }

    /// Id, spaces and limits of each row.
    pub fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    /// Number of environments.
    pub fn rows(&self) -> usize {
        self.rows.len()
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
    pub fn begin(&mut self, row: usize, rng: EpisodeRng, observations: &mut Slab) {
        let Row { env, rng: own } = &mut self.rows[row];
        *own = rng;
        env.draw_world(own);
        env.begin(own, observations.row_mut(row));
    }

    /// Takes `action` in row `row` and writes the next observation into the same row of `observations`.
    pub fn step(&mut self, row: usize, action: Value<'_>, observations: &mut Slab) -> Step {
        let Row { env, rng } = &mut self.rows[row];
        env.step(action, rng, observations.row_mut(row))
    }

    /// Steps each of `rows`, in their order. Row `r` takes the action in row `r` of `actions`, and writes into row `r`
    /// of `observations` and into `steps[r]`; what belongs to other rows stays as it is.
    pub fn step_rows(&mut self, rows: &[usize], actions: &Slab, observations: &mut Slab, steps: &mut [Step]) {
        for &row in rows {
            steps[row] = self.step(row, actions.row(row), observations);
        }
    }

    /// Writes the hidden state of row `row` into the same row of `states`.
    pub fn state(&self, row: usize, states: &mut Slab) {
        self.rows[row].env.state(states.row_mut(row));
    }
}
