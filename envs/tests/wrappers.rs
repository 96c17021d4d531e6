//! Wrappers: what they append, flatten and count, around every environment.
#![allow(clippy::float_cmp, reason = "zeros, ones and copies are compared")]

mod common;

use common::{discrete, play, play_drawn, play_randomly};
use popgym_envs::battleship::{self, Battleship};
use popgym_envs::wrappers::{Antialias, DiscreteAction, Flatten, PreviousAction};
use popgym_envs::{
    Draws, Entry, Env, EnvSpec, EpisodeRng, Leaf, Observability, Observed, Purpose, Recorded, Registry, Slab, Space,
    SpaceError, Step, Value, ValueMut, VecEnv, stream,
};

type Boxed = Box<dyn Env>;

fn make(name: &str) -> Boxed {
    Registry::standard().make(name).unwrap()
}

/// As the paper's agents saw it.
fn paper(env: Boxed) -> Flatten<Antialias<PreviousAction<Boxed>>> {
    Flatten::new(Antialias::new(PreviousAction::new(env))).unwrap()
}

/// One-hot, by the spaces' leaves.
fn flat(space: &Space, value: Value<'_>) -> Vec<f32> {
    let (mut classes, mut reals) = (value.discrete.iter(), value.real.iter());
    space
        .leaves()
        .iter()
        .flat_map(|leaf| match leaf {
            Leaf::Real { .. } => vec![*reals.next().unwrap()],
            Leaf::Discrete { classes: n } => {
                let class = *classes.next().unwrap();
                (0..*n).map(|i| f32::from(u8::from(i == u16::from(class)))).collect()
            }
        })
        .collect()
}

/// Width of the paper's observations of each game: easy, medium, hard.
const WIDTHS: [(&str, [usize; 3]); 16] = [
    ("Autoencode", [12; 3]),
    ("RepeatPrevious", [10; 3]),
    ("RepeatFirst", [10; 3]),
    ("CountRecall", [33, 37, 45]),
    ("PositionOnlyCartPole", [6; 3]),
    ("VelocityOnlyCartPole", [6; 3]),
    ("NoisyPositionOnlyCartPole", [6; 3]),
    ("PositionOnlyPendulum", [5; 3]),
    ("NoisyPositionOnlyPendulum", [5; 3]),
    ("MultiarmedBandit", [14, 24, 34]),
    ("HigherLower", [17; 3]),
    ("Battleship", [20, 24, 28]),
    ("Concentration", [210, 418, 782]),
    ("MineSweeper", [13, 21, 28]),
    ("LabyrinthEscape", [56; 3]),
    ("LabyrinthExplore", [56; 3]),
];

fn published_width(entry: &Entry) -> usize {
    let difficulty = entry.difficulty.unwrap();
    let (_, widths) = WIDTHS.iter().find(|(class, _)| entry.name == format!("{class}{difficulty}")).unwrap();
    widths[difficulty as usize]
}

/// Observation, previous action and flag of every environment, against what the bare environment shows.
#[test]
fn the_papers_observations_have_the_published_layout() {
    for entry in &Registry::standard() {
        let mut wrapped = paper(entry.make());
        let spec = wrapped.spec().clone();
        assert_eq!(spec.observation.flat_width(), published_width(entry), "{}", entry.id());
        assert!(matches!(spec.observation, Space::Box { .. }));
        // Everything else is the environment's.
        assert_eq!(EnvSpec { observation: entry.spec.observation.clone(), ..spec }, entry.spec);

        let bare = play_randomly(entry.make().as_mut(), 0, 3);
        let seen = play_drawn(&mut wrapped, 0, 3, |t, _, action| action.set(0, bare.actions.row(t)));
        assert_eq!((&seen.steps, &seen.states), (&bare.steps, &bare.states));
        // No environment's box leaves zero out.
        let null = Slab::new(&entry.spec.action, 1);
        for t in 0..=bare.steps.len() {
            let previous = if t == 0 { null.row(0) } else { bare.actions.row(t - 1) };
            let flag: &[f32] = if t == 0 { &[0.0, 1.0] } else { &[1.0, 0.0] };
            let (observation, action) = (&entry.spec.observation, &entry.spec.action);
            let expected =
                [flat(observation, bare.observations.row(t)), flat(action, previous), flag.to_vec()].concat();
            assert_eq!(seen.observations.row(t).real, expected, "{} at {t}", entry.id());
        }
    }
}

