//! `learner study`: every trial once, whatever happens to the process that runs them.

use std::collections::BTreeSet;
use std::fs;
use std::net::TcpListener;

use popgym_tests::{Process, Scene, net, until};
use rustix::process::Signal;
use serde_json::Value;

/// Six trials of four epochs each.
const STUDY: &str = "
[run]
steps = 2048
checkpoint_epochs = 1
device = \"cpu\"
[run.service]
slots = 16
[run.memory]
hidden_size = 16
[run.ppo]
batch_steps = 512
minibatch_steps = 256
passes = 1
[[product]]
envs = [\"RepeatFirstEasy\", \"CountRecallEasy\", \"RepeatPreviousEasy\"]
memories = [\"mlp\", \"gru\"]
seeds = [3]
";
const TRIALS: usize = 6;

fn scene(study: &str) -> Scene {
    let scene = Scene::new();
    scene.write("study.toml", study);
    scene
}

fn run(scene: &Scene, flags: &[&str]) -> Process {
    scene.learner(&[&["study", "run", "study.toml", "--out", "study"], flags].concat())
}

fn list(scene: &Scene) -> Vec<Value> {
    let outcome = scene.learner(&["study", "list", "study.toml", "--out", "study", "--json"]).expect(0);
    serde_json::from_str(&outcome.stdout).unwrap()
}

fn standings(scene: &Scene) -> Vec<String> {
    list(scene).iter().map(|trial| trial["standing"].as_str().unwrap().to_owned()).collect()
}

/// The names of the study's run directories.
fn runs(scene: &Scene) -> BTreeSet<String> {
    let entries = fs::read_dir(scene.path("study/trials")).into_iter().flatten().flatten();
    let directories = entries.filter(|entry| entry.path().is_dir());
    directories.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
}

fn assert_complete(scene: &Scene) {
    assert_eq!(standings(scene), ["done"; TRIALS]);
    let expected: BTreeSet<String> =
        list(scene).iter().map(|trial| trial["name"].as_str().unwrap().to_owned()).collect();
    assert_eq!(runs(scene), expected);
    for name in &expected {
        let metrics = scene.metrics(&format!("study/trials/{name}"));
        let epochs: Vec<&str> = metrics.lines().skip(1).map(|line| line.split(',').next().unwrap()).collect();
        assert_eq!(epochs, ["0", "1", "2", "3"], "{name}: every epoch once");
    }
}

#[test]
fn a_study_runs_its_trials_and_only_those_left() {
    let scene = scene(STUDY);
    let listed = scene.learner(&["study", "list", "study.toml"]).expect(0).stdout;
    assert_eq!(listed.lines().count(), TRIALS);
    assert!(listed.contains("    3  CountRecallEasy"), "{listed}");
    let outcome = run(&scene, &["--jobs", "2"]).expect(0);
    assert!(outcome.stdout.contains("6 of 6 trials done"), "{}", outcome.stdout);
    assert!(outcome.stderr.contains("study: ") && outcome.stderr.contains("MMER"), "{}", outcome.stderr);
    assert_complete(&scene);
    // A trial is the run that `train` makes of its configuration.
    let name = "0005-RepeatPreviousEasy-gru-seed3";
    scene.learner(&["train", "--config", &format!("study/trials/{name}.toml"), "--out", "alone"]).expect(0);
    assert_eq!(scene.metrics("alone"), scene.metrics(&format!("study/trials/{name}")));

    let before = scene.read(&format!("study/trials/{name}.log"));
    run(&scene, &[]).expect(0);
    assert_eq!(scene.read(&format!("study/trials/{name}.log")), before, "what is done is not run again");
    scene.write("study.toml", &STUDY.replace("seeds = [3]", "seeds = [4]"));
    let outcome = run(&scene, &[]).expect(2);
    assert!(outcome.stderr.contains("another study") && outcome.stderr.contains("seed4"), "{}", outcome.stderr);

    // Checkpoints may go once a run is done.
    scene.write("study.toml", STUDY);
    let metrics = scene.metrics(&format!("study/trials/{name}"));
    fs::remove_dir_all(scene.path(&format!("study/trials/{name}/checkpoints"))).unwrap();
    run(&scene, &[]).expect(0);
    let again = scene.resume(&format!("study/trials/{name}"), &[]).expect(0);
    assert!(again.stdout.contains("already complete"), "{}", again.stdout);
    assert_eq!(scene.metrics(&format!("study/trials/{name}")), metrics);

    assert_reported(&scene);
    assert_compared(&scene);
}

/// A column of a table with a head.
fn column(table: &str, name: &str) -> Vec<String> {
    let mut reader = csv::Reader::from_reader(table.as_bytes());
    let head = reader.headers().unwrap().clone();
    let column = head.iter().position(|known| known == name).unwrap_or_else(|| panic!("no {name} in {head:?}"));
    reader.records().map(|row| row.unwrap()[column].to_owned()).collect()
}

/// The report says what the runs' own files say, and names what it cannot read.
fn assert_reported(scene: &Scene) {
    let report = |flags: &[&str]| scene.learner(&[&["study", "report"], flags].concat());
    report(&["study"]).expect(0);
    let reported = scene.read("study/report/runs.csv");
    let (dirs, steps, mmers) = (column(&reported, "dir"), column(&reported, "steps"), column(&reported, "mmer"));
    assert_eq!(dirs.len(), TRIALS);
    for ((dir, steps), mmer) in dirs.iter().zip(steps).zip(mmers) {
        let metrics = scene.metrics(dir);
        assert_eq!(column(&metrics, "env_steps").last(), Some(&steps), "{dir}");
        let returns = column(&metrics, "mean_return").into_iter().map(|value| value.parse::<f64>().unwrap());
        assert!((returns.fold(f64::NEG_INFINITY, f64::max) - mmer.parse::<f64>().unwrap()).abs() < 1e-12, "{dir}");
    }

    scene.write("odd/half/config.toml", "env = ");
    let old = scene.metrics(&dirs[0]).replace("epoch_return,", "");
    for (file, text) in [("config.toml", scene.read(&format!("{}/config.toml", dirs[0]))), ("metrics.csv", old)] {
        scene.write(&format!("odd/old/{file}"), &text);
    }
    let notes = report(&["study", "odd", "--out", "both"]).expect(0).stderr;
    assert_eq!(notes.lines().count(), 2, "{notes}");
    assert!(notes.contains("odd/half: left out:") && notes.contains("odd/old: left out:"), "{notes}");
    assert_eq!(column(&scene.read("both/runs.csv"), "dir"), dirs);
    let refused = report(&["odd"]).expect(2).stderr;
    assert_eq!(refused.trim_end().lines().last(), Some("error: no run in odd can be reported"));
    fs::create_dir(scene.path("empty")).unwrap();
    let refused = report(&["empty"]).expect(2).stderr;
    assert!(refused.starts_with("error: empty holds no run") && refused.trim_end().lines().count() == 1, "{refused}");
}

fn assert_compared(scene: &Scene) {
    let run = |name: &str| format!("study/trials/{name}");
    let (mlp, gru) = (run("0000-RepeatFirstEasy-mlp-seed3"), run("0001-RepeatFirstEasy-gru-seed3"));
    let said = scene.learner(&["compare", &mlp, &gru]).expect(0).stdout;
    assert!(said.contains("mlp") && said.contains("gru") && scene.path("compare/compare.html").exists(), "{said}");
    let refused = scene.learner(&["compare", &mlp, "empty"]).expect(2).stderr;
    assert!(refused.starts_with("error: ") && refused.contains("empty"), "{refused}");
    assert_eq!(refused.trim_end().lines().count(), 1, "{refused}");
}

#[test]
fn a_killed_study_loses_nothing_and_does_nothing_twice() {
    let scene = scene(STUDY);
    for round in 0..10 {
        let mut study = run(&scene, &["--jobs", "2"]);
        // At another moment each time: as soon as so many epochs are there as in none of the rounds before.
        let epochs = || runs(&scene).iter().map(|name| scene.rows(&format!("study/trials/{name}"))).sum::<usize>();
        let target = epochs() + 1 + round % 3;
        until("progress", || (epochs() >= target || !study.is_running()).then_some(()));
        study.signal(Signal::KILL);
        study.wait();
    }
    run(&scene, &["--jobs", "2"]).expect(0);
    assert_complete(&scene);
    // Uninterrupted it is the same study.
    let whole = self::scene(STUDY);
    run(&whole, &["--jobs", "2"]).expect(0);
    for name in runs(&scene) {
        let path = format!("study/trials/{name}");
        assert_eq!(scene.metrics(&path), whole.metrics(&path), "{name}");
        assert!(!scene.path(&format!("{path}.failures")).exists(), "{name}: an interruption is no failure");
    }
}

/// A port that is free, and so is the one after it.
fn two_ports() -> (u16, u16) {
    until("two ports", || {
        let port: u16 = net::free_address().rsplit_once(':')?.1.parse().ok()?;
        let next = port.checked_add(1)?;
        TcpListener::bind(("127.0.0.1", next)).ok()?;
        Some((port, next))
    })
}

#[test]
fn an_interrupted_study_saves_and_goes_on() {
    let scene = scene(&STUDY.replace("steps = 2048", "steps = 200000"));
    let (first_port, second_port) = two_ports();
    let mut study = run(&scene, &["--jobs", "2", "--metrics-listen", &first_port.to_string()]);
    until("two trials", || (runs(&scene).len() >= 2).then_some(()));
    let first = "study/trials/0000-RepeatFirstEasy-mlp-seed3";
    scene.reached(&mut study, first, 3);
    for (port, memory) in [(first_port, "mlp"), (second_port, "gru")] {
        let info = format!("popgym_learner_run_info{{env=\"popgym-RepeatFirstEasy-v0\",memory=\"{memory}\"");
        net::get(&format!("127.0.0.1:{port}"), "/metrics", &[&info]);
    }
    study.signal(Signal::TERM);
    let outcome = study.expect(130);
    assert!(outcome.stdout.contains("0 of 6 trials done, 6 left"), "{}", outcome.stdout);
    let epochs = scene.rows(first);
    assert_eq!(scene.checkpoints(first).last().unwrap(), &format!("epoch-{epochs:06}"), "the last epoch was saved");
    assert_eq!(standings(&scene)[0], "begun");
}

#[test]
fn one_trial_is_run_once_by_whoever_comes_first() {
    let scene = scene(STUDY);
    run(&scene, &["--index", "4"]).expect(0);
    assert_eq!(runs(&scene), BTreeSet::from(["0004-RepeatPreviousEasy-mlp-seed3".to_owned()]));
    // All tasks of an array, and each twice, at a time.
    let tasks: Vec<String> = (0..2 * TRIALS).map(|task| (task / 2).to_string()).collect();
    let tasks: Vec<Process> = tasks.iter().map(|index| run(&scene, &["--index", index])).collect();
    for mut task in tasks {
        // Whoever found another at work is to come again.
        let outcome = task.wait();
        let expected = if outcome.status.success() {
            "1 of 1 trials done"
        } else {
            "0 of 1 trials done, 1 run by other processes"
        };
        assert!(outcome.stdout.contains(expected), "{outcome:?}");
    }
    assert_complete(&scene);
    for name in runs(&scene) {
        let log = scene.read(&format!("study/trials/{name}.log"));
        assert_eq!(log.matches("trained ").count(), 1, "{name} was run once:\n{log}");
    }
}

#[test]
fn a_trial_that_fails_is_tried_three_times_and_told() {
    let scene = scene(&format!(
        "{STUDY}[[override]]\nmemories = ['gru']\nrun = {{ service = {{ actor_command = ['false'] }} }}\n"
    ));
    let outcome = run(&scene, &["--jobs", "2"]).expect(1);
    assert!(outcome.stdout.contains("3 of 6 trials done, 3 failed"), "{}", outcome.stdout);
    assert!(
        outcome.stdout.contains("0001-RepeatFirstEasy-gru-seed3 failed: error: local actors fail"),
        "{}",
        outcome.stdout
    );
    assert_eq!(standings(&scene), ["done", "failed", "done", "failed", "done", "failed"]);
    let failures = scene.read("study/trials/0001-RepeatFirstEasy-gru-seed3.failures");
    assert_eq!(failures.matches("exit status: 1").count(), 3, "{failures}");
    // It is not tried again by itself, only if asked for.
    run(&scene, &[]).expect(1);
    assert_eq!(scene.read("study/trials/0001-RepeatFirstEasy-gru-seed3.failures"), failures);
    scene.write(
        "study.toml",
        &format!("{STUDY}[[override]]\nmemories = ['gru']\nrun = {{ service = {{ actor_command = [] }} }}\n"),
    );
    run(&scene, &["--retry-failed"]).expect(0);
    assert_complete(&scene);
}

#[test]
fn bad_input_is_told() {
    let scene = scene(STUDY);
    let bad = |args: &[&str], parts: &[&str]| {
        let error = scene.learner(args).expect(2).stderr;
        for part in parts {
            assert!(error.contains(part), "`{part}` is not in: {error}");
        }
        assert_eq!(error.trim_end().lines().count(), 1, "one line: {error}");
    };
    bad(&["study", "run", "study.toml", "--out", "study", "--index", "6"], &["--index is 6", "0 to 5"]);
    bad(&["study", "run", "study.toml", "--out", "study", "--jobs", "0"], &["--jobs", "0"]);
    bad(
        &["study", "run", "study.toml", "--out", "study", "--metrics-listen", "0"],
        &["--metrics-listen is `0`", "1 to 65535"],
    );
    let metrics = ["--jobs", "3", "--metrics-listen", "65534"];
    bad(
        &[&["study", "run", "study.toml", "--out", "study"], &metrics[..]].concat(),
        &["`65534`", "3 trials at a time"],
    );
    bad(&["study", "run", "none.toml", "--out", "study"], &["none.toml"]);
    bad(&["study", "list", "tiny.toml"], &["tiny.toml", "checkpoint_epochs"]);
    assert!(!scene.path("study").exists(), "nothing was begun");
}
