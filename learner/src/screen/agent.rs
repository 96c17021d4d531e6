//! A trained policy that acts in one environment at a time.

use popgym_envs::{EnvSpec, EpisodeRng, Purpose, Slab, Value, stream};
use popgym_models::{Marginals, Policy, State};
use tch::Tensor;

/// What the policy made of an observation.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Decision {
    /// The distribution of the action.
    pub marginals: Marginals,
    /// What the critic expects: the discounted sum of the rewards to come.
    pub value: f64,
}

/// A policy, its memory of the episode, and the action it has chosen. It acts as an actor's row does in an evaluation,
/// number for number.
pub(crate) struct Agent {
    policy: Policy,
    greedy: bool,
    /// Rows to compute: one is the episode's, the others are padding, as actors have it.
    rows: usize,
    state: State,
    rng: EpisodeRng,
    stored: Slab,
    action: Slab,
    first: bool,
}

impl Agent {
    /// `policy` in an environment of this spec. `greedy`: it takes the likeliest action and draws none.
    pub(crate) fn new(policy: Policy, spec: &EnvSpec, rows: u32, greedy: bool) -> Self {
        Self {
            state: policy.initial_state(i64::from(rows)),
            rng: stream(0, 0, 0, Purpose::EvalAction),
            stored: Slab::new(&policy.distribution().stored_space(), 1),
            action: Slab::new(&spec.action, 1),
            rows: rows as usize,
            first: true,
            policy,
            greedy,
        }
    }

    /// Forgets everything; `rng` draws the actions of the episode that begins.
    pub(crate) fn begin(&mut self, rng: EpisodeRng) {
        self.state = self.policy.initial_state(self.rows as i64);
        self.rng = rng;
        self.first = true;
    }

    /// Sees the next observation, and chooses an action.
    pub(crate) fn decide(&mut self, observation: Value<'_>) -> Decision {
        let width = self.policy.encoder().width();
        let mut features = vec![0.0; self.rows * width];
        self.policy.encoder().encode(observation, self.action.row(0), self.first, &mut features[..width]);
        self.first = false;
        let features = Tensor::from_slice(&features).view([self.rows as i64, width as i64]);
        let (params, values, state) = self.policy.step(&features, &self.state);
        self.state = state;
        let distribution = self.policy.distribution();
        let mut row = vec![0.0f32; distribution.width()];
        let numbers = row.len();
        params.get(0).contiguous().copy_data(&mut row, numbers);
        if self.greedy {
            distribution.mode(&row, self.stored.row_mut(0));
        } else {
            distribution.sample(&row, &mut self.rng, self.stored.row_mut(0));
        }
        distribution.to_env(self.stored.row(0), self.action.row_mut(0));
        Decision { marginals: distribution.marginals(&row), value: values.double_value(&[0]) }
    }

    /// The action that was chosen last.
    pub(crate) fn action(&self) -> Value<'_> {
        self.action.row(0)
    }
}
