//! `eval`, `list`, and every kind of environment and memory for a moment.

use popgym_tests::Scene;
use serde_json::Value;

/// `learner eval --json` of the directory `run`.
fn eval(scene: &Scene, flags: &[&str]) -> Value {
    let outcome = scene.learner(&[&["eval", "run", "--json"], flags].concat()).expect(0);
    serde_json::from_str(&outcome.stdout).unwrap_or_else(|error| panic!("{error}: {}", outcome.stdout))
}

#[test]
fn eval_is_reproducible_and_never_training() {
    let scene = Scene::new();
    // A learning rate that changes no weight: the run's one epoch was played by what eval plays with.
    let flags = ["--steps", "512", "--learning-rate", "1e-30", "--seed", "4"];
    let curve = scene.curve("run", &flags);
    let row: Vec<f64> =
        curve.lines().nth(1).unwrap().split(',').map(|field| field.parse().unwrap_or(f64::NAN)).collect();
    let [episodes, trained] = [row[2], row[3]];
    let count = episodes.to_string();
    // The training's own seed and number of episodes, and yet other episodes.
    let report = eval(&scene, &["--episodes", &count, "--seed", "4"]);
    assert_eq!(report["episodes"].as_f64(), Some(episodes));
    assert_ne!(report["mean_return"].as_f64(), Some(trained));
    assert_eq!(report, eval(&scene, &["--episodes", &count, "--seed", "4", "--actors", "2"]), "same seed, same result");
    let other = eval(&scene, &["--episodes", &count, "--seed", "5"]);
    assert_ne!(report["mean_return"], other["mean_return"], "another seed, another result");
    for (key, value) in [("env", "popgym-RepeatPreviousEasy-v0"), ("memory", "gru")] {
        assert_eq!(report[key], value);
    }
    assert_eq!((&report["seed"], &report["checkpoint_epoch"]), (&4.into(), &1.into()));
    let number = |key: &str| report[key].as_f64().unwrap_or_else(|| panic!("{key}: {report}"));
    assert!(number("min_return") <= number("median_return") && number("median_return") <= number("max_return"));
    assert!(number("standard_error") > 0.0 && (number("mean_length") - 51.0).abs() < 1e-9);
    assert_eq!(scene.metrics("run"), curve, "eval changes nothing");
}

#[test]
fn eval_of_other_difficulties_and_of_likeliest_actions() {
    let scene = Scene::new();
    scene.curve("run", &["--steps", "512"]);
    let drawn = eval(&scene, &["--episodes", "12"]);
    let greedy = eval(&scene, &["--episodes", "12", "--greedy"]);
    assert_eq!((&drawn["greedy"], &greedy["greedy"]), (&false.into(), &true.into()));
    assert_ne!(drawn["mean_return"], greedy["mean_return"]);
    assert_eq!(greedy, eval(&scene, &["--episodes", "12", "--greedy", "--actors", "2"]));

    let harder = eval(&scene, &["--episodes", "12", "--env", "RepeatPreviousHard"]);
    assert_eq!(harder["env"], "popgym-RepeatPreviousHard-v0");
    assert_eq!(harder["trained_on"], "popgym-RepeatPreviousEasy-v0");
    assert!((harder["mean_length"].as_f64().unwrap() - 155.0).abs() < 1e-9, "{harder}");
    let text = scene.learner(&["eval", "run", "--env", "RepeatPreviousHard", "--greedy"]).expect(0).stdout;
    for part in ["RepeatPreviousHard", "trained on popgym-RepeatPreviousEasy-v0", "likeliest actions", "quantiles"] {
        assert!(text.contains(part), "{part}: {text}");
    }
    // Returns in equal parts of their range: each is in one.
    let counts = drawn["histogram"]["counts"].as_array().unwrap().iter().map(|count| count.as_u64().unwrap());
    assert_eq!(counts.sum::<u64>(), 12);
    let edges: Vec<f64> =
        drawn["histogram"]["edges"].as_array().unwrap().iter().map(|edge| edge.as_f64().unwrap()).collect();
    assert_eq!(
        (edges.first().copied(), edges.last().copied()),
        (drawn["min_return"].as_f64(), drawn["max_return"].as_f64())
    );
    assert_eq!(drawn["quantiles"]["50"], drawn["median_return"]);
}

