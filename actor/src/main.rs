//! The `actor` binary: popgym-rs's own environments and memories, and nothing else.

fn main() -> std::process::ExitCode {
    popgym_actor::run(
        popgym_envs::Registry::standard(),
        popgym_models::memory::Registry::standard(),
        std::env::args_os(),
    )
}
