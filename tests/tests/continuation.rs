//! Runs that end early, by Ctrl-C or as asked, and go on: `--continue`, `resume`, `resume --steps`.

use std::collections::BTreeSet;
use std::sync::LazyLock;

use popgym_tests::process::{Life, Program};
use popgym_tests::{Process, Scene};
use rustix::process::Signal;

/// 30 epochs: Ctrl-C has time to come in the middle.
const STEPS: [&str; 2] = ["--steps", "16384"];

static UNDISTURBED: LazyLock<String> = LazyLock::new(|| Scene::new().curve("undisturbed", &STEPS));

/// The tiny run itself: 8 epochs.
static TINY: LazyLock<String> = LazyLock::new(|| Scene::new().curve("tiny", &[]));

/// `train --continue` into the directory `run`.
fn continued(scene: &Scene, flags: &[&str]) -> Process {
    scene.train("run", &[&["--continue"], flags].concat())
}

/// The only line of an error, which names all of `expected`.
#[track_caller]
fn assert_refused(process: Process, code: i32, expected: &[&str]) {
    let stderr = process.expect(code).stderr;
    let line = stderr.trim_end();
    assert!(line.starts_with("error: ") && !line.contains('\n'), "{stderr}");
    for text in expected {
        assert!(line.contains(text), "`{line}` should say `{text}`");
    }
}

#[test]
fn continue_starts_resumes_and_refuses() {
    let scene = Scene::new();
    // There is nothing: it starts. What is not part of the configuration of a run may differ.
    scene.train("run", &["--continue", "--steps", "2048"]).expect(0);
    assert_eq!(scene.metrics("run").lines().count(), 5);
    let done = continued(&scene, &["--steps", "2048", "--actors", "2"]).expect(0);
    assert!(done.stdout.contains("already complete"), "{}", done.stdout);
    // Another configuration, in the key that is named.
    for (flags, key) in [
        (["--seed", "1"], "seed is 0 there and 1 here"),
        (["--lag", "1"], "lag"),
        (["--memory", "mlp"], "memory.name"),
        (["--env", "RepeatFirstEasy"], "env"),
        (["--gamma", "0.5"], "ppo.gamma"),
        (["--log-std-min", "-2.5"], "policy.log_std_min"),
        (["--threads", "2"], "threads"),
    ] {
        let flags = [&flags[..], &["--steps", "2048"]].concat();
        assert_refused(continued(&scene, &flags), 2, &["run holds another run", key]);
    }
    assert_refused(continued(&scene, &[]), 2, &["steps is 2048 there and 4096 here"]);
    // Without --continue.
    assert_refused(scene.train("run", &[]), 2, &["already holds a run", "--continue"]);
    assert_eq!(scene.metrics("run").lines().count(), 5, "what was refused has touched nothing");
}

#[test]
fn continue_is_what_a_requeued_job_needs() {
    let scene = Scene::new();
    // An empty directory that is there already, as a volume is.
    std::fs::create_dir(scene.path("run")).unwrap();
    let mut rows = 0;
    for _ in 0..3 {
        let mut learner = continued(&scene, &STEPS);
        scene.reached(&mut learner, "run", rows + 4);
        learner.kill();
        rows = scene.rows("run");
    }
    continued(&scene, &STEPS).expect(0);
    assert_eq!(scene.accounted("run"), *UNDISTURBED);
}

/// Deaths one after the other, each at the next of the places around a row of metrics and a checkpoint: the n-th life ends
/// at the n-th place that it comes to.
fn deaths_between_any_two_writes_change_nothing(lag: &str) {
    let flags = ["--lag", lag, "--checkpoint-epochs", "1", "--keep-checkpoints", "1", "--steps", "2048"];
    let expected = Scene::new().curve("undisturbed", &flags);
    let scene = Scene::new();
    let mut places = BTreeSet::new();
    for life in 1.. {
        assert!(life < 60, "the run never ends");
        let mut command = Program::Learner.command();
        command.args(["train", "--config", "tiny.toml", "--out", "run", "--continue"]).args(flags);
        command.current_dir(scene.path("")).env("POPGYM_FAIL_POINT", life.to_string());
        let outcome = Process::start(&format!("life {life}"), command).wait();
        let place = outcome.stderr.lines().find_map(|line| line.strip_prefix("POPGYM_FAIL_POINT: "));
        let Some(place) = place else {
            assert_eq!(outcome.status.code(), Some(0), "{}", outcome.stderr);
            break;
        };
        places.insert(place.to_owned());
    }
    assert_eq!(scene.metrics("run"), expected);
    assert_eq!(scene.checkpoints("run").last(), Some(&"epoch-000004".to_owned()));
    let expected = [
        "a checkpoint half removed",
        "a checkpoint under its temporary name",
        "a checkpoint whose name is not yet synced",
        "a checkpoint without all its files",
        "a checkpoint without its manifest",
        "a record half written",
        "a record not yet synced",
        "an epoch reported and not saved",
    ];
    assert!(places.iter().eq(expected), "{places:?}");
}

