//! Recorded episodes.

use std::sync::LazyLock;

use popgym_envs::Registry;

#[path = "../../../envs/tests/common/recording.rs"]
mod reader;

static REGISTRY: LazyLock<Registry> = LazyLock::new(Registry::standard);

/// Whether the text is a recorded episode that is replayed to its end.
pub fn recording(data: &[u8]) -> bool {
    let Ok(line) = std::str::from_utf8(data) else { return false };
    let Ok((id, steps)) = reader::replay_line(&REGISTRY, 0, line) else { return false };
    let entry = REGISTRY.get(&id).expect("an id that was replayed");
    assert!((1..=entry.spec.max_steps as usize).contains(&steps), "{steps} steps of {id}");
    true
}