#[test]
fn eval_takes_the_checkpoint_asked_for() {
    let scene = Scene::new();
    scene.curve("run", &["--checkpoint-epochs", "1", "--keep-checkpoints", "8"]);
    let score = |name: &String| {
        let progress = scene.json(&format!("run/checkpoints/{name}/manifest.json"))["progress"].clone();
        (progress["mean_return"].as_f64().unwrap(), progress["epoch"].as_u64().unwrap())
    };
    let best = scene.checkpoints("run").iter().map(score).max_by(|a, b| a.0.total_cmp(&b.0)).unwrap();
    assert_eq!(eval(&scene, &["--episodes", "3"])["checkpoint_epoch"], best.1);
    assert_eq!(eval(&scene, &["--episodes", "3", "--checkpoint", "last"])["checkpoint_epoch"], 8);
    let text = scene.learner(&["eval", "run", "--episodes", "3"]).expect(0).stdout;
    assert!(text.contains("mean return") && text.contains("popgym-RepeatPreviousEasy-v0"), "{text}");
    // One episode tells nothing of the spread; that is no number, and no failure.
    assert_eq!(eval(&scene, &["--episodes", "1"])["standard_error"], Value::Null);
}

#[test]
fn eval_needs_a_checkpoint() {
    let scene = Scene::new();
    let mut learner = scene.train("run", &["--actors", "0", "--listen", "127.0.0.1:0"]);
    learner.url();
    let stderr = scene.learner(&["eval", "run"]).expect(1).stderr;
    assert_eq!(stderr, "error: run holds no checkpoint yet\n");
}

/// One tiny epoch, evaluation included.
fn trains(env: &str, id: &str, flags: &[&str]) {
    let scene = Scene::new();
    let curve = scene.curve("run", &[&["--env", env, "--steps", "512", "--actors", "2"], flags].concat());
    assert_eq!(curve.lines().count(), 2, "{env} {flags:?}: {curve}");
    assert!(!curve.contains("NaN") && !curve.contains("inf"), "{env} {flags:?}: {curve}");
    assert_eq!(scene.json("run/summary.json")["env"], id);
    assert!(scene.log_prob_difference("run") < 1e-4, "{env} {flags:?}: actors and learner compute the same");
    let report = eval(&scene, &["--episodes", "2"]);
    assert!((-1.25..=1.0).contains(&report["mean_return"].as_f64().unwrap()), "{env} {flags:?}: {report}");
}

/// The package's names, and those that the paper uses.
#[test]
fn diagnostic_environments_train() {
    trains("RepeatFirstEasy", "popgym-RepeatFirstEasy-v0", &[]);
    trains("popgym-RepeatPreviousMedium-v0", "popgym-RepeatPreviousMedium-v0", &["--memory", "mlp"]);
    trains("AutoencodeEasy", "popgym-AutoencodeEasy-v0", &["--observability", "full"]);
    trains("CountRecallHard", "popgym-CountRecallHard-v0", &[]);
}

#[test]
fn control_and_noisy_environments_train() {
    trains("StatelessCartPoleEasy", "popgym-PositionOnlyCartPoleEasy-v0", &[]);
    trains("StatelessPendulumEasy", "popgym-PositionOnlyPendulumEasy-v0", &[]);
    trains("PositionOnlyPendulumHard", "popgym-PositionOnlyPendulumHard-v0", &["--memory", "mlp"]);
    trains("VelocityOnlyCartPoleEasy", "popgym-VelocityOnlyCartpoleEasy-v0", &["--observability", "full-and-partial"]);
    trains("NoisyStatelessCartPoleHard", "popgym-NoisyPositionOnlyCartPoleHard-v0", &[]);
    trains("NoisyStatelessPendulumMedium", "popgym-NoisyPositionOnlyPendulumMedium-v0", &["--observability", "full"]);
    trains("MultiarmedBanditHard", "popgym-MultiarmedBanditHard-v0", &["--observability", "full"]);
}

#[test]
fn games_and_navigation_train() {
    trains("BattleshipEasy", "popgym-BattleshipEasy-v0", &[]);
    trains("ConcentrationMedium", "popgym-ConcentrationMedium-v0", &["--observability", "full"]);
    trains("HigherLowerHard", "popgym-HigherLowerHard-v0", &["--observability", "full"]);
    trains("MineSweeperHard", "popgym-MineSweeperHard-v0", &["--observability", "full-and-partial"]);
    trains("LabyrinthEscapeHard", "popgym-LabyrinthEscapeHard-v0", &["--observability", "full"]);
    trains("LabyrinthExploreEasy", "popgym-LabyrinthExploreEasy-v0", &[]);
}

