//! The images and the compose file in a Docker engine, by `tests/containers.sh`, where it is asked for (`make containers`):
//! images take long to build. Where no engine runs, the test says so and is counted as ignored.

use std::process::{Command, ExitCode};

use libtest_mimic::{Arguments, Trial};

const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/containers.sh");

/// The script's status for what cannot run here.
const SKIPPED: i32 = 77;

/// Why the script cannot run here, if it cannot.
fn obstacle() -> Option<String> {
    if std::env::var_os("POPGYM_CONTAINERS").is_none_or(|value| value != "1") {
        return Some("it builds images for many minutes; `make containers` runs it".to_owned());
    }
    let output = Command::new(SCRIPT).arg("check").output().expect("the script starts");
    let said = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    match output.status.code() {
        Some(0) => None,
        Some(SKIPPED) => Some(said),
        _ => panic!("{SCRIPT} check: {}, {said}{}", output.status, String::from_utf8_lossy(&output.stderr)),
    }
}

fn main() -> ExitCode {
    let args = Arguments::from_args();
    let obstacle = obstacle();
    if let Some(obstacle) = &obstacle {
        eprintln!("skipped: {obstacle}");
    }
    let run = || {
        let status = Command::new(SCRIPT).status()?;
        if status.success() { Ok(()) } else { Err(format!("{SCRIPT}: {status}").into()) }
    };
    let test = Trial::test("a_run_in_containers_withstands_what_befalls_them", run);
    libtest_mimic::run(&args, vec![test.with_ignored_flag(obstacle.is_some())]).exit_code()
}