#[test]
#[cfg_attr(not(debug_assertions), ignore = "only a build with debug assertions has places to die at")]
fn deaths_between_any_two_writes_change_nothing_without_lag() {
    deaths_between_any_two_writes_change_nothing("0");
}

#[test]
#[cfg_attr(not(debug_assertions), ignore = "only a build with debug assertions has places to die at")]
fn deaths_between_any_two_writes_change_nothing_with_lag() {
    deaths_between_any_two_writes_change_nothing("1");
}

#[test]
fn continue_after_a_death_at_the_very_beginning() {
    // What a learner leaves that was killed between its first files.
    for files in [
        &["lock"][..],
        &["lock", ".partial-run.json"],
        &["lock", "run.json"],
        &["lock", "run.json", ".partial-config.toml"],
    ] {
        let scene = Scene::new();
        std::fs::create_dir(scene.path("run")).unwrap();
        for file in files {
            scene.write(&format!("run/{file}"), "");
        }
        continued(&scene, &["--steps", "512"]).expect(0);
        assert_eq!(scene.rows("run"), 1, "{files:?}");
    }
}

#[test]
fn a_directory_with_other_files_is_left_alone() {
    // In whichever order the file system lists them.
    for file in ["thesis.tex", "a", "metrics.csv", "zebra.png"] {
        let scene = Scene::new();
        std::fs::create_dir(scene.path("run")).unwrap();
        scene.write("run/lock", "");
        scene.write(&format!("run/{file}"), "");
        assert_refused(scene.train("run", &[]), 1, &["run is not empty", file]);
        assert_refused(continued(&scene, &[]), 1, &["run is not empty", file]);
        assert_eq!(std::fs::read_dir(scene.path("run")).unwrap().count(), 2);
    }
}

#[test]
fn one_learner_a_directory() {
    let scene = Scene::new();
    let mut learner = scene.train("run", &["--actors", "0", "--listen", "127.0.0.1:0"]);
    learner.url();
    assert_refused(scene.resume("run", &[]), 1, &["another learner is working in run"]);
    assert_refused(continued(&scene, &[]), 1, &["another learner is working in run"]);
    learner.kill();
    // The lock goes with its holder.
    scene.resume("run", &["--actors", "1", "--listen", "127.0.0.1:0"]).expect(0);
    assert_eq!(scene.accounted("run"), *TINY);
}

fn ctrl_c_saves_and_resume_completes(signal: Signal, lag: &str, checkpoint_epochs: &str) {
    let scene = Scene::new();
    let flags = ["--lag", lag, "--actors", "2", "--checkpoint-epochs", checkpoint_epochs];
    let mut learner = scene.train("run", &[&flags[..], &STEPS].concat());
    scene.reached(&mut learner, "run", 5);
    let actors = learner.actors();
    learner.signal(signal);
    let log = learner.expect(if signal == Signal::TERM { 0 } else { 130 }).stderr;
    assert_eq!(log.matches("interrupted: saving and stopping").count(), 1, "{log}");
    Life::expect_gone(&actors);
    let rows = scene.rows("run");
    assert!((5..30).contains(&rows), "{rows}");
    assert_eq!(scene.checkpoints("run").last(), Some(&format!("epoch-{rows:06}")), "of the last epoch");
    let summary = scene.json("run/summary.json");
    assert_eq!((&summary["stopped_by"], &summary["epochs"]), (&"interrupt".into(), &rows.into()), "{summary}");
    scene.resume("run", &[]).expect(0);
    let summary = scene.json("run/summary.json");
    assert_eq!(summary["stopped_by"], "steps", "{summary}");
    if lag == "0" {
        assert_eq!(scene.accounted("run"), *UNDISTURBED);
    } else {
        assert_eq!(scene.metrics("run"), Scene::new().curve("undisturbed", &["--lag", lag, STEPS[0], STEPS[1]]));
    }
}

