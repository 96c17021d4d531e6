//! A trainer with an environment and a memory of one's own: `custom train --env TMaze --memory decay`, and every other
//! command of `learner`.
//!
//! One program is both: called as `custom actor ...` it is an actor that knows the same environments and memories.

mod decay;
mod t_maze;

use std::ffi::OsString;
use std::process::ExitCode;

use popgym_envs::Registry;
use popgym_learner::Extensions;
use popgym_learner::local_actors::THIS_PROGRAM;

fn main() -> ExitCode {
    let mut envs = Registry::standard();
    for corridor in [10, 50] {
        let name = if corridor == 10 { "TMaze".to_owned() } else { format!("TMaze{corridor}") };
        let id = name.clone();
        if let Err(error) = envs.register(&name, &[], "custom", move || t_maze::TMaze::new(&id, corridor)) {
            eprintln!("error: {error}");
            return ExitCode::FAILURE;
        }
    }
    let mut memories = popgym_models::memory::Registry::standard();
    memories.register::<decay::Decay>();
    let mut arguments: Vec<OsString> = std::env::args_os().collect();
    if arguments.get(1).is_some_and(|first| first == "actor") {
        arguments.remove(1);
        return popgym_actor::run(envs, memories, arguments);
    }
    let actor_command = vec![THIS_PROGRAM.to_owned(), "actor".to_owned()];
    popgym_learner::run(Extensions { envs, memories, actor_command, ..Extensions::default() }, arguments)
}
