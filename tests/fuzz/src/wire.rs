//! Messages, both directions.

use popgym_envs::Space;
use popgym_proto::{ActorMessage, EpisodeSpec, LearnerMessage, wire};
use prost::Message as _;

#[path = "../../../proto/tests/common/legal.rs"]
mod legal;

use legal::{assert_legal_actor, assert_legal_learner};

/// What a learner may expect of its episodes: classes, reals, and both; one step and many.
pub fn episode_specs() -> [EpisodeSpec; 5] {
    let free = |n| Space::uniform_box(n, f32::NEG_INFINITY, f32::INFINITY);
    let both = Space::Tuple(vec![Space::Discrete(3), Space::uniform_box(2, -1.0, 1.0), Space::Discrete(256)]);
    [
        EpisodeSpec { observation: Space::Discrete(4), action: Space::Discrete(4), max_steps: 51 },
        EpisodeSpec {
            observation: Space::MultiDiscrete(vec![2, 5]),
            action: Space::MultiDiscrete(vec![8, 8]),
            max_steps: 64,
        },
        EpisodeSpec { observation: Space::uniform_box(2, -1.0, 1.0), action: free(1), max_steps: 65_536 },
        EpisodeSpec {
            observation: both,
            action: Space::Tuple(vec![Space::MultiDiscrete(vec![2, 5]), free(1)]),
            max_steps: 20,
        },
        EpisodeSpec { observation: Space::Discrete(256), action: Space::Discrete(1), max_steps: 1 },
    ]
}

/// Whether a learner or an actor accepts the message.
pub fn wire(data: &[u8]) -> bool {
    let accepted = episode_specs().map(|spec| from_actor(data, &spec));
    accepted.contains(&true) | from_learner(data)
}

fn from_actor(data: &[u8], spec: &EpisodeSpec) -> bool {
    let receive = |data: &[u8]| {
        let message = wire::FromActor::decode(data).ok()?;
        ActorMessage::from_wire(message, spec).map_err(|error| error.to_string()).ok()
    };
    let Some(message) = receive(data) else { return false };
    assert_legal_actor(&message, spec);
    let sent = message.clone().into_wire().encode_to_vec();
    assert_eq!(receive(&sent), Some(message));
    true
}

fn from_learner(data: &[u8]) -> bool {
    let receive = |data: &[u8]| {
        let message = wire::FromLearner::decode(data).ok()?;
        LearnerMessage::from_wire(message).map_err(|error| error.to_string()).ok()
    };
    let Some(message) = receive(data) else { return false };
    assert_legal_learner(&message);
    let sent = message.into_wire().encode_to_vec();
    // Compared as bytes: options may hold NaN, which equals nothing.
    assert_eq!(receive(&sent).map(|message| message.into_wire().encode_to_vec()), Some(sent));
    true
}
