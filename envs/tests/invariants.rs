//! What holds for every environment of the registry, on random episodes.

mod common;

use std::collections::HashMap;

use common::{play_drawn, play_randomly};
use popgym_envs::canvas::SYMBOLS;
use popgym_envs::{
    Canvas, Entry, Env, EpisodeRng, Leaf, Purpose, Registry, Slab, Space, SpaceError, Step, StepError, Value, VecEnv,
    View, stream,
};
use proptest::prelude::*;

/// Few cases, each of which goes through all environments.
fn config() -> ProptestConfig {
    ProptestConfig::with_cases(4)
}

fn env_stream(index: u64) -> EpisodeRng {
    stream(1, 0, index, Purpose::EvalEnv)
}

proptest! {
    #![proptest_config(config())]

    /// Observations and states are points of their spaces (which `play` checks), returns and lengths within the spec.
    #[test]
    fn episodes_stay_within_their_spec(seed: u64) {
        for entry in &Registry::standard() {
            let episode = play_randomly(entry.make().as_mut(), 0, seed);
            let (low, high) = entry.spec.return_range;
            let total = episode.total();
            prop_assert!(low - 1e-9 <= total && total <= high + 1e-9, "{}: {total}", entry.id());
            prop_assert!(episode.steps.iter().all(|step| step.reward.is_finite()), "{}", entry.id());
            prop_assert!(episode.steps.len() <= entry.spec.max_steps as usize, "{}", entry.id());
        }
    }

    /// The world can be taken out, written down, and put into another environment: with the same draws and actions that
    /// is the same episode.
    #[test]
    fn a_world_given_is_a_world_drawn(seed: u64) {
        for entry in &Registry::standard() {
            let mut env = entry.make();
            let episode = play_randomly(env.as_mut(), 0, seed);
            let world = env.world();
            // As a file has it.
            let written: serde_json::Value = serde_json::from_str(&world.to_string()).unwrap();
            prop_assert_eq!(&written, &world, "{}", entry.id());

            let mut given = entry.make();
            prop_assert_eq!(given.set_world(&written), Ok(()), "{}", entry.id());
            prop_assert_eq!(given.world(), world, "{}", entry.id());
            // The stream after the world was drawn from it.
            let mut draws = stream(1, 0, seed, Purpose::EvalEnv);
            entry.make().draw_world(&mut draws);
            let again = common::play(given.as_mut(), &mut draws, |t, _, action| action.set(0, episode.actions.row(t)));
            prop_assert_eq!(again, episode, "{}", entry.id());
        }
    }

    /// Between a new world and the begin of its episode there still is a state to ask for and a picture to draw, whether
    /// or not another episode was played before.
    #[test]
    fn a_world_may_be_set_at_any_time(seed: u64) {
        for entry in &Registry::standard() {
            let [mut drawn, mut new, mut used] = [(); 3].map(|()| entry.make());
            drawn.draw_world(&mut env_stream(seed));
            play_randomly(used.as_mut(), 0, seed ^ 1);
            let mut state = Slab::new(&entry.spec.state, 1);
            for env in [&mut new, &mut used] {
                prop_assert_eq!(env.set_world(&drawn.world()), Ok(()), "{}", entry.id());
                env.state(state.row_mut(0));
                prop_assert_eq!(entry.spec.state.check(state.row(0)), Ok(()), "{}", entry.id());
                for view in [View::Observed, View::Revealed] {
                    env.render(view, &mut Canvas::new());
                }
            }
        }
    }

    /// Neither an earlier episode nor another instance shows.
    #[test]
    fn the_same_seed_is_the_same_episode(epoch: u64, index: u64, before: u64) {
        for entry in &Registry::standard() {
            let mut used = entry.make();
            play_randomly(used.as_mut(), epoch, before);
            let again = play_randomly(used.as_mut(), epoch, index);
            prop_assert_eq!(again, play_randomly(entry.make().as_mut(), epoch, index), "{}", entry.id());
        }
    }
}