#[test]
fn every_difficulty_of_every_environment_is_listed() {
    let scene = Scene::new();
    let lines = scene.learner(&["list", "envs"]).expect(0).stdout;
    let json: Value = serde_json::from_str(&scene.learner(&["list", "envs", "--json"]).expect(0).stdout).unwrap();
    let ids: Vec<&str> = json.as_array().unwrap().iter().map(|env| env["id"].as_str().unwrap()).collect();
    assert_eq!(ids.len(), 48);
    for name in ["RepeatPrevious", "VelocityOnlyCartpole", "NoisyPositionOnlyPendulum", "LabyrinthExplore"] {
        for difficulty in ["Easy", "Medium", "Hard"] {
            let id = format!("popgym-{name}{difficulty}-v0");
            assert!(ids.contains(&id.as_str()), "{id}");
            assert!(lines.lines().any(|line| line.contains(&id)), "{lines}");
        }
    }
    assert_eq!(lines.lines().count(), 1 + ids.len(), "a header, and in a pipe a line each");
    for env in json.as_array().unwrap() {
        let number = |value: &Value| value.as_f64().unwrap_or_else(|| panic!("{env}"));
        let (low, high) = (number(&env["return_range"][0]), number(&env["return_range"][1]));
        let (mean, error) = (number(&env["random"]["mean"]), number(&env["random"]["standard_error"]));
        assert!(low <= mean && mean <= high && error > 0.0 && env["random"]["episodes"] == 200, "{env}");
        // The cells of a line are at least two blanks apart.
        let line = lines.lines().find(|line| line.starts_with(env["id"].as_str().unwrap())).unwrap();
        let cells: Vec<&str> = line.split("  ").map(str::trim).filter(|cell| !cell.is_empty()).collect();
        let paper = env["paper_name"].as_str().unwrap_or("-");
        let expected =
            [&env["id"], &env["group"], &env["observation"], &env["action"]].map(|text| text.as_str().unwrap());
        assert_eq!([cells[0], cells[1], cells[6], cells[7]], expected, "{line}");
        assert_eq!((cells[2], cells[5]), (env["max_steps"].to_string().as_str(), paper), "{line}");
        assert!(cells[4].starts_with(&format!("{mean:.3}")), "{line}");
    }
    let random = |id: &str| {
        let env = json.as_array().unwrap().iter().find(|env| env["id"] == id).unwrap();
        (env["random"]["mean"].as_f64().unwrap(), env["random"]["standard_error"].as_f64().unwrap())
    };
    // A quarter of the answers are right.
    let (mean, error) = random("popgym-RepeatFirstEasy-v0");
    assert!((mean + 0.5).abs() < 4.0 * error, "{mean} +- {error}");
    let cart_pole =
        json.as_array().unwrap().iter().find(|env| env["id"] == "popgym-PositionOnlyCartPoleEasy-v0").unwrap();
    assert!(cart_pole["aliases"].to_string().contains("StatelessCartPoleEasy"), "{cart_pole}");
}

#[test]
fn memories_and_presets_are_listed() {
    let scene = Scene::new();
    for (what, names) in [("memories", ["mlp", "gru"]), ("presets", ["quick", "paper"])] {
        let lines = scene.learner(&["list", what]).expect(0).stdout;
        let json: Value = serde_json::from_str(&scene.learner(&["list", what, "--json"]).expect(0).stdout).unwrap();
        for name in names {
            assert!(lines.lines().any(|line| line.starts_with(name)), "{lines}");
            assert!(json.as_array().unwrap().iter().any(|entry| entry["name"] == name), "{json}");
        }
        let header = usize::from(what == "memories");
        assert_eq!(json.as_array().unwrap().len() + header, lines.lines().count());
    }
}

#[test]
fn the_programs_run_from_anywhere() {
    // A directory that has nothing to do with the workspace, and no variable set but the path for processes.
    let scene = Scene::new();
    let mut command = popgym_tests::Program::Learner.command();
    command.env_clear().current_dir(scene.path("."));
    command.args(["train", "--config", "tiny.toml", "--out", "run", "--steps", "512"]);
    popgym_tests::Process::start("learner with an empty environment", command).expect(0);
    assert_eq!(scene.rows("run"), 1);
}
