//! The command line of the binary itself. (That this package has such a test makes cargo build the binary for
//! `cargo test`; the process-level tests need it.)

use std::process::{Command, Output};

fn actor(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_actor")).args(args).env_remove("POPGYM_LEARNER").output().unwrap()
}

#[test]
fn help_and_version_succeed() {
    let version = actor(&["--version"]);
    assert!(version.status.success());
    assert_eq!(String::from_utf8_lossy(&version.stdout).trim(), concat!("actor ", env!("CARGO_PKG_VERSION")));
    let help = actor(&["--help"]);
    assert!(help.status.success() && help.stderr.is_empty());
    assert!(String::from_utf8_lossy(&help.stdout).contains("--learner <URL>"));
}

#[test]
fn wrong_usage_exits_with_2() {
    for args in [&[][..], &["--learner", "https://box:1"], &["--learner", "box:1", "--slots", "0"], &["--lerner", "x"]]
    {
        let output = actor(args);
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(output.stdout.is_empty() && !output.stderr.is_empty(), "{args:?}");
    }
}
