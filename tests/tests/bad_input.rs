//! Bad input: one line on standard error that says what is wrong, and the right exit code.

use std::net::TcpListener;
use std::process::Stdio;

use popgym_tests::{Outcome, Process, Program, Scene};

/// The only line of an error, which says all of `expected`.
#[track_caller]
fn assert_one_line(outcome: &Outcome, what: &str, expected: &[&str]) {
    let line = outcome.stderr.trim_end();
    assert!(line.starts_with("error: ") && !line.contains('\n'), "{what}: one line expected\n{}", outcome.stderr);
    for text in expected {
        assert!(line.contains(text), "{what}: `{line}` should say `{text}`");
    }
    assert_eq!(outcome.stdout, "", "{what}");
}

/// Bad configuration, as flags: exit 2, and no directory is made.
#[track_caller]
fn assert_bad_flags(flags: &[&str], expected: &[&str]) {
    let scene = Scene::new();
    let outcome = scene.train("run", flags).expect(2);
    assert_one_line(&outcome, &flags.join(" "), expected);
    assert!(!scene.path("run").exists(), "{flags:?}: a directory was made");
}

/// Bad configuration, as a file: exit 2, the file named, and no directory is made.
#[track_caller]
fn assert_bad_file(text: &str, expected: &[&str]) {
    let scene = Scene::new();
    scene.write("bad.toml", text);
    let outcome = scene.learner(&["train", "--config", "bad.toml", "--out", "run"]).expect(2);
    assert_one_line(&outcome, text, &[&["bad.toml"], expected].concat());
    assert!(!scene.path("run").exists(), "{text}: a directory was made");
}

/// What clap refuses: exit 2, in clap's own words.
#[track_caller]
fn assert_usage(args: &[&str], expected: &str) {
    let outcome = Scene::new().learner(args).expect(2);
    let first = outcome.stderr.lines().next().unwrap_or_default();
    assert!(first.starts_with("error: ") && outcome.stderr.contains(expected), "{args:?}: {}", outcome.stderr);
    assert_eq!(outcome.stdout, "");
}

/// A failure: exit 1.
#[track_caller]
fn assert_failure(process: Process, what: &str, expected: &[&str]) {
    assert_one_line(&process.expect(1), what, expected);
}

#[test]
fn unknown_names_and_the_nearest_right_one() {
    assert_bad_flags(
        &["--env", "RepeatPreviousEzy"],
        &["unknown environment `RepeatPreviousEzy`", "`RepeatPreviousEasy`"],
    );
    assert_bad_flags(&["--env", "popgym-BattelshipHard-v0"], &["popgym-BattelshipHard-v0", "BattleshipHard"]);
    assert_bad_flags(&["--memory", "gruu"], &["unknown memory `gruu`", "`gru`"]);
    assert_bad_flags(&["--preset", "quik"], &["unknown preset `quik`", "`quick`"]);
    assert_bad_file("sed = 1", &["unknown key `sed`", "`seed`"]);
    assert_bad_file("[ppo]\ngama = 0.9", &["unknown key `ppo.gama`", "`ppo.gamma`"]);
    assert_bad_file("[memory]\nhiden_size = 8", &["unknown key `memory.hiden_size`", "`memory.hidden_size`"]);
    assert_bad_file("[sevice]\nactors = 1", &["unknown key `sevice`", "`service`"]);
    assert_bad_file("[service]\nlisten_on = \"\"", &["unknown key `service.listen_on`", "`service.listen`"]);
    assert_usage(&["train", "--sede", "1"], "--seed");
    assert_usage(&["trian"], "train");
    assert_usage(&["list", "env"], "envs");
    assert_usage(&["train", "--learning-rate-schedule", "liner"], "linear");
}

#[test]
fn wrong_types() {
    assert_bad_file("seed = \"one\"", &["seed", "\"one\""]);
    assert_bad_file("seed = 1.5", &["seed", "1.5"]);
    assert_bad_file("env = 3", &["env"]);
    assert_bad_file("memory = \"gru\"", &["memory", "table"]);
    assert_bad_file("ppo = 3", &["ppo"]);
    assert_bad_file("[ppo]\ngamma = \"x\"", &["ppo.gamma", "\"x\""]);
    assert_bad_file("[ppo]\nlearning_rate_schedule = \"liner\"", &["ppo.learning_rate_schedule", "linear"]);
    assert_bad_file("[memory]\nhidden_size = \"x\"", &["hidden_size", "\"x\""]);
    assert_bad_file("[service]\nactors = -1", &["service.actors", "-1"]);
    assert_usage(&["train", "--seed", "one"], "--seed");
    assert_usage(&["train", "--actors", "-1"], "error: ");
}

