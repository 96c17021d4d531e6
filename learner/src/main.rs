//! The `learner` binary.

use std::process::ExitCode;

fn main() -> ExitCode {
    popgym_learner::run(popgym_learner::Extensions::default(), std::env::args_os())
}
