//! What a legal message is. Written without a look at the code under test.

use popgym_envs::space::{Leaf, Space};
use popgym_proto::{ActorMessage, Columns, Episode, EpisodeSpec, LearnerMessage, limits};

/// An actor's message to a learner of such episodes.
pub(crate) fn assert_legal_actor(message: &ActorMessage, spec: &EpisodeSpec) {
    match message {
        ActorMessage::Hello(hello) => {
            assert!((1..=4096).contains(&hello.slots));
            assert_name(&hello.actor);
            hello.run.iter().for_each(|run| assert_name(run));
            assert!(hello.build.is_empty() || is_name(&hello.build));
        }
        ActorMessage::Episodes(batch) => {
            assert!((1..=4096).contains(&batch.episodes.len()));
            batch.episodes.iter().for_each(|episode| assert_legal_episode(episode, spec));
        }
        ActorMessage::Ready(_) | ActorMessage::Heartbeat => {}
    }
}

/// A learner's message.
pub(crate) fn assert_legal_learner(message: &LearnerMessage) {
    match message {
        LearnerMessage::Welcome(run) => {
            for name in [&run.run, &run.env, &run.memory] {
                assert_name(name);
            }
            assert!(run.lag <= 1 && (16..=4096).contains(&run.rows) && (1..=65_536).contains(&run.max_episode_steps));
            assert_eq!(run.check(), Ok(()), "what is accepted can be sent on");
        }
        LearnerMessage::Epoch(open) => {
            let weights = open.weights.as_ref();
            assert!(
                weights.is_none_or(|set| set.version == open.version && set.bytes.len() < limits::MAX_MESSAGE_BYTES)
            );
            assert!(weights.is_none_or(|set| safetensors::SafeTensors::deserialize(&set.bytes).is_ok()));
        }
        LearnerMessage::Leases(leases) => assert!(leases.episodes.len() <= 8192),
        LearnerMessage::Stop { reason } => assert!(reason.chars().count() <= 1024),
        LearnerMessage::Closed { .. } | LearnerMessage::Heartbeat => {}
    }
}

fn is_name(text: &str) -> bool {
    (1..=128).contains(&text.chars().count()) && !text.chars().any(|c| c.is_whitespace() || c.is_control())
}

#[track_caller]
fn assert_name(text: &str) {
    assert!(is_name(text), "{text:?}");
}

fn assert_legal_episode(episode: &Episode, spec: &EpisodeSpec) {
    assert!(episode.steps >= 1 && episode.steps <= spec.max_steps as usize);
    assert!(episode.terminated || episode.truncated);
    assert_eq!(episode.rewards.len(), episode.steps);
    assert_eq!(episode.log_probs.len(), episode.steps);
    assert!(episode.rewards.iter().all(|x| x.is_finite()));
    assert!(episode.log_probs.iter().all(|x| x.is_finite()));
    assert_points(&episode.observations, &spec.observation, episode.steps + 1);
    assert_points(&episode.actions, &spec.action, episode.steps);
}

/// `rows` points of `space`, its real components unbounded but finite.
fn assert_points(columns: &Columns, space: &Space, rows: usize) {
    let (mut discrete, mut real) = (columns.discrete.iter(), columns.real.iter());
    for _ in 0..rows {
        for leaf in space.leaves() {
            match leaf {
                Leaf::Discrete { classes } => assert!(u16::from(*discrete.next().unwrap()) < classes),
                Leaf::Real { .. } => assert!(real.next().unwrap().is_finite()),
            }
        }
    }
    assert!(discrete.next().is_none() && real.next().is_none());
}
