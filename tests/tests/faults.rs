//! Actors and learners that die, and networks that fail, in the middle of a run: `metrics.csv` is that of the undisturbed
//! run, byte for byte.

use std::sync::OnceLock;

use popgym_tests::net::Network;
use popgym_tests::process::Life;
use popgym_tests::{Process, Scene};
use rustix::process::Signal;

/// Long enough that its middle cannot be missed.
const STEPS: [&str; 2] = ["--steps", "16384"];

const LAGS: [&str; 2] = ["0", "1"];

/// Rows of `metrics.csv` after which something happens.
const MIDDLE: usize = 5;

/// The curve of an undisturbed run.
fn undisturbed(lag: &str) -> &'static str {
    static CURVES: [OnceLock<String>; 2] = [OnceLock::new(), OnceLock::new()];
    let index = LAGS.iter().position(|known| *known == lag).expect("lag 0 or 1");
    CURVES[index].get_or_init(|| {
        let scene = Scene::new();
        let curve = scene.curve("undisturbed", &["--lag", lag, STEPS[0], STEPS[1]]);
        assert!(scene.rows("undisturbed") > 4 * MIDDLE, "{curve}");
        curve
    })
}

/// Starts a run and waits until it is in its middle.
fn middle_of(scene: &Scene, flags: &[&str]) -> Process {
    let mut learner = scene.train("run", &[flags, &STEPS].concat());
    scene.reached(&mut learner, "run", MIDDLE);
    learner
}

fn remote(lag: &str) -> [&str; 6] {
    ["--lag", lag, "--actors", "0", "--listen", "127.0.0.1:0"]
}

fn a_killed_local_actor_is_replaced(lag: &str, actors: &str) {
    let scene = Scene::new();
    let mut learner = middle_of(&scene, &["--lag", lag, "--actors", actors]);
    for actor in learner.actors() {
        actor.signal(Signal::KILL);
    }
    let log = learner.expect(0).stderr;
    assert!(log.contains("a local actor has died (signal: 9 (SIGKILL)"), "{log}");
    let lost: Vec<&str> = log.lines().filter(|line| line.contains("actor lost")).collect();
    assert!(!lost.is_empty() && lost.len() <= actors.parse().unwrap(), "one line for each: {lost:?}");
    assert_eq!(scene.accounted("run"), undisturbed(lag));
}

#[test]
fn a_killed_local_actor_is_replaced_without_lag() {
    a_killed_local_actor_is_replaced("0", "2");
}

#[test]
fn a_killed_local_actor_is_replaced_with_lag() {
    a_killed_local_actor_is_replaced("1", "1");
}

fn a_killed_remote_actor_is_replaced(lag: &str) {
    let scene = Scene::new();
    let mut learner = scene.train("run", &[&remote(lag)[..], &STEPS].concat());
    let url = learner.url();
    let mut first = scene.actor(&url, &["--name", "first"]);
    scene.reached(&mut learner, "run", MIDDLE);
    first.kill();
    learner.logged("actor lost");
    let second = scene.actor(&url, &["--name", "second"]);
    second.expect(0);
    let log = learner.expect(0).stderr;
    for (line, times) in [("actor joined actor=\"first\"", 1), ("actor joined actor=\"second\"", 1), ("actor lost", 1)]
    {
        assert_eq!(log.matches(line).count(), times, "{line}\n{log}");
    }
    assert_eq!(scene.accounted("run"), undisturbed(lag));
}

#[test]
fn a_killed_remote_actor_is_replaced_without_lag() {
    a_killed_remote_actor_is_replaced("0");
}

#[test]
fn a_killed_remote_actor_is_replaced_with_lag() {
    a_killed_remote_actor_is_replaced("1");
}