/// The published examples: the first observation of three games, and that of a pendulum after a step.
#[test]
fn first_observations_are_the_published_ones() {
    let first = |name: &str| {
        let mut env = paper(make(name));
        let mut observation = Slab::new(&env.spec().observation, 1);
        env.draw_world(&mut stream(0, 0, 0, Purpose::TrainEnv));
        env.begin(&mut Recorded::default(), observation.row_mut(0));
        observation.real
    };
    let board = first("BattleshipEasy");
    // No hit, row 0, column 0, first step.
    assert_eq!((0..20).filter(|&i| board[i] == 1.0).collect::<Vec<_>>(), [0, 2, 10, 19]);
    let rod = first("PositionOnlyPendulumEasy");
    assert!((rod[0].hypot(rod[1]) - 1.0).abs() < 1e-6);
    assert_eq!(rod[2..], [0.0, 0.0, 1.0]);
    let cart = first("PositionOnlyCartPoleEasy");
    assert!(cart[0].abs() < 0.05 && cart[1].abs() < 0.05);
    assert_eq!(cart[2..], [1.0, 0.0, 0.0, 1.0]);

    let mut env = paper(make("PositionOnlyPendulumEasy"));
    let episode = play_drawn(&mut env, 0, 0, |_, _, action| action.real[0] = -1.25);
    assert_eq!(episode.observations.row(1).real[2..], [-1.25, 1.0, 0.0]);
    // The torque is shown raw.
    let Space::Box { low, high } = env.spec().observation.clone() else { panic!() };
    assert_eq!((low, high), (vec![-1.0, -1.0, -2.0, 0.0, 0.0], vec![1.0, 1.0, 2.0, 1.0, 1.0]));
}

/// Every way to wrap an environment whose action is discrete or not.
fn stacks() -> Vec<fn(Boxed) -> Result<Boxed, String>> {
    fn boxed(env: impl Env + 'static) -> Boxed {
        Box::new(env)
    }
    vec![
        Ok,
        |env| Ok(boxed(PreviousAction::new(env))),
        |env| Ok(boxed(Antialias::new(env))),
        |env| Ok(boxed(Antialias::new(PreviousAction::new(env)))),
        |env| Ok(boxed(PreviousAction::new(Antialias::new(env)))),
        |env| Ok(boxed(Flatten::new(env)?)),
        |env| Ok(boxed(Flatten::new(Antialias::new(PreviousAction::new(env)))?)),
        |env| Ok(boxed(Antialias::new(PreviousAction::new(Flatten::new(env)?)))),
        |env| Ok(boxed(DiscreteAction::new(Flatten::new(env)?)?)),
        |env| Ok(boxed(Flatten::new(Antialias::new(PreviousAction::new(DiscreteAction::new(env)?)))?)),
    ]
}

/// Plays the beginning of an episode; every observation and state must be a point of its space.
fn check_points(env: &mut dyn Env, index: u64) {
    const STEPS: usize = 40;
    let spec = env.spec().clone();
    assert_eq!(spec.validate(), Ok(()));
    let [mut observation, mut state, mut action] =
        [&spec.observation, &spec.state, &spec.action].map(|space| Slab::new(space, 1));
    let mut policy = stream(2, 0, index, Purpose::EvalAction);
    let mut rng = stream(2, 0, index, Purpose::EvalEnv);
    env.draw_world(&mut rng);
    env.begin(&mut rng, observation.row_mut(0));
    for _ in 0..STEPS {
        env.state(state.row_mut(0));
        spec.state.check(state.row(0)).unwrap();
        spec.observation.check(observation.row(0)).unwrap_or_else(|error| panic!("{}: {error}", spec.id));
        spec.action.sample_into(&mut policy, action.row_mut(0));
        if env.step(action.row(0), &mut rng, observation.row_mut(0)).done() {
            break;
        }
    }
    spec.observation.check(observation.row(0)).unwrap();
}

/// All ways to wrap, around and within all levels of observability.
#[test]
fn every_observation_is_a_point_of_its_space() {
    for entry in &Registry::standard() {
        for (index, stack) in stacks().into_iter().enumerate() {
            let Ok(mut env) = stack(entry.make()) else {
                assert!(index >= 8 && matches!(entry.spec.action, Space::Box { .. }), "{}", entry.id());
                continue;
            };
            check_points(env.as_mut(), index as u64);
            for level in Observability::ALL {
                let mut outside = Observed::new(stack(entry.make()).unwrap(), level).unwrap();
                check_points(&mut outside, index as u64);
                let mut inside = stack(Box::new(Observed::new(entry.make(), level).unwrap())).unwrap();
                check_points(inside.as_mut(), index as u64);
            }
        }
    }
}