#[test]
fn another_epoch_or_index_is_another_episode() {
    for entry in &Registry::standard() {
        let mut env = entry.make();
        // Always the same action, so that only worlds and per-step draws can differ.
        let episodes = [(3, 5), (3, 6), (4, 5), (5, 3)].map(|(epoch, index)| {
            let random = play_randomly(env.as_mut(), epoch, index);
            (play_drawn(env.as_mut(), epoch, index, |_, _, _| {}), random)
        });
        for i in 0..episodes.len() {
            for j in 0..i {
                assert_ne!(episodes[i].0.states, episodes[j].0.states, "{}", entry.id());
                assert_ne!(episodes[i].1.actions, episodes[j].1.actions, "{}", entry.id());
            }
        }
    }
}

const ROWS: usize = 3;

/// Environments that step together.
struct Many {
    envs: VecEnv,
    actions: Slab,
    observations: Slab,
    steps: Vec<Step>,
}

impl Many {
    /// The first `rows` of them begun.
    fn new(registry: &Registry, entry: &Entry, rows: usize) -> Self {
        let envs = VecEnv::new(registry, entry.id(), ROWS).unwrap();
        let (actions, observations) = (envs.actions(), envs.observations());
        let mut many = Self { envs, actions, observations, steps: vec![Step::default(); ROWS] };
        (0..rows).for_each(|row| many.begin(row, row as u64));
        many
    }

    fn begin(&mut self, row: usize, index: u64) {
        self.envs.begin(row, env_stream(index), &mut self.observations);
    }

    fn sample(&mut self, t: u64) {
        let space = self.envs.spec().action.clone();
        space.sample_rows(&mut stream(2, 0, t, Purpose::EvalAction), &mut self.actions);
    }

    fn step_all(&mut self) -> Result<usize, StepError> {
        self.envs.step_all(&self.actions, &mut self.observations, &mut self.steps)
    }

    fn step(&mut self, row: usize) -> Result<Step, StepError> {
        self.envs.step(row, self.actions.row(row), &mut self.observations)
    }

    /// All that can be seen of them.
    fn seen(&self) -> (Slab, Slab, Vec<Step>) {
        let mut states = self.envs.states();
        (0..ROWS).for_each(|row| self.envs.state(row, &mut states));
        (self.observations.clone(), states, self.steps.clone())
    }

    /// `attempt` is refused with an error, and moves nothing.
    fn refuses<T: std::fmt::Debug>(&mut self, attempt: impl FnOnce(&mut Self) -> Result<T, StepError>) -> StepError {
        let before = self.seen();
        let error = attempt(self).unwrap_err();
        assert_eq!(self.seen(), before, "{}: {error}", self.envs.spec().id);
        error
    }
}

#[test]
fn rows_are_stepped_only_while_their_episode_runs() {
    let registry = Registry::standard();
    for entry in &registry {
        let id = entry.id();
        let mut many = Many::new(&registry, entry, ROWS - 1);
        // The same without the mistakes: they must not show later.
        let mut twin = Many::new(&registry, entry, ROWS - 1);
        assert_eq!(many.refuses(Many::step_all), StepError::NotBegun { row: 2 }, "{id}");
        assert_eq!(many.refuses(|many| many.step(2)), StepError::NotBegun { row: 2 }, "{id}");
        for envs in [&mut many, &mut twin] {
            envs.begin(2, 2);
        }
        let no_row = |many: &mut Many| many.envs.step(ROWS, many.actions.row(0), &mut many.observations);
        assert_eq!(many.refuses(no_row), StepError::NoRow { row: ROWS, rows: ROWS }, "{id}");

        let mut t = 0;
        while !many.steps.iter().any(Step::done) {
            for envs in [&mut many, &mut twin] {
                envs.sample(t);
                envs.step_all().unwrap();
            }
            t += 1;
        }
        let over = many.steps.iter().position(Step::done).unwrap();
        assert_eq!(many.refuses(Many::step_all), StepError::Over { row: over }, "{id}");
        assert_eq!(many.refuses(|many| many.step(over)), StepError::Over { row: over }, "{id}");

        // Those that still run go on as if nothing had been, and a new episode begins as ever.
        let running: Vec<usize> = (0..ROWS).filter(|&row| !many.steps[row].done()).collect();
        for row in running {
            for envs in [&mut many, &mut twin] {
                envs.steps[row] = envs.step(row).unwrap();
            }
        }
        assert_eq!(many.seen(), twin.seen(), "{id}");
        let mut fresh = Many::new(&registry, entry, ROWS);
        for row in 0..ROWS {
            many.begin(row, row as u64);
        }
        for t in 0..3 {
            assert_eq!(many.seen().1, fresh.seen().1, "{id}");
            for envs in [&mut many, &mut fresh] {
                envs.sample(t);
                envs.step_all().unwrap();
            }
            if many.steps.iter().any(Step::done) {
                break;
            }
        }
    }
}