#[test]
fn an_actor_returns_when_the_network_does() {
    let scene = Scene::new();
    let mut learner = scene.train("run", &[&remote("0")[..], &STEPS].concat());
    let network = Network::to(learner.url().trim_start_matches("http://"));
    let actor = scene.actor(&network.url(), &["--name", "wanderer"]);
    scene.reached(&mut learner, "run", MIDDLE);
    network.cut();
    learner.logged("actor lost");
    actor.expect(0);
    let log = learner.expect(0).stderr;
    for line in ["actor joined actor=\"wanderer\"", "actor lost", "actor returned actor=\"wanderer\""] {
        assert_eq!(log.matches(line).count(), 1, "{line}\n{log}");
    }
    assert_eq!(scene.accounted("run"), undisturbed("0"));
}

#[test]
fn a_remote_actor_waits_for_a_learner_that_was_killed() {
    let scene = Scene::new();
    let mut learner = scene.train("run", &[&remote("0")[..], &STEPS].concat());
    let url = learner.url();
    let actor = scene.actor(&url, &[]);
    scene.reached(&mut learner, "run", MIDDLE);
    learner.kill();
    let resumed = scene.resume("run", &["--listen", url.trim_start_matches("http://")]);
    actor.expect(0);
    resumed.expect(0);
    assert_eq!(scene.accounted("run"), undisturbed("0"));
}

/// Kills the learner of a run with these flags in its middle; its actors go too.
fn a_run_whose_learner_was_killed(flags: &[&str]) -> Scene {
    let scene = Scene::new();
    let mut learner = middle_of(&scene, flags);
    let actors = learner.actors();
    assert!(!actors.is_empty(), "a local actor");
    learner.kill();
    Life::expect_gone(&actors);
    scene
}

fn a_killed_learner_is_resumed(lag: &str) {
    let scene = a_run_whose_learner_was_killed(&["--lag", lag, "--actors", "2"]);
    assert!(scene.checkpoints("run").iter().any(|name| name.starts_with("epoch-")));
    // As if it had been in the middle of a row, and of a checkpoint.
    let torn = scene.metrics("run") + "7,4488,88,-0.4";
    scene.write("run/metrics.csv", &torn);
    std::fs::create_dir_all(scene.path("run/checkpoints/epoch-000029.tmp")).unwrap();
    scene.write("run/checkpoints/epoch-000029.tmp/manifest.json", "{\"format\": 1,");
    let outcome = scene.resume("run", &["--actors", "1"]).expect(0);
    assert!(!outcome.stderr.contains("checkpoint not used"), "{}", outcome.stderr);
    assert_eq!(scene.accounted("run"), undisturbed(lag));
}

#[test]
fn a_killed_learner_is_resumed_without_lag() {
    a_killed_learner_is_resumed("0");
}

#[test]
fn a_killed_learner_is_resumed_with_lag() {
    a_killed_learner_is_resumed("1");
}

fn a_learner_killed_before_its_first_checkpoint_begins_anew(lag: &str) {
    let scene = a_run_whose_learner_was_killed(&["--lag", lag, "--checkpoint-epochs", "1000"]);
    assert!(scene.checkpoints("run").is_empty());
    scene.resume("run", &[]).expect(0);
    assert_eq!(scene.accounted("run"), undisturbed(lag));
}

#[test]
fn a_learner_killed_before_its_first_checkpoint_begins_anew_without_lag() {
    a_learner_killed_before_its_first_checkpoint_begins_anew("0");
}

#[test]
fn a_learner_killed_before_its_first_checkpoint_begins_anew_with_lag() {
    a_learner_killed_before_its_first_checkpoint_begins_anew("1");
}

#[test]
fn everything_fails_again_and_again() {
    let scene = Scene::new();
    let mut learner = middle_of(&scene, &["--lag", "1", "--actors", "2"]);
    for round in 1..4 {
        for actor in learner.actors() {
            actor.signal(Signal::KILL);
        }
        scene.reached(&mut learner, "run", MIDDLE + 3 * round);
        learner.kill();
        learner = scene.resume("run", &[]);
        scene.reached(&mut learner, "run", MIDDLE + 3 * round - 2);
    }
    learner.expect(0);
    assert_eq!(scene.accounted("run"), undisturbed("1"));
}