#[test]
fn ctrl_c_saves_and_resume_completes_without_lag() {
    ctrl_c_saves_and_resume_completes(Signal::INT, "0", "1000");
}

#[test]
fn ctrl_c_saves_and_resume_completes_with_lag() {
    ctrl_c_saves_and_resume_completes(Signal::INT, "1", "1000");
}

#[test]
fn sigterm_is_as_good_as_ctrl_c() {
    ctrl_c_saves_and_resume_completes(Signal::TERM, "0", "1");
}

#[test]
fn remote_actors_are_told_to_wait() {
    let scene = Scene::new();
    let mut learner = scene.train("run", &[&["--actors", "0", "--listen", "127.0.0.1:0"], &STEPS[..]].concat());
    let url = learner.url();
    let mut actor = scene.actor(&url, &[]);
    scene.reached(&mut learner, "run", 5);
    learner.signal(Signal::TERM);
    let log = learner.expect(0).stderr;
    assert!(!log.contains("not all actors have gone"), "{log}");
    actor.logged("(the learner was asked to stop; it may return); trying again");
    let resumed = scene.resume("run", &["--listen", url.trim_start_matches("http://")]);
    actor.expect(0);
    resumed.expect(0);
    assert_eq!(scene.accounted("run"), *UNDISTURBED);
}

#[test]
fn sigterm_gives_a_time_of_grace() {
    let scene = Scene::new();
    let mut learner = scene.train("run", &[&STEPS[..], &["--grace", "1"]].concat());
    scene.reached(&mut learner, "run", 5);
    // An actor that does not react: the learner waits longer for it than it is given.
    let actors = learner.actors();
    for actor in &actors {
        actor.signal(Signal::STOP);
    }
    learner.signal(Signal::TERM);
    let log = learner.expect(1).stderr;
    assert!(log.contains("the time of grace is over"), "{log}");
    for actor in &actors {
        actor.signal(Signal::CONT);
    }
    Life::expect_gone(&actors);
    assert_eq!(scene.json("run/summary.json")["stopped_by"], "interrupt");
    scene.resume("run", &[]).expect(0);
    assert_eq!(scene.accounted("run"), *UNDISTURBED);
}

#[test]
fn ctrl_c_before_the_first_epoch() {
    let scene = Scene::new();
    let mut learner = scene.train("run", &["--actors", "0", "--listen", "127.0.0.1:0"]);
    scene.actor(&learner.url(), &["--run", "another"]).expect(1);
    learner.signal(Signal::INT);
    learner.expect(130);
    assert!(scene.checkpoints("run").is_empty());
    assert_eq!(scene.json("run/summary.json")["epochs"], 0);
    scene.resume("run", &["--actors", "1"]).expect(0);
    assert_eq!(scene.accounted("run"), *TINY);
}

#[test]
fn a_second_ctrl_c_ends_at_once() {
    let scene = Scene::new();
    let mut learner = scene.train("run", &STEPS);
    scene.reached(&mut learner, "run", 5);
    // An actor that does not react: the learner, once it has saved, waits for it for some seconds.
    let actors = learner.actors();
    for actor in &actors {
        actor.signal(Signal::STOP);
    }
    learner.signal(Signal::INT);
    learner.logged("interrupted: saving and stopping; once more stops at once");
    learner.signal(Signal::INT);
    learner.expect(130);
    // The actor's standard input has ended, which it sees when it wakes up.
    for actor in &actors {
        actor.signal(Signal::CONT);
    }
    Life::expect_gone(&actors);
    scene.resume("run", &[]).expect(0);
    assert_eq!(scene.accounted("run"), *UNDISTURBED);
}

