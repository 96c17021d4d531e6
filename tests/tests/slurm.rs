//! The scripts of `deploy/slurm`: what they refuse, on any machine; what they do on a real Slurm, where one is installed
//! (`make slurm`).

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use popgym_tests::{Outcome, Process, Program, Scene};

/// The checkout.
fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

/// The directory of the programs.
fn programs() -> PathBuf {
    Program::Actor.path();
    Program::Learner.path().parent().unwrap().to_owned()
}

/// A command with no variables of a job, of Slurm or of this project but `variables`.
fn bash(script: &str, arguments: &[&str], variables: &[(&str, &str)]) -> Command {
    let mut command = Command::new("bash");
    command.arg(root().join(script)).args(arguments).stdin(Stdio::null());
    for (name, _) in std::env::vars_os() {
        if name.to_str().is_some_and(|name| name.starts_with("SLURM") || name.starts_with("POPGYM_")) {
            command.env_remove(name);
        }
    }
    command.envs(variables.iter().copied());
    command
}

/// The end of a script that is run as Slurm would run it, in a directory of its own.
#[track_caller]
fn outcome(scene: &Scene, code: i32, script: &str, arguments: &[&str], variables: &[(&str, &str)]) -> Outcome {
    let (root, programs) = (root().display().to_string(), programs().display().to_string());
    let job = [
        ("POPGYM_ROOT", root.as_str()),
        ("POPGYM_BIN", &programs),
        ("POPGYM_HOST", "localhost"),
        ("SLURM_JOB_ID", "1"),
        ("SLURMD_NODENAME", "node"),
        ("SLURM_CPUS_ON_NODE", "1"),
    ];
    let mut command = bash(&format!("deploy/slurm/{script}"), arguments, &[&job, variables].concat());
    command.current_dir(scene.path("."));
    Process::start(script, command).expect(code)
}

/// What is in a directory.
fn files(scene: &Scene, dir: &str) -> Vec<OsString> {
    std::fs::read_dir(scene.path(dir)).unwrap().flatten().map(|file| file.file_name()).collect()
}

#[test]
fn what_cannot_work_is_refused() {
    let scene = Scene::new();
    let refused = |script: &str, arguments: &[&str], variables: &[(&str, &str)], told: &str| {
        let outcome = outcome(&scene, 2, script, arguments, variables);
        let errors: Vec<&str> = outcome.stderr.lines().filter(|line| line.starts_with("error: ")).collect();
        assert!(matches!(errors[..], [error] if error.contains(told)), "{script}: `{told}`: {}", outcome.stderr);
    };
    for (script, arguments, program) in [
        ("train.sbatch", &["run"][..], "/nowhere/learner"),
        ("learner.sbatch", &["run"], "/nowhere/learner"),
        ("actors.sbatch", &["run"], "/nowhere/actor"),
        ("study.sbatch", &["study.toml", "study"], "/nowhere/learner"),
    ] {
        refused(script, arguments, &[("POPGYM_ROOT", "/nowhere")], "no deploy/slurm in /nowhere");
        refused(script, arguments, &[("SLURM_JOB_ID", "")], "this is a job: sbatch");
        refused(script, arguments, &[("POPGYM_BIN", "/nowhere")], program);
    }
    for (arguments, told) in [
        (&[][..], "the run's directory is ''"),
        (&["--env", "RepeatFirstEasy"], "the run's directory is '--env'"),
        (&["run", "--listen", "0.0.0.0:1"], "the flag --listen is not allowed"),
        (&["run", "--seed", "1", "--actors=4"], "the flag --actors=4 is not allowed"),
    ] {
        refused("learner.sbatch", arguments, &[], told);
    }
    for (name, value, told) in [
        ("POPGYM_GRACE", "0", "POPGYM_GRACE is '0', allowed is 1 to 3600"),
        ("POPGYM_GRACE", "soon", "POPGYM_GRACE is 'soon'"),
        ("POPGYM_TLS", "maybe", "POPGYM_TLS is 'maybe', allowed is on or off"),
        ("POPGYM_HOST", "a b", "POPGYM_HOST is 'a b'"),
    ] {
        refused("learner.sbatch", &["run"], &[(name, value)], told);
    }
    refused("actors.sbatch", &["run", "--slots"], &[], "'run --slots', allowed is one path");
    refused("actor.sh", &[], &[], "the run's directory is ''");
    refused("actor.sh", &["run"], &[("POPGYM_WAIT", "-1")], "POPGYM_WAIT is '-1'");
    refused("study.sbatch", &["study.toml"], &[], "the arguments are 'study.toml'");
    assert_eq!(files(&scene, "."), ["tiny.toml"], "nothing was begun");
}

#[test]
fn a_study_says_how_large_its_array_is() {
    let scene = Scene::new();
    scene.write("study.toml", "[[product]]\nenvs = [\"RepeatFirst\"]\nmemories = [\"mlp\", \"gru\"]\nseeds = [0]\n");
    let outcome = outcome(&scene, 2, "study.sbatch", &["study.toml", "study"], &[]);
    assert!(outcome.stderr.contains("this study's is --array=0-5"), "{}", outcome.stderr);
}

#[test]
fn an_actor_waits_for_a_learner_only_so_long() {
    let scene = Scene::new();
    let waits = outcome(&scene, 1, "actor.sh", &["run"], &[("POPGYM_WAIT", "1")]);
    assert!(waits.stderr.contains("error: no learner for 1 s"), "{}", waits.stderr);
    // Whose run is complete has nothing to wait for.
    scene.write("run.slurm/complete", "");
    outcome(&scene, 0, "actor.sh", &["run"], &[]);
}

#[test]
fn a_learner_that_cannot_work_is_given_up() {
    let scene = Scene::new();
    let wrong = outcome(&scene, 2, "learner.sbatch", &["run", "--env", "Nowhere"], &[("POPGYM_TLS", "off")]);
    assert!(wrong.stdout.contains("status 2: error: ") && wrong.stdout.contains("Nowhere"), "{}", wrong.stdout);
    assert_eq!(files(&scene, "run.slurm"), ["learner-1.log"], "no token is left");
}

/// Runs a case of `tests/slurm.sh`, which says what it does.
#[track_caller]
fn on_slurm(case: &str) {
    let programs = programs().display().to_string();
    let status = bash("tests/slurm.sh", &[case, &programs], &[]).status().expect("bash can be started");
    assert!(status.success(), "tests/slurm.sh {case} {programs}: {status}");
}

#[test]
#[ignore = "needs Slurm: make slurm"]
fn a_job_on_three_nodes_trains_and_leaves_its_files() {
    on_slurm("run");
}

#[test]
#[ignore = "needs Slurm: make slurm"]
fn nodes_that_fail_change_nothing() {
    on_slurm("node");
}

#[test]
#[ignore = "needs Slurm: make slurm"]
fn at_its_time_limit_a_run_is_saved_and_queued_again() {
    on_slurm("limit");
}

#[test]
#[ignore = "needs Slurm: make slurm"]
fn a_cancelled_run_is_saved_and_stays_cancelled() {
    on_slurm("cancel");
}

#[test]
#[ignore = "needs Slurm: make slurm"]
fn actors_of_other_jobs_come_and_go() {
    on_slurm("actors");
}

#[test]
#[ignore = "needs Slurm: make slurm"]
fn no_trial_of_a_study_is_run_twice() {
    on_slurm("study");
}
