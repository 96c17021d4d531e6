//! Disks that are full or cannot be written to: the run goes on and says so, what it has stays, and the curve is the same.

use std::fs;
use std::process::Command;

use popgym_tests::process::Program;
use popgym_tests::{Process, Scene, net};
use rustix::process::{Pid, Resource, Rlimit, prlimit};

/// Long enough that its middle cannot be missed.
const STEPS: [&str; 2] = ["--steps", "16384"];
const FAILURES: &str = "popgym_learner_checkpoint_failures_total";

fn undisturbed() -> String {
    Scene::new().curve("undisturbed", &STEPS)
}

/// Starts a learner that can be told how large its files may become. (The system's default is to kill who goes beyond.)
fn start(scene: &Scene, args: &[&str]) -> Process {
    let mut command = Command::new("sh");
    command.args(["-c", "trap '' XFSZ; exec \"$@\"", "sh"]).arg(Program::Learner.path()).args(args);
    command.current_dir(scene.path("."));
    Process::start(&format!("learner {}", args.join(" ")), command)
}

/// From now on a write beyond so many bytes of a file fails, as on a full disk.
fn limit_files(learner: &Process, bytes: Option<u64>) {
    let pid = Pid::from_raw(learner.id() as i32).expect("a process has a number");
    prlimit(Some(pid), Resource::Fsize, Rlimit { current: bytes, maximum: None }).expect("limits of one's own process");
}

/// The run's checkpoints, without one that is being written just now.
fn whole(scene: &Scene) -> Vec<String> {
    let mut names = scene.checkpoints("run");
    names.retain(|name| !name.contains(".tmp"));
    names
}

/// More than a run's other files, less than its weights.
fn fill(scene: &Scene, learner: &Process) {
    let newest = whole(scene).pop().expect("a checkpoint");
    let weights = fs::metadata(scene.path(&format!("run/checkpoints/{newest}/weights.safetensors")));
    limit_files(learner, Some(weights.expect("its weights").len() - 1));
}

#[test]
fn a_full_disk_costs_checkpoints_and_not_the_run() {
    let (scene, metrics) = (Scene::new(), net::free_address());
    let flags = ["train", "--config", "tiny.toml", "--out", "run", "--metrics-listen", &metrics, STEPS[0], STEPS[1]];
    let mut learner = start(&scene, &flags);
    scene.reached(&mut learner, "run", 3);
    fill(&scene, &learner);
    let error = learner.logged("not written");
    assert!(error.contains("ERROR") && error.contains("weights.safetensors"), "{error}");
    let before = whole(&scene);
    net::get(&metrics, "/metrics", &[&format!("{FAILURES} 1")]);
    let rows = scene.rows("run");
    scene.reached(&mut learner, "run", rows + 4);
    // Between two attempts.
    let unchanged = |_: &mut Process| (scene.checkpoints("run") == before).then_some(());
    learner.until("what there was, and nothing half written", unchanged);

    limit_files(&learner, None);
    let rows = scene.rows("run");
    scene.reached(&mut learner, "run", rows + 4);
    assert_ne!(whole(&scene), before);
    learner.expect(0);
    assert_eq!(scene.accounted("run"), undisturbed());
}

#[test]
fn a_disk_that_is_full_at_the_end_is_an_error_and_the_run_can_be_resumed() {
    let scene = Scene::new();
    let mut learner = start(&scene, &["train", "--config", "tiny.toml", "--out", "run", STEPS[0], STEPS[1]]);
    scene.reached(&mut learner, "run", 3);
    fill(&scene, &learner);
    let log = learner.expect(1).stderr;
    assert!(log.contains("error: the run ended, but its last checkpoint could not be written"), "{log}");
    scene.resume("run", &[]).expect(0);
    assert_eq!(scene.accounted("run"), undisturbed());
}

#[test]
fn checkpoints_that_cannot_be_written_are_made_up_for_after_a_crash() {
    let scene = Scene::new();
    let mut learner = scene.train("run", &STEPS);
    scene.reached(&mut learner, "run", 3);
    // As of a file system that has become read-only, for any user.
    fs::rename(scene.path("run/checkpoints"), scene.path("run/aside")).expect("a directory of one's own");
    scene.write("run/checkpoints", "");
    learner.logged("not written");
    let rows = scene.rows("run");
    scene.reached(&mut learner, "run", rows + 4);
    learner.kill();
    fs::remove_file(scene.path("run/checkpoints")).expect("a file of one's own");
    fs::rename(scene.path("run/aside"), scene.path("run/checkpoints")).expect("a directory of one's own");
    scene.resume("run", &[]).expect(0);
    assert_eq!(scene.accounted("run"), undisturbed());
}
