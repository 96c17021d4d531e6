//! The command line of the binary itself. (That this package has such a test makes cargo build the binary for
//! `cargo test`; the process-level tests need it.)

use std::process::{Command, Output};

fn learner(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_learner")).args(args).output().unwrap()
}

#[test]
fn help_and_version_succeed() {
    let version = learner(&["--version"]);
    assert!(version.status.success());
    assert_eq!(String::from_utf8_lossy(&version.stdout).trim(), concat!("learner ", env!("CARGO_PKG_VERSION")));
    for command in ["train", "resume", "eval", "play", "watch", "compare", "list"] {
        let help = learner(&[command, "--help"]);
        assert!(help.status.success() && help.stderr.is_empty());
        assert!(String::from_utf8_lossy(&help.stdout).contains(&format!("Usage: learner {command}")));
    }
}

#[test]
fn wrong_usage_exits_with_2() {
    for args in [
        &[][..],
        &["trian"],
        &["train", "--sed", "1"],
        &["resume"],
        &["play"],
        &["watch"],
        &["compare", "one"],
        &["study", "report"],
        &["list", "everything"],
    ] {
        let output = learner(args);
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(output.stdout.is_empty() && !output.stderr.is_empty(), "{args:?}");
    }
}
