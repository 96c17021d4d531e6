//! Names: what they mean, and what happens to those that mean nothing.

use std::collections::HashSet;

use popgym_envs::repeat_previous::{Params, RepeatPrevious};
use popgym_envs::{Difficulty, Draws, Env, EnvSpec, EpisodeRng, RegisterError, Registry, Space, Step, Value, ValueMut};

#[test]
fn every_spelling_means_the_same() {
    let registry = Registry::standard();
    for (given, id) in [
        ("popgym-RepeatPreviousEasy-v0", "popgym-RepeatPreviousEasy-v0"),
        ("RepeatPreviousEasy", "popgym-RepeatPreviousEasy-v0"),
        ("RepeatFirstHard", "popgym-RepeatFirstHard-v0"),
        ("StatelessCartPoleEasy", "popgym-PositionOnlyCartPoleEasy-v0"),
        ("popgym-StatelessCartPoleEasy-v0", "popgym-PositionOnlyCartPoleEasy-v0"),
        ("StatelessPendulumHard", "popgym-PositionOnlyPendulumHard-v0"),
        ("BattleshipMedium", "popgym-BattleshipMedium-v0"),
    ] {
        assert_eq!(registry.canonical(given), Ok(id));
        assert_eq!(registry.make(given).unwrap().spec().id, id);
    }
}

#[test]
fn entries_come_in_order_and_agree_with_their_environments() {
    let registry = Registry::standard();
    let entries: Vec<_> = registry.iter().collect();
    assert_eq!(entries.len() % 3, 0);
    for game in entries.chunks(3) {
        assert_eq!([0, 1, 2].map(|i| game[i].difficulty), Difficulty::ALL.map(Some));
        assert!(game.iter().all(|entry| entry.group == game[0].group));
    }
    for entry in &entries {
        assert_eq!(entry.make().spec(), &entry.spec);
        assert_eq!(entry.spec.validate(), Ok(()));
    }
    let ids: HashSet<&str> = entries.iter().map(|entry| entry.id()).collect();
    assert_eq!(ids.len(), entries.len());
}

#[test]
fn an_unknown_name_is_answered_with_the_nearest() {
    let registry = Registry::standard();
    for (given, nearest) in [
        ("RepeatPrevious", "RepeatPreviousEasy"),
        ("repeatprevioushard", "RepeatPreviousHard"),
        ("popgym-BatleshipMedium-v0", "BattleshipMedium"),
        ("StatelesCartPoleHard", "StatelessCartPoleHard"),
    ] {
        let error = registry.make(given).err().unwrap();
        assert_eq!(error.nearest.as_deref(), Some(nearest));
        let line = error.to_string();
        assert_eq!(
            line,
            format!("unknown environment `{given}`; did you mean `{nearest}`? `learner list envs` lists them all")
        );
    }
    assert!(!registry.canonical("two\nlines").unwrap_err().to_string().contains('\n'));
    assert_eq!(Registry::new().canonical("x").unwrap_err().nearest, None);
}

/// One missing letter is always understood.
#[test]
fn a_misspelt_name_is_answered_with_the_right_one() {
    let registry = Registry::standard();
    for entry in &registry {
        for at in 0..entry.name.len() {
            let mut given = entry.name.clone();
            given.remove(at);
            assert_eq!(registry.canonical(&given).unwrap_err().nearest.as_ref(), Some(&entry.name), "{given}");
        }
    }
}

/// A user's environment: one step, with whatever spec.
struct Custom(EnvSpec);

impl Env for Custom {
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
    fn step(&mut self, _action: Value<'_>, _draws: &mut dyn Draws, _observation: ValueMut<'_>) -> Step {
        Step { reward: 0.5, terminated: true, truncated: false }
    }
    fn state(&self, _state: ValueMut<'_>) {}
}

fn custom(id: &str) -> EnvSpec {
    EnvSpec {
        id: id.to_owned(),
        observation: Space::Discrete(3),
        action: Space::Discrete(2),
        state: Space::Tuple(vec![]),
        max_steps: 1,
        return_range: (0.0, 1.0),
    }
}

fn register(registry: &mut Registry, name: &str, aliases: &[&str], spec: EnvSpec) -> Result<(), RegisterError> {
    registry.register(name, aliases, "mine", move || Box::new(Custom(spec.clone())))
}

#[test]
fn a_user_can_add_environments() {
    let mut registry = Registry::standard();
    let standard = registry.iter().count();
    register(&mut registry, "MyGameHard", &["Mine"], custom("my-game")).unwrap();
    registry
        .register("RepeatPreviousLong", &[], "diagnostic", || {
            Box::new(RepeatPrevious::new("RepeatPreviousLong-v1", Params { decks: 4, k: 100 }))
        })
        .unwrap();
    // A copy keeps them, on another thread too.
    let registry = std::thread::spawn({
        let registry = registry.clone();
        move || registry
    })
    .join()
    .unwrap();
    for name in ["my-game", "MyGameHard", "Mine"] {
        assert_eq!(registry.canonical(name), Ok("my-game"));
    }
    let added: Vec<_> = registry.iter().skip(standard).collect();
    assert_eq!((added[0].group.as_str(), added[0].difficulty), ("mine", Some(Difficulty::Hard)));
    assert_eq!((added[1].id(), added[1].difficulty), ("RepeatPreviousLong-v1", None));
    assert_eq!(registry.make("RepeatPreviousLong").unwrap().spec().max_steps, 207);
}

#[test]
fn duplicates_and_bad_specs_are_errors_and_leave_the_registry_alone() {
    let mut registry = Registry::standard();
    let count = registry.iter().count();
    let duplicates = [
        ("RepeatFirstEasy", &[][..], "new", "RepeatFirstEasy"),
        ("New", &["StatelessCartPoleEasy"][..], "new", "StatelessCartPoleEasy"),
        ("New", &[][..], "popgym-BattleshipHard-v0", "popgym-BattleshipHard-v0"),
        ("popgym-BattleshipHard-v0", &[][..], "new", "popgym-BattleshipHard-v0"),
    ];
    for (name, aliases, id, taken) in duplicates {
        let error = register(&mut registry, name, aliases, custom(id)).unwrap_err();
        assert!(matches!(&error, RegisterError::Duplicate { name, .. } if name == taken), "{error}");
    }
    for name in ["", "popgym-", "my game"] {
        assert_eq!(register(&mut registry, name, &[], custom("new")), Err(RegisterError::Name(name.to_owned())));
    }
    let spec = || custom("new");
    let invalid = [
        (EnvSpec { id: String::new(), ..spec() }, "the id"),
        (EnvSpec { observation: Space::Discrete(0), ..spec() }, "the observation space is not valid"),
        (EnvSpec { action: Space::Tuple(vec![]), ..spec() }, "the action space has no component"),
        (EnvSpec { state: Space::Discrete(300), ..spec() }, "the state space is not valid"),
        (EnvSpec { max_steps: 0, ..spec() }, "max_steps"),
        (EnvSpec { return_range: (1.0, 0.0), ..spec() }, "return_range"),
        (EnvSpec { return_range: (0.0, f64::INFINITY), ..spec() }, "return_range"),
    ];
    for (spec, reason) in invalid {
        let error = register(&mut registry, "New", &[], spec).unwrap_err().to_string();
        assert!(error.contains(reason) && error.contains("`New`"), "{error}");
    }
    assert_eq!(registry.iter().count(), count);
    register(&mut registry, "New", &[], spec()).unwrap();
}
