//! What several tests need: playing an episode.
#![allow(dead_code, reason = "each test binary uses a part")]

use std::collections::HashMap;

use popgym_envs::{Canvas, Draws, Env, EpisodeRng, Purpose, Slab, Step, Value, View, stream};

/// Everything seen in one episode, `T` steps long.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Episode {
    /// `T + 1` rows.
    pub(crate) observations: Slab,
    /// `T + 1` rows.
    pub(crate) states: Slab,
    /// `T` rows.
    pub(crate) actions: Slab,
    /// The outcome of each action.
    pub(crate) steps: Vec<Step>,
}

impl Episode {
    pub(crate) fn total(&self) -> f64 {
        self.steps.iter().map(|step| step.reward).sum()
    }
}

/// Plays the environment's present world to its end. `act(t, observations so far, action to write)` chooses.
pub(crate) fn play(env: &mut dyn Env, draws: &mut dyn Draws, mut act: impl FnMut(usize, &Slab, &mut Slab)) -> Episode {
    let spec = env.spec().clone();
    let (mut observation, mut state) = (Slab::new(&spec.observation, 1), Slab::new(&spec.state, 1));
    let mut action = Slab::new(&spec.action, 1);
    let mut episode = Episode {
        observations: Slab::new(&spec.observation, 0),
        states: Slab::new(&spec.state, 0),
        actions: Slab::new(&spec.action, 0),
        steps: Vec::new(),
    };
    env.begin(draws, observation.row_mut(0));
    loop {
        env.state(state.row_mut(0));
        spec.observation.check(observation.row(0)).unwrap();
        spec.state.check(state.row(0)).unwrap();
        episode.observations.push(observation.row(0));
        episode.states.push(state.row(0));
        if episode.steps.last().is_some_and(Step::done) {
            return episode;
        }
        assert!(episode.steps.len() < spec.max_steps as usize, "{} runs beyond max_steps", spec.id);
        act(episode.steps.len(), &episode.observations, &mut action);
        episode.actions.push(action.row(0));
        episode.steps.push(env.step(action.row(0), draws, observation.row_mut(0)));
    }
}

/// Plays an episode whose world is drawn from stream `(epoch, index)`, with uniformly random actions.
pub(crate) fn play_randomly(env: &mut dyn Env, epoch: u64, index: u64) -> Episode {
    let space = env.spec().action.clone();
    let mut policy = stream(1, epoch, index, Purpose::EvalAction);
    play_drawn(env, epoch, index, |_, _, action| space.sample_into(&mut policy, action.row_mut(0)))
}

/// Plays an episode whose world is drawn from stream `(epoch, index)`.
pub(crate) fn play_drawn(
    env: &mut dyn Env,
    epoch: u64,
    index: u64,
    act: impl FnMut(usize, &Slab, &mut Slab),
) -> Episode {
    let mut rng: EpisodeRng = stream(1, epoch, index, Purpose::EvalEnv);
    env.draw_world(&mut rng);
    play(env, &mut rng, act)
}

/// An action or observation of discrete components only.
pub(crate) fn discrete(classes: &[u8]) -> Value<'_> {
    Value { discrete: classes, real: &[] }
}

/// What a view of the present moment shows, as text.
pub(crate) fn picture(env: &dyn Env, view: View) -> String {
    let mut canvas = Canvas::new();
    env.render(view, &mut canvas);
    canvas.to_text()
}

/// Plays random episodes, and checks that the observed picture, with its colours, tells nothing but the observation and
/// the last action: wherever these two are the same, so is the picture. (At the reset there is no last action.)
pub(crate) fn assert_observed_is_all_that_is_shown(env: &mut dyn Env, episodes: u64) {
    let spec = env.spec().clone();
    let (mut observation, mut action) = (Slab::new(&spec.observation, 1), Slab::new(&spec.action, 1));
    let mut shown = HashMap::new();
    let mut twice = 0;
    for index in 0..episodes {
        let mut policy = stream(5, 0, index, Purpose::EvalAction);
        let mut rng: EpisodeRng = stream(5, 0, index, Purpose::EvalEnv);
        env.draw_world(&mut rng);
        env.begin(&mut rng, observation.row_mut(0));
        let mut last = None;
        loop {
            let mut canvas = Canvas::new();
            env.render(View::Observed, &mut canvas);
            let bits = |slab: &Slab| (slab.discrete.clone(), slab.real.iter().map(|x| x.to_bits()).collect::<Vec<_>>());
            let before = shown.insert((bits(&observation), last.is_some().then(|| bits(&action))), canvas.clone());
            twice += usize::from(before.is_some());
            assert!(before.is_none_or(|before| before == canvas), "{}: {}", spec.id, canvas.to_text());
            if last.is_some_and(|step: Step| step.done()) {
                break;
            }
            spec.action.sample_into(&mut policy, action.row_mut(0));
            last = Some(env.step(action.row(0), &mut rng, observation.row_mut(0)));
        }
    }
    assert!(twice > shown.len(), "{}: too few moments look the same", spec.id);
}