/// Where previous action and flag are beside a hidden state depends on what is wrapped first.
#[test]
fn the_python_packages_layout_is_had_by_wrapping_first() {
    let bare = || make("BattleshipEasy");
    let spec = bare().spec().clone();
    let (flag, level) = (Space::Discrete(2), Observability::FullAndPartial);
    let episode = play_randomly(bare().as_mut(), 0, 9);
    let play_again = |env: &mut dyn Env| play_drawn(env, 0, 9, |t, _, action| action.set(0, episode.actions.row(t)));

    let mut packages = Observed::new(Antialias::new(PreviousAction::new(bare())), level).unwrap();
    let partial = Space::Tuple(vec![spec.observation.clone(), spec.action.clone(), flag.clone()]);
    assert_eq!(packages.spec().observation, Space::Tuple(vec![partial, spec.state.clone()]));
    let seen = play_again(&mut packages);
    let (state, action) = (episode.states.row(5).discrete, episode.actions.row(4).discrete);
    let observation = episode.observations.row(5).discrete;
    assert_eq!(seen.observations.row(5).discrete, [observation, action, &[0], state].concat());

    let mut other = Antialias::new(PreviousAction::new(Observed::new(bare(), level).unwrap()));
    assert_eq!(other.spec().observation, Space::Tuple(vec![spec.observation, spec.state, spec.action, flag]));
    let seen = play_again(&mut other);
    assert_eq!(seen.observations.row(5).discrete, [observation, state, action, &[0]].concat());
}

/// `a` stands for `(a / n1, a % n1)`: every one of them, on the same board.
#[test]
fn discrete_actions_count_row_by_row() {
    for (level, n) in battleship::LEVELS.into_iter().zip([8_u8, 10, 12]) {
        let bare = || Battleship::new("game", level);
        let mut one = DiscreteAction::new(bare()).unwrap();
        let cells = u16::from(n) * u16::from(n);
        assert_eq!(one.spec().action, Space::Discrete(cells));
        for cell in 0..cells as u8 {
            // Starts at `cell`, and goes on until all ships are sunk.
            let shot = |t: usize| ((usize::from(cell) + t) % usize::from(cells)) as u8;
            let counted = play_drawn(&mut one, 5, 0, |t, _, action| action.discrete[0] = shot(t));
            let pairs =
                play_drawn(&mut bare(), 5, 0, |t, _, action| action.set(0, discrete(&[shot(t) / n, shot(t) % n])));
            assert_eq!((counted.observations, counted.states), (pairs.observations, pairs.states));
            assert_eq!(counted.steps, pairs.steps);
        }
    }
    // One component is left alone.
    let mut cart = DiscreteAction::new(make("PositionOnlyCartPoleEasy")).unwrap();
    assert_eq!(cart.spec().action, Space::Discrete(2));
    assert_eq!(play_randomly(&mut cart, 0, 0), play_randomly(make("PositionOnlyCartPoleEasy").as_mut(), 0, 0));
}

/// Echoes what it is told: the observation is the action.
struct Echo(EnvSpec);

impl Echo {
    fn new(action: Space) -> Self {
        Self(EnvSpec {
            id: "echo".to_owned(),
            observation: action.clone(),
            action,
            state: Space::Discrete(1),
            max_steps: 3,
            return_range: (0.0, 0.0),
        })
    }
}