#[test]
fn values_out_of_range_in_the_file() {
    assert_bad_file("seed = -1", &["seed", "-1"]);
    assert_bad_file("lag = 2", &["lag is 2", "0 to 1"]);
    assert_bad_file("steps = 0", &["steps is 0"]);
    assert_bad_file("threads = 0", &["threads is 0"]);
    assert_bad_file("rows = 3", &["rows is 3"]);
    assert_bad_file("max_episode_steps = 0", &["max_episode_steps is 0"]);
    assert_bad_file("keep_checkpoints = 0", &["keep_checkpoints is 0"]);
    assert_bad_file("stop_at_mmer = nan", &["stop_at_mmer is NaN"]);
    assert_bad_file("device = \"gpu\"", &["device is `gpu`", "cuda"]);
    assert_bad_file("[ppo]\ngamma = nan", &["ppo.gamma is NaN", "0 to 1"]);
    assert_bad_file("[ppo]\nlearning_rate = inf", &["ppo.learning_rate is inf"]);
    assert_bad_file("[memory]\nhidden_size = 0", &["hidden_size"]);
    assert_bad_file("[policy]\nlog_std_min = 3.0\nlog_std_max = 1.0", &["log_std_min"]);
    assert_bad_file("[policy]\nlog_std_min = 800.0\nlog_std_max = inf", &["log_std_min is 800", "-20 to 20"]);
    assert_bad_file("[service]\nlisten = \"nowhere\"", &["listen", "nowhere"]);
    assert_bad_file("[service]\nmetrics_listen = \"nowhere\"", &["metrics_listen", "nowhere"]);
}

#[test]
fn values_out_of_range_as_flags() {
    assert_bad_flags(&["--observability", "all"], &["observability is `all`", "full-and-partial"]);
    assert_bad_flags(&["--lag", "2"], &["lag is 2", "0 to 1"]);
    assert_bad_flags(&["--gamma", "2"], &["ppo.gamma is 2", "0 to 1"]);
    assert_bad_flags(&["--gamma", "-0.5"], &["ppo.gamma is -0.5"]);
    assert_bad_flags(&["--clip", "nan"], &["ppo.clip is NaN"]);
    assert_bad_flags(&["--stop-at-mmer", "nan"], &["stop_at_mmer is NaN"]);
    assert_bad_flags(&["--seed", "18446744073709551615"], &["seed"]);
    assert_bad_flags(&["--slots", "0"], &["service.slots is 0"]);
    assert_bad_flags(&["--actors", "5000"], &["service.actors is 5000"]);
    assert_bad_flags(&["--listen", "127.0.0.1:99999"], &["127.0.0.1:99999"]);
    assert_bad_flags(&["--metrics-listen", "nowhere"], &["nowhere"]);
    assert_usage(&["train", "--seed", "-1"], "-1");
    assert_usage(&["train", "--seed", "99999999999999999999"], "--seed");
    assert_usage(&["train", "--continue"], "--out");
}

#[test]
fn impossible_batches() {
    assert_bad_flags(&["--batch-steps", "0"], &["ppo.batch_steps is 0"]);
    assert_bad_flags(&["--batch-steps", "-512"], &["ppo.batch_steps is -512"]);
    assert_bad_flags(&["--minibatch-steps", "513"], &["ppo.minibatch_steps is 513", "at most ppo.batch_steps, 512"]);
    assert_bad_flags(&["--passes", "0"], &["ppo.passes is 0"]);
    assert_bad_flags(&["--bptt", "-1"], &["ppo.bptt is -1"]);
}

#[test]
fn files_that_are_no_configuration() {
    assert_bad_file("seed = ", &["line 1"]);
    assert_bad_file("seed = 1\nseed = 2", &["line 2", "duplicate"]);
    assert_bad_file("[ppo\ngamma = 1", &["line 1"]);
    assert_bad_file("seed = 99999999999999999999", &["99999999999999999999"]);
    assert_bad_file("\u{0}\u{1}", &["line 1"]);
    let scene = Scene::new();
    let outcome = scene.learner(&["train", "--config", "nothing.toml", "--out", "run"]).expect(2);
    assert_one_line(&outcome, "a missing file", &["nothing.toml", "No such file"]);
    std::fs::write(scene.path("latin.toml"), b"env = \"\xe9\"").unwrap();
    let outcome = scene.learner(&["train", "--config", "latin.toml", "--out", "run"]).expect(2);
    assert_one_line(&outcome, "not UTF-8", &["latin.toml", "UTF-8"]);
    let outcome = scene.learner(&["train", "--config", ".", "--out", "run"]).expect(2);
    assert_one_line(&outcome, "a directory", &["cannot read"]);
    assert!(!scene.path("run").exists());
}

