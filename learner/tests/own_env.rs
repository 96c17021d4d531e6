//! `play` with a user's own environment that has no picture and an action space of no common kind, and that panics when it
//! is told to.
//!
//! The test program itself is what plays: it starts itself on a terminal, as the one test that does so.

use std::ffi::OsString;
use std::process::Command;

use popgym_envs::{Draws, Env, EnvSpec, EpisodeRng, Space, Step, Value, ValueMut};
use popgym_learner::Extensions;
use popgym_tests::Terminal;

/// Set where the program is to play.
const PLAYS: &str = "POPGYM_TEST_PLAYS";

/// Adds up what it is told; panics at a 9.
struct Adder {
    spec: EnvSpec,
    sum: f32,
    steps: u32,
}

impl Adder {
    fn new() -> Self {
        let spec = EnvSpec {
            id: "Adder".to_owned(),
            observation: Space::Tuple(vec![Space::uniform_box(1, -100.0, 100.0), Space::Discrete(4)]),
            action: Space::Tuple(vec![Space::Discrete(10), Space::uniform_box(1, -1.0, 1.0)]),
            state: Space::Tuple(Vec::new()),
            max_steps: 3,
            return_range: (-100.0, 100.0),
        };
        Self { spec, sum: 0.0, steps: 0 }
    }

    fn observe(&self, observation: &mut ValueMut<'_>) {
        observation.discrete[0] = self.steps as u8;
        observation.real[0] = self.sum;
    }
}

impl Env for Adder {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn draw_world(&mut self, _rng: &mut EpisodeRng) {}

    fn set_world(&mut self, _world: &serde_json::Value) -> Result<(), String> {
        Ok(())
    }

    fn world(&self) -> serde_json::Value {
        serde_json::Value::Null
    }

    fn begin(&mut self, _draws: &mut dyn Draws, mut observation: ValueMut<'_>) {
        (self.sum, self.steps) = (0.0, 0);
        self.observe(&mut observation);
    }

    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, mut observation: ValueMut<'_>) -> Step {
        assert_ne!(action.discrete[0], 9, "nine is too much");
        self.steps += 1;
        self.sum += f32::from(action.discrete[0]) + action.real[0];
        self.observe(&mut observation);
        Step { reward: f64::from(self.sum), terminated: false, truncated: self.steps == 3 }
    }

    fn state(&self, _state: ValueMut<'_>) {}
}

/// Does nothing, unless the program is to play.
#[test]
fn plays() {
    if std::env::var_os(PLAYS).is_none() {
        return;
    }
    let mut extensions = Extensions::default();
    extensions.envs.register("Adder", &[], "custom", Adder::new).unwrap();
    let arguments = ["learner", "play", "--env", "Adder", "--seed", "1"].map(OsString::from);
    let _ = popgym_learner::run(extensions, arguments);
}

fn start() -> Terminal {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["plays", "--exact", "--nocapture", "--test-threads", "1"]).env(PLAYS, "yes");
    let mut terminal = Terminal::start("play Adder", command, (100, 40));
    terminal.has("step", "0 of 3");
    terminal
}

#[test]
fn numbers_in_and_numbers_out() {
    let mut terminal = start();
    assert_eq!(terminal.value("observation"), "0.0000 | 0");
    terminal.press("3 0.5\r");
    terminal.has("observation", "3.5000 | 1");
    terminal.press("3 2\r");
    terminal.shows("`2` is no action: -1.0000 to 1.0000");
    terminal.press("1, -0.25\r");
    terminal.has("observation", "4.2500 | 2");
    terminal.has("last action", "1 | -0.2500");
    terminal.press("q");
    terminal.expect(0, "score so far 7.7500, step 2 of 3");
    terminal.assert_restored();
}

#[test]
fn a_panic_is_told_on_the_users_own_screen() {
    let mut terminal = start();
    terminal.press("9 0\r");
    let text = terminal.expect(101, "nine is too much");
    assert!(text.contains("panicked at"), "{text}");
    terminal.assert_restored();
}