impl Env for Echo {
    fn spec(&self) -> &EnvSpec {
        &self.0
    }
    fn draw_world(&mut self, _rng: &mut EpisodeRng) {}
    fn set_world(&mut self, _world: &serde_json::Value) -> Result<(), String> {
        Ok(())
    }
    fn world(&self) -> serde_json::Value {
        serde_json::Value::Null
    }
    fn begin(&mut self, _draws: &mut dyn Draws, _observation: ValueMut<'_>) {}
    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, mut observation: ValueMut<'_>) -> Step {
        observation.copy_from(action);
        Step { reward: 0.0, terminated: true, truncated: false }
    }
    fn state(&self, _state: ValueMut<'_>) {}
}

#[test]
fn nested_actions_become_one_vector() {
    let nested = Space::Tuple(vec![
        Space::Discrete(3),
        Space::Tuple(vec![Space::MultiDiscrete(vec![2, 5]), Space::Discrete(4)]),
    ]);
    let mut env = Flatten::new(Echo::new(nested.clone())).unwrap();
    assert_eq!(env.spec().action, Space::MultiDiscrete(vec![3, 2, 5, 4]));
    let echo = play(&mut env, &mut Recorded::default(), |_, _, action| action.set(0, discrete(&[2, 0, 4, 1])));
    let expected = [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0];
    assert_eq!(echo.observations.row(1).real, expected);
    assert_eq!(DiscreteAction::new(env).unwrap().spec().action, Space::Discrete(120));

    let reals = Space::Tuple(vec![Space::uniform_box(2, -1.0, 1.0), Space::uniform_box(1, 0.0, f32::INFINITY)]);
    let flattened = Flatten::new(Echo::new(reals.clone())).unwrap().spec().clone();
    let expected = Space::Box { low: vec![-1.0, -1.0, 0.0], high: vec![1.0, 1.0, f32::INFINITY] };
    assert_eq!((flattened.action, flattened.observation), (expected.clone(), expected));

    // What is no tuple is left alone.
    for space in [Space::Discrete(3), Space::MultiDiscrete(vec![2, 2]), Space::uniform_box(2, 0.0, 1.0)] {
        let spec = Flatten::new(Echo::new(space.clone())).unwrap().spec().clone();
        assert_eq!((&spec.action, &spec.observation), (&space, &space));
    }
    let mixed = Flatten::new(Echo::new(Space::Tuple(vec![nested, reals]))).err().unwrap();
    assert_eq!(mixed, "echo: an action of 4 discrete and 3 real components cannot be one vector");
}

#[test]
fn actions_that_cannot_be_counted_are_errors() {
    let large = DiscreteAction::new(Echo::new(Space::MultiDiscrete(vec![16, 17]))).err().unwrap();
    assert_eq!(large, "echo: more than 256 combinations of the actions' [16, 17] classes");
    let huge = DiscreteAction::new(Echo::new(Space::MultiDiscrete(vec![256; 40]))).err().unwrap();
    assert!(huge.contains("more than 256 combinations"), "{huge}");
    let largest = DiscreteAction::new(Echo::new(Space::MultiDiscrete(vec![16, 16]))).unwrap();
    assert_eq!(largest.spec().action, Space::Discrete(256));
    for space in [Space::uniform_box(1, -2.0, 2.0), Space::Tuple(vec![Space::Discrete(2), Space::Discrete(2)])] {
        let error = DiscreteAction::new(Echo::new(space)).err().unwrap();
        assert!(error.contains("expected discrete components"), "{error}");
    }
}

#[test]
fn null_actions_are_points_of_the_action_space() {
    let first = |env: &mut dyn Env, space: &Space| {
        let mut observation = Slab::new(&env.spec().observation, 1);
        env.begin(&mut Recorded::default(), observation.row_mut(0));
        let widths = space.widths();
        (observation.discrete[widths.0..].to_vec(), observation.real[widths.1..].to_vec())
    };
    let infinity = f32::INFINITY;
    // A box is zeros or all lower bounds; each box of a tuple by itself.
    for (space, classes, reals) in [
        (Space::MultiDiscrete(vec![3, 4]), vec![0, 0], vec![]),
        (Space::uniform_box(2, -1.0, 1.0), vec![], vec![0.0, 0.0]),
        (Space::Box { low: vec![-1.0, 0.5], high: vec![1.0, 2.0] }, vec![], vec![-1.0, 0.5]),
        (Space::Box { low: vec![-infinity, -infinity], high: vec![-1.0, infinity] }, vec![], vec![-1.0, 0.0]),
        (
            Space::Tuple(vec![Space::uniform_box(1, 3.0, 4.0), Space::Discrete(2), Space::uniform_box(1, -4.0, 4.0)]),
            vec![0],
            vec![3.0, 0.0],
        ),
    ] {
        let mut env = PreviousAction::new(Echo::new(space.clone()));
        assert_eq!(first(&mut env, &space), (classes.clone(), reals.clone()), "{space:?}");
        assert_eq!(space.check(Value { discrete: &classes, real: &reals }), Ok(()));
    }
    let space = Space::MultiDiscrete(vec![3, 4]);
    let mut env = PreviousAction::with_null(Echo::new(space.clone()), discrete(&[2, 3])).unwrap();
    assert_eq!(first(&mut env, &space).0, [2, 3]);
    let error = PreviousAction::with_null(Echo::new(space), discrete(&[2, 4])).err();
    assert_eq!(error, Some(SpaceError::Class { index: 1, value: 4, classes: 4 }));
}

/// At each level of observability many environments show what the observations and states of plain ones make up.
#[test]
fn many_environments_at_every_level() {
    const ROWS: usize = 9;
    let registry = Registry::standard();
    for entry in &registry {
        let mut plain = VecEnv::new(&registry, entry.id(), ROWS).unwrap();
        let mut observed = Observability::ALL.map(|level| {
            let envs = VecEnv::observing(&registry, entry.id(), level, ROWS).unwrap();
            assert_eq!((envs.observability(), &envs.spec().state), (level, &entry.spec.state));
            assert_eq!(envs.spec(), &entry.observed(level).unwrap());
            let observations = envs.observations();
            (envs, observations)
        });
        let (mut actions, mut expected, mut states) = (plain.actions(), plain.observations(), plain.states());
        let mut steps = vec![Step::default(); ROWS];
        let mut other_steps = steps.clone();
        let mut policy = stream(0, 0, 0, Purpose::EvalAction);
        for row in 0..ROWS {
            let rng = || stream(7, 0, row as u64, Purpose::EvalEnv);
            plain.begin(row, rng(), &mut expected);
            for (envs, observations) in &mut observed {
                envs.begin(row, rng(), observations);
            }
        }
        for t in 0..30 {
            for row in 0..ROWS {
                plain.state(row, &mut states);
                let (partial, state) = (expected.row(row), states.row(row));
                let both = ([partial.discrete, state.discrete].concat(), [partial.real, state.real].concat());
                let both = Value { discrete: &both.0, real: &both.1 };
                for ((envs, observations), shown) in observed.iter().zip([partial, partial, state, both]) {
                    assert_eq!(observations.row(row), shown, "{} row {row} at {t}", entry.id());
                    envs.spec().observation.check(observations.row(row)).unwrap();
                    let info = (envs.observability() == Observability::FullInInfo).then_some(state);
                    assert_eq!(envs.info(row), info);
                }
            }
            if steps.iter().any(Step::done) {
                break;
            }
            entry.spec.action.sample_rows(&mut policy, &mut actions);
            // All at once, and one by one.
            let ended = plain.step_all(&actions, &mut expected, &mut steps).unwrap();
            for (envs, observations) in &mut observed {
                if t % 2 == 0 {
                    assert_eq!(envs.step_all(&actions, observations, &mut other_steps), Ok(ended));
                } else {
                    for (row, step) in other_steps.iter_mut().enumerate() {
                        *step = envs.step(row, actions.row(row), observations).unwrap();
                    }
                }
                assert_eq!(other_steps, steps);
            }
        }
    }
}

#[test]
fn a_wrapped_environment_can_be_registered_and_observed() {
    let mut registry = Registry::new();
    let wrapped = || Antialias::new(PreviousAction::new(Battleship::new("my-ships", battleship::LEVELS[0])));
    registry.register("Ships", &[], "mine", wrapped).unwrap();
    let envs = VecEnv::observing(&registry, "Ships", Observability::FullAndPartial, 2).unwrap();
    let direct = Observed::new(wrapped(), Observability::FullAndPartial).unwrap();
    assert_eq!(envs.spec(), direct.spec());
}

/// What is not spec or step is the environment's own.
#[test]
fn everything_else_is_forwarded() {
    for entry in &Registry::standard() {
        let mut bare = entry.make();
        bare.draw_world(&mut stream(1, 1, 1, Purpose::EvalEnv));
        let mut wrapped = paper(entry.make());
        wrapped.set_world(&bare.world()).unwrap();
        assert_eq!(wrapped.world(), bare.world());
        assert_eq!(wrapped.action_names(), bare.action_names());
        wrapped.set_world(&serde_json::json!({ "no": "world" })).unwrap_err();
        let pictures = [&mut bare as &mut dyn Env, &mut wrapped].map(|env| {
            let mut observation = Slab::new(&env.spec().observation, 1);
            env.begin(&mut stream(1, 1, 2, Purpose::EvalEnv), observation.row_mut(0));
            [popgym_envs::View::Observed, popgym_envs::View::Revealed].map(|view| {
                let mut canvas = popgym_envs::Canvas::new();
                env.render(view, &mut canvas);
                canvas
            })
        });
        assert_eq!(pictures[0], pictures[1]);
    }
}
