//! The same seed gives the same `metrics.csv`, byte for byte, whoever samples the episodes.

use popgym_tests::Scene;

/// The curves of 1, 2 and 3 local actors, which must be one.
fn one_curve(lag: &str) -> String {
    let scene = Scene::new();
    let curves = ["1", "2", "3"].map(|actors| scene.curve(actors, &["--lag", lag, "--actors", actors]));
    assert_eq!(curves[0], curves[1], "one actor, and two");
    assert_eq!(curves[0], curves[2], "one actor, and three");
    assert!(scene.rows("1") >= 8, "{}", curves[0]);
    curves[0].clone()
}

/// The curve of a run with these flags.
fn curve(flags: &[&str]) -> String {
    Scene::new().curve("run", flags)
}

/// Whoever samples, and however many episodes at a time: one curve.
fn assert_one_curve(flags: &[&str]) {
    let few = curve(&[flags, &["--actors", "1", "--slots", "3"]].concat());
    let many = curve(&[flags, &["--actors", "3", "--slots", "40"]].concat());
    assert!(few.lines().count() > 2, "{flags:?}: {few}");
    assert_eq!(few, many, "{flags:?}");
}

#[test]
fn the_number_of_actors_does_not_matter_without_lag() {
    let curve_of_seed_0 = one_curve("0");
    assert_eq!(curve_of_seed_0, curve(&["--seed", "0", "--slots", "3"]));
    assert_ne!(curve_of_seed_0, curve(&["--seed", "1"]));
}

#[test]
fn the_number_of_actors_does_not_matter_with_lag() {
    let pipelined = one_curve("1");
    assert_eq!(pipelined, curve(&["--lag", "1", "--slots", "3"]));
    let direct = curve(&["--lag", "0"]);
    // Epochs 0 and 1 are sampled with the first weights under lag 1; so only the first is common to both.
    assert_ne!(pipelined, direct);
    assert_eq!(pipelined.lines().nth(1), direct.lines().nth(1));
}

#[test]
fn a_memory_without_a_state_is_no_exception() {
    let scene = Scene::new();
    let curve = |run: &str, flags: &[&str]| scene.curve(run, &[&["--memory", "mlp"], flags].concat());
    assert_eq!(curve("a", &[]), curve("b", &["--actors", "2"]));
    assert_ne!(scene.metrics("a"), curve("c", &["--lag", "1"]));
}

#[test]
fn every_kind_of_space_and_episodes_of_every_length() {
    // Episodes that end early make the batch's prefix depend on every one before it.
    assert_one_curve(&["--env", "PositionOnlyCartPoleEasy", "--learning-rate", "0.01"]);
    assert_one_curve(&["--env", "PositionOnlyPendulumEasy", "--lag", "1", "--steps", "2048"]);
    assert_one_curve(&["--env", "BattleshipEasy", "--steps", "2048"]);
}

#[test]
fn a_memory_of_the_usual_size_on_two_threads() {
    let flags = ["--preset", "quick", "--threads", "2", "--seed", "3", "--batch-steps", "1024"];
    let curves = [("1", "5"), ("2", "128")].map(|(actors, slots)| {
        let scene = Scene::new();
        scene.write("tiny.toml", &scene.read("tiny.toml").replace("hidden_size = 16", "hidden_size = 256"));
        scene.curve("run", &[&flags[..], &["--actors", actors, "--slots", slots]].concat())
    });
    assert_eq!(curves[0], curves[1]);
}