/// For every component of the action space: what is at its limits, and what is beyond.
fn borders(space: &Space) -> Vec<(bool, usize, Vec<f32>, Vec<f32>)> {
    let (mut discrete, mut real) = (0.., 0..);
    let far = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    (space.leaves().into_iter())
        .map(|leaf| match leaf {
            Leaf::Discrete { classes } => {
                let beyond = if classes < 256 { vec![f32::from(classes), 255.0] } else { vec![] };
                (true, discrete.next().unwrap(), vec![0.0, f32::from(classes - 1)], beyond)
            }
            Leaf::Real { low, high } => {
                let beyond = far.into_iter().chain([low.next_down(), high.next_up()]).collect();
                (false, real.next().unwrap(), vec![low.max(f32::MIN), high.min(f32::MAX)], beyond)
            }
        })
        .collect()
}

#[test]
fn actions_are_taken_up_to_their_limits_and_not_beyond() {
    let registry = Registry::standard();
    for entry in &registry {
        for (is_class, index, at_limit, beyond) in borders(&entry.spec.action) {
            for row in 0..ROWS {
                let put = |many: &mut Many, value: f32| {
                    let out = many.actions.row_mut(row);
                    if is_class { out.discrete[index] = value as u8 } else { out.real[index] = value }
                };
                for &value in &at_limit {
                    let mut many = Many::new(&registry, entry, ROWS);
                    put(&mut many, value);
                    many.step_all().unwrap();
                }
                let mut many = Many::new(&registry, entry, ROWS);
                for &value in &beyond {
                    put(&mut many, value);
                    for error in [many.refuses(Many::step_all), many.refuses(|many| many.step(row))] {
                        let StepError::Action { row: found, error } = error else { panic!("{}: {error}", entry.id()) };
                        let named = match error {
                            SpaceError::Class { index, .. } => (true, index),
                            SpaceError::Real { index, .. } => (false, index),
                            SpaceError::Width { .. } => panic!("{}: {error}", entry.id()),
                        };
                        assert_eq!((found, named), (row, (is_class, index)), "{}", entry.id());
                    }
                }
            }
        }
    }
}

#[test]
fn slabs_of_another_shape_are_refused() {
    let registry = Registry::standard();
    for entry in &registry {
        let id = entry.id();
        let mut many = Many::new(&registry, entry, ROWS);
        let shape = |error: StepError| {
            let StepError::Shape { what, .. } = error else { panic!("{id}: {error}") };
            what
        };
        let wider = |space: &Space| Space::Tuple(vec![space.clone(), Space::uniform_box(1, 0.0, 0.0)]);
        for rows in [0, ROWS - 1, ROWS + 1] {
            let mut few = Slab::new(&entry.spec.observation, rows);
            let action = Slab::new(&entry.spec.action, rows);
            let (actions, mut steps) = (many.actions.clone(), vec![Step::default(); rows]);
            let found = [
                many.refuses(|many| many.envs.step_all(&actions, &mut few, &mut many.steps)),
                many.refuses(|many| many.envs.step(0, actions.row(0), &mut few)),
                many.refuses(|many| many.envs.step_all(&action, &mut many.observations, &mut many.steps)),
                many.refuses(|many| many.envs.step_all(&actions, &mut many.observations, &mut steps)),
            ];
            assert_eq!(found.map(shape), ["observations", "observations", "actions", "steps"]);
            assert_eq!(few, Slab::new(&entry.spec.observation, rows), "{id}");
        }
        let mut wide = Slab::new(&wider(&entry.spec.observation), ROWS);
        let wide_actions = Slab::new(&wider(&entry.spec.action), ROWS);
        let actions = many.actions.clone();
        let found = [
            many.refuses(|many| many.envs.step_all(&actions, &mut wide, &mut many.steps)),
            many.refuses(|many| many.envs.step(0, actions.row(0), &mut wide)),
            many.refuses(|many| many.envs.step_all(&wide_actions, &mut many.observations, &mut many.steps)),
        ];
        assert_eq!(found.map(shape), ["observations", "observations", "actions"]);
        // One action of another width is no slab, but no point of the space either.
        let error = many.refuses(|many| many.envs.step(0, wide_actions.row(0), &mut many.observations));
        assert!(matches!(error, StepError::Action { row: 0, error: SpaceError::Width { .. } }), "{id}: {error}");
        many.step_all().unwrap();
    }
}