#[test]
fn a_second_ctrl_c_ends_in_the_middle_of_an_update() {
    let scene = Scene::new();
    // Minibatches so large that the first Ctrl-C is noticed late; with lag 1 the learner always has one.
    let mut large: toml::Table = scene.read("tiny.toml").parse().unwrap();
    large.insert("memory".to_owned(), toml::toml! { hidden_size = 256 }.into());
    scene.write("tiny.toml", &large.to_string());
    let sizes = ["--batch-steps", "4096", "--minibatch-steps", "4096", "--passes", "8", "--steps", "1000000"];
    let mut learner = scene.train("run", &[&["--lag", "1"], &sizes[..]].concat());
    scene.reached(&mut learner, "run", 1);
    let actors = learner.actors();
    learner.signal(Signal::INT);
    learner.logged("interrupted: saving and stopping; once more stops at once");
    learner.signal(Signal::INT);
    learner.expect(130);
    Life::expect_gone(&actors);
}

#[test]
fn a_complete_run_stays_as_it_is() {
    let scene = Scene::new();
    scene.curve("run", &[]);
    let summary = scene.read("run/summary.json");
    let outcome = scene.resume("run", &[]).expect(0);
    assert!(outcome.stdout.contains("already complete"), "{}", outcome.stdout);
    assert_eq!(scene.accounted("run"), *TINY);
    assert_eq!(scene.read("run/summary.json"), summary);
}

fn resume_with_more_steps_is_the_longer_run(lag: &str) {
    let scene = Scene::new();
    let longer = scene.curve("longer", &["--lag", lag]);
    // With a checkpoint every two epochs: once at a multiple of it, once at an odd epoch.
    for (run, steps) in [("even", "2048"), ("odd", "1024")] {
        scene.curve(run, &["--lag", lag, "--steps", steps]);
        assert!(scene.rows(run) < 5);
        scene.resume(run, &["--steps", "4096"]).expect(0);
        assert_eq!(scene.metrics(run), longer, "{run}");
        assert_eq!(scene.json(&format!("{run}/summary.json"))["epochs"], 8);
        // What was asked for stays: the run is complete now.
        assert!(scene.resume(run, &[]).expect(0).stdout.contains("already complete"));
    }
}

#[test]
fn resume_with_more_steps_is_the_longer_run_without_lag() {
    resume_with_more_steps_is_the_longer_run("0");
}

#[test]
fn resume_with_more_steps_is_the_longer_run_with_lag() {
    resume_with_more_steps_is_the_longer_run("1");
}

#[test]
fn a_damaged_checkpoint_is_passed_over() {
    for (file, damage) in [("weights.safetensors", None), ("optimizer.safetensors", None), ("manifest.json", Some("{"))]
    {
        let scene = Scene::new();
        scene.curve("run", &["--steps", "2048"]);
        assert_eq!(scene.checkpoints("run"), ["epoch-000002", "epoch-000004"]);
        let path = scene.path("run/checkpoints/epoch-000004").join(file);
        let mut bytes = std::fs::read(&path).unwrap();
        match damage {
            Some(text) => bytes = text.into(),
            None => *bytes.last_mut().unwrap() ^= 1,
        }
        std::fs::write(&path, bytes).unwrap();
        let log = scene.resume("run", &["--steps", "4096"]).expect(0).stderr;
        assert_eq!(log.matches("WARN").count(), 1, "{log}");
        assert!(log.contains("checkpoint not used") && log.contains(file), "{log}");
        assert_eq!(scene.metrics("run"), *TINY, "{file}");
    }
}

#[test]
fn a_summary_from_before_does_not_make_a_run_complete() {
    let scene = Scene::new();
    // An interrupted session has left a summary; a later one reached the end and was killed before it wrote its own.
    scene.curve("run", &[]);
    let stale = scene.read("run/summary.json").replace("\"steps\"", "\"interrupt\"");
    scene.write("run/summary.json", &stale.replace("\"epochs\": 8", "\"epochs\": 3"));
    scene.resume("run", &[]).expect(0);
    let summary = scene.json("run/summary.json");
    assert_eq!((&summary["stopped_by"], &summary["epochs"]), (&"steps".into(), &8.into()), "{summary}");
    assert_eq!(scene.accounted("run"), *TINY);
}