#[test]
fn directories_that_cannot_be_used() {
    let scene = Scene::new();
    scene.write("file", "");
    assert_failure(scene.train("file/run", &[]), "below a file", &["cannot create the run directory file/run"]);
    assert_failure(scene.train("file", &[]), "a file", &["cannot create the run directory file"]);
    assert_failure(scene.train("file", &["--continue"]), "a file", &["cannot create the run directory file"]);
    for command in ["resume", "eval"] {
        for dir in ["nothing", "file", "."] {
            let outcome = scene.learner(&[command, dir]).expect(2);
            assert_one_line(&outcome, command, &[&format!("{dir} holds no run")]);
        }
    }
    assert_eq!(scene.read("file"), "");
}

#[test]
fn addresses_that_cannot_be_listened_on() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    for flag in ["--listen", "--metrics-listen"] {
        let scene = Scene::new();
        assert_failure(scene.train("run", &[flag, &address]), flag, &[&address, "in use"]);
        // The way out: the same command with another address.
        scene.train("run", &["--continue", flag, "127.0.0.1:0"]).expect(0);
        assert_eq!(scene.rows("run"), 8);
    }
}

#[test]
fn actor_commands_that_cannot_be_started() {
    let scene = Scene::new();
    let flags = ["--actor-command", "no-such-program actor"];
    assert_failure(scene.train("run", &flags), "--actor-command", &["service.actor_command", "`no-such-program`"]);
    scene.train("run", &["--continue"]).expect(0);
}

#[test]
fn runs_whose_files_are_damaged() {
    let scene = Scene::new();
    scene.curve("run", &["--steps", "2048"]);
    let (config, metrics) = (scene.read("run/config.toml"), scene.metrics("run"));
    for (damage, expected) in [("sed = 1\n", "unknown key `sed`"), ("seed = \n", "line 1"), ("lag = 7\n", "lag is 7")] {
        // The first line that has the key wins; a second is an error of its own.
        let text: String = config
            .lines()
            .filter(|line| !line.starts_with("seed") && !line.starts_with("lag"))
            .fold(damage.to_owned(), |text, line| text + line + "\n");
        scene.write("run/config.toml", &text);
        let more = ["--steps", "4096"];
        assert_one_line(&scene.resume("run", &more).expect(2), damage, &["run/config.toml", expected]);
        assert_one_line(&scene.learner(&["eval", "run"]).expect(2), damage, &["run/config.toml", expected]);
    }
    scene.write("run/config.toml", &config);
    // Rows of completed epochs are missing.
    let torn: String = metrics.lines().take(2).fold(String::new(), |text, line| text + line + "\n");
    scene.write("run/metrics.csv", &torn);
    assert_failure(
        scene.resume("run", &["--steps", "4096"]),
        "missing rows",
        &["metrics.csv", "found the rows of 1 epochs"],
    );
    scene.write("run/metrics.csv", &metrics);
    let identity = scene.read("run/run.json");
    scene.write("run/run.json", "{");
    assert_failure(scene.resume("run", &["--steps", "4096"]), "run.json", &["run.json"]);
    scene.write("run/run.json", &identity);
    // The weights are of another network.
    scene.write("run/config.toml", &config.replace("hidden_size = 16", "hidden_size = 8"));
    let stderr = scene.resume("run", &["--steps", "4096"]).expect(1).stderr;
    assert!(stderr.lines().any(|line| line.starts_with("error: ")), "{stderr}");
    scene.write("run/config.toml", &config);
    // Not one checkpoint is whole.
    for name in scene.checkpoints("run") {
        scene.write(&format!("run/checkpoints/{name}/manifest.json"), "{}");
    }
    let stderr = scene.resume("run", &["--steps", "4096"]).expect(1).stderr;
    assert_eq!(stderr.lines().filter(|line| line.starts_with("error: ")).count(), 1, "{stderr}");
    assert!(stderr.contains("no checkpoint can be used"), "{stderr}");
    assert_eq!(scene.metrics("run"), metrics, "what could not be resumed is as it was");
}