/// Numbers that actions have in pictures: classes, or combinations of two components.
fn action_numbers(space: &Space) -> u16 {
    match space {
        Space::Discrete(classes) => *classes,
        Space::MultiDiscrete(n) if n.len() == 2 => n[0] * n[1],
        _ => 0,
    }
}

fn check_picture(entry: &Entry, view: View, canvas: &Canvas) {
    let at = format!("{} {view:?}:\n{}", entry.id(), canvas.to_text());
    assert!(canvas.width() <= 100 && canvas.height() <= 40, "{} x {}, {at}", canvas.width(), canvas.height());
    let glyphs = || canvas.rows().iter().flatten();
    assert!(glyphs().any(|glyph| glyph.symbol != ' '), "nothing is drawn, {at}");
    let numbers = action_numbers(&entry.spec.action);
    for glyph in glyphs() {
        let known = glyph.symbol == ' ' || glyph.symbol.is_ascii_graphic() || SYMBOLS.contains(glyph.symbol);
        assert!(known, "{:?}, {at}", glyph.symbol);
        assert!(glyph.action.is_none_or(|action| action < numbers), "action {:?}, {at}", glyph.action);
    }
}

/// The observed picture is a function of the present observation and the last action: moments that do not differ in
/// them look alike.
#[test]
fn pictures_can_be_drawn_and_show_no_more_than_they_should() {
    for entry in &Registry::standard() {
        let mut env = entry.make();
        let mut looks: HashMap<_, Canvas> = HashMap::new();
        for index in 0..3 {
            let [mut observation, mut action] =
                [&entry.spec.observation, &entry.spec.action].map(|space| Slab::new(space, 1));
            let (mut rng, mut policy) = (env_stream(index), stream(3, 0, index, Purpose::EvalAction));
            env.draw_world(&mut rng);
            env.begin(&mut rng, observation.row_mut(0));
            let mut last = None;
            let mut done = false;
            loop {
                for view in [View::Observed, View::Revealed] {
                    let mut canvas = Canvas::new();
                    env.render(view, &mut canvas);
                    check_picture(entry, view, &canvas);
                    if view == View::Observed {
                        let bits = |value: Value<'_>| {
                            (value.discrete.to_vec(), value.real.iter().map(|x| x.to_bits()).collect::<Vec<_>>())
                        };
                        let known =
                            looks.entry((bits(observation.row(0)), last.clone())).or_insert_with(|| canvas.clone());
                        assert_eq!(known.to_ansi(), canvas.to_ansi(), "{} remembers", entry.id());
                    }
                }
                if done {
                    break;
                }
                entry.spec.action.sample_into(&mut policy, action.row_mut(0));
                last = Some((action.discrete.clone(), action.real.iter().map(|x| x.to_bits()).collect::<Vec<_>>()));
                done = env.step(action.row(0), &mut rng, observation.row_mut(0)).done();
            }
        }
    }
}

/// The names of the actions, if they have any, are as many as the actions.
#[test]
fn actions_are_named_all_or_none() {
    for entry in &Registry::standard() {
        let names = entry.make().action_names();
        let Space::Discrete(classes) = entry.spec.action else {
            assert!(names.is_empty(), "{}", entry.id());
            continue;
        };
        assert!(names.is_empty() || names.len() == usize::from(classes), "{}", entry.id());
    }
}