#[test]
fn impossible_evaluations() {
    let scene = Scene::new();
    scene.curve("run", &["--steps", "512"]);
    let refused = |flags: &[&str], expected: &str| {
        let outcome = scene.learner(&[&["eval", "run"], flags].concat()).expect(2);
        assert_one_line(&outcome, expected, &[expected]);
    };
    refused(&["--episodes", "0"], "--episodes is 0");
    refused(&["--actors", "0"], "--actors is 0");
    refused(&["--env", "RepeatPreviousHart"], "RepeatPreviousHart");
    refused(&["--env", "CountRecallEasy"], "whose observations are MultiDiscrete[2,2]; the agent of");
    refused(&["--env", "HigherLowerEasy"], "whose observations are Discrete(13); the agent of");
    assert_usage(&["eval", "run", "--episodes", "many"], "--episodes");
    assert_usage(&["eval", "run", "--checkpoint", "bets"], "best");
    let outcome = scene.resume("run", &["--steps", "0"]).expect(2);
    assert_one_line(&outcome, "no steps", &["steps is 0"]);
    let outcome = scene.resume("run", &["--device", "gpu"]).expect(2);
    assert_one_line(&outcome, "no device", &["device is `gpu`"]);
}

#[test]
fn impossible_games() {
    let scene = Scene::new();
    let refused =
        |args: &[&str], expected: &[&str]| assert_one_line(&scene.learner(args).expect(2), expected[0], expected);
    refused(&["play", "--env", "RepeatPreviousEzy"], &["`RepeatPreviousEzy`", "`RepeatPreviousEasy`"]);
    refused(&["play", "--env", "RepeatPreviousEasy", "--episodes", "0"], &["--episodes is 0", "1 or more"]);
    refused(&["play", "--env", "RepeatPreviousEasy"], &["learner play", "a terminal", "standard input"]);
    assert_usage(&["play"], "--env");
    assert_usage(&["play", "--env", "RepeatPreviousEasy", "--seed", "-1"], "--seed");
    refused(&["watch", "."], &["holds no run"]);
    refused(&["watch", "gone"], &["gone holds no run"]);
    let mut learner = scene.train("empty", &["--actors", "0", "--listen", "127.0.0.1:0"]);
    learner.url();
    refused(&["watch", "empty", "--gif", "a.gif"], &["empty holds no checkpoint yet"]);
    drop(learner);
    scene.curve("run", &["--steps", "512"]);
    refused(&["watch", "run"], &["learner watch", "a terminal", "--gif"]);
    for speed in ["0", "-1", "NaN", "inf", "1e9"] {
        refused(&["watch", "run", "--gif", "a.gif", "--speed", speed], &["--speed is ", "allowed is 0.01 to 1000"]);
    }
    refused(&["watch", "run", "--gif", "a.gif", "--episodes", "0"], &["--episodes is 0"]);
    assert_usage(&["watch", "run", "--speed", "fast"], "--speed");
    assert_usage(&["watch", "run", "--checkpoint", "bets"], "best");
    for path in ["gone/a.gif", "run", "tiny.toml/a.gif", ".."] {
        refused(&["watch", "run", "--gif", path], &["cannot write ", path]);
    }
    assert!(!scene.path("a.gif").exists());
    // A checkpoint that is not what it was.
    let checkpoint = scene.checkpoints("run").pop().unwrap();
    scene.write(&format!("run/checkpoints/{checkpoint}/weights.safetensors"), "damaged");
    assert_failure(scene.learner(&["watch", "run", "--gif", "a.gif"]), "damaged weights", &["weights.safetensors"]);
}

/// A command of a shell that runs the learner as `"$@"`.
fn shell(scene: &Scene, script: &str, args: &[&str]) -> Process {
    let mut command = std::process::Command::new("sh");
    command.args(["-c", script, "sh"]).arg(Program::Learner.path()).args(args);
    command.env_remove("RUST_LOG").stdin(Stdio::null()).current_dir(scene.path("."));
    Process::start(script, command)
}

#[test]
fn streams_that_are_closed() {
    let scene = Scene::new();
    let train = ["train", "--config", "tiny.toml", "--steps", "512", "--out"];
    shell(&scene, "exec \"$@\" <&-", &[&train[..], &["no-input"]].concat()).expect(0);
    shell(&scene, "exec \"$@\" >&-", &[&train[..], &["no-output"]].concat()).expect(0);
    shell(&scene, "exec \"$@\" <&- >&- 2>&-", &[&train[..], &["nothing"]].concat()).expect(0);
    let metrics = scene.metrics("no-input");
    assert_eq!((&metrics, &metrics), (&scene.metrics("no-output"), &scene.metrics("nothing")));
    // A reader that has gone: no reason to panic, and none to lose a run.
    shell(&scene, "\"$@\" | true", &[&train[..], &["no-reader"]].concat()).expect(0);
    assert_eq!(scene.json("no-reader/summary.json")["epochs"], 1);
    for args in [&["list", "envs"][..], &["list", "envs", "--json"], &["eval", "no-input", "--episodes", "2"]] {
        // `wait` itself checks that nothing has panicked.
        shell(&scene, "\"$@\" | true", args).wait();
    }
}
