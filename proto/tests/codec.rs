//! Any message, whole, cut off, and with any one bit flipped: it survives as it is, or is refused, or is another legal one.

use bytes::Bytes;
use popgym_envs::Observability;
use popgym_envs::space::{Leaf, Space};
use popgym_proto::{
    ActorMessage, Columns, Episode, EpisodeBatch, EpisodeSpec, Hello, LearnerMessage, Leases, OpenEpoch, RunSpec,
    WeightSet, wire,
};
use proptest::collection::vec;
use proptest::prelude::*;
use prost::Message;

#[path = "common/legal.rs"]
mod legal;

use legal::{assert_legal_actor, assert_legal_learner};

/// Discrete and real components on both sides.
fn spec() -> EpisodeSpec {
    let observation = Space::Tuple(vec![Space::Discrete(3), Space::uniform_box(1, -1.0, 1.0), Space::Discrete(256)]);
    EpisodeSpec { observation, action: Space::MultiDiscrete(vec![2, 5]), max_steps: 6 }
}

fn name() -> impl Strategy<Value = String> {
    "[!-~éß→𝄞]{1,24}"
}

/// Numbers of every size.
fn finite64() -> impl Strategy<Value = f64> {
    any::<f64>().prop_filter("finite", |x| x.is_finite())
}

fn finite32() -> impl Strategy<Value = f32> {
    any::<f32>().prop_filter("finite", |x| x.is_finite())
}

fn columns(space: &Space, rows: usize) -> impl Strategy<Value = Columns> + use<> {
    let classes: Vec<u16> = space
        .leaves()
        .iter()
        .filter_map(|leaf| match leaf {
            Leaf::Discrete { classes } => Some(*classes),
            Leaf::Real { .. } => None,
        })
        .collect();
    let discrete: Vec<_> = (0..rows).flat_map(|_| classes.clone()).map(|classes| 0..=(classes - 1) as u8).collect();
    let real = vec(finite32(), rows * space.real_width());
    (discrete, real).prop_map(|(discrete, real)| Columns { discrete: discrete.into(), real })
}

fn episode() -> impl Strategy<Value = Episode> {
    (1..=6_usize).prop_flat_map(|steps| {
        let spec = spec();
        let ends = prop_oneof![Just((true, false)), Just((false, true)), Just((true, true))];
        (
            any::<u64>(),
            columns(&spec.observation, steps + 1),
            columns(&spec.action, steps),
            vec(finite64(), steps),
            vec(finite32(), steps),
            ends,
        )
            .prop_map(move |(index, observations, actions, rewards, log_probs, (terminated, truncated))| {
                Episode { index, steps, observations, actions, rewards, log_probs, terminated, truncated }
            })
    })
}

fn actor_message() -> impl Strategy<Value = ActorMessage> {
    let incarnation = (any::<u64>(), any::<u64>());
    let hello = (any::<u32>(), prop_oneof![Just(String::new()), name()], name(), incarnation, 1..=4096_u32);
    let hello = (hello, proptest::option::of(name())).prop_map(
        |((protocol_version, build, actor, (key, incarnation), slots), run)| {
            ActorMessage::Hello(Hello { protocol_version, build, actor, key, incarnation, slots, run })
        },
    );
    let batch = (any::<u64>(), any::<u64>(), vec(episode(), 1..4))
        .prop_map(|(epoch, version, episodes)| ActorMessage::Episodes(EpisodeBatch { epoch, version, episodes }));
    prop_oneof![hello, any::<[u8; 32]>().prop_map(ActorMessage::Ready), batch, Just(ActorMessage::Heartbeat)]
}

/// Any TOML but NaN, which equals nothing.
fn options() -> impl Strategy<Value = toml::Table> {
    let simple = prop_oneof![
        any::<i64>().prop_map(toml::Value::Integer),
        finite64().prop_map(toml::Value::Float),
        Just(toml::Value::Float(f64::INFINITY)),
        any::<bool>().prop_map(toml::Value::Boolean),
        any::<String>().prop_map(toml::Value::String),
        Just(toml::Value::Datetime("1979-05-27T07:32:00.5-07:00".parse().unwrap())),
    ];
    let value = simple.prop_recursive(3, 12, 4, |value| {
        prop_oneof![
            vec(value.clone(), 0..4).prop_map(toml::Value::Array),
            vec((any::<String>(), value), 0..4).prop_map(|pairs| toml::Value::Table(pairs.into_iter().collect())),
        ]
    });
    vec((any::<String>(), value), 0..4).prop_map(|pairs| pairs.into_iter().collect())
}

fn run_spec() -> impl Strategy<Value = RunSpec> {
    let names = (name(), name(), name());
    let numbers = (1..=65_536_u32, any::<u64>(), 0..=1_u32, 16..=4096_u32, any::<bool>(), any::<bool>());
    let levels = proptest::sample::select(Observability::ALL.to_vec());
    (names, numbers, levels, options(), options()).prop_map(
        |((run, env, memory), numbers, observability, memory_options, policy_options)| {
            let (max_episode_steps, seed, lag, rows, evaluation, greedy) = numbers;
            RunSpec {
                run,
                env,
                observability,
                max_episode_steps,
                memory,
                memory_options,
                policy_options,
                seed,
                lag,
                rows,
                evaluation,
                greedy,
            }
        },
    )
}

/// Three numbers called `a`, as safetensors.
fn weights(numbers: [f32; 3]) -> Bytes {
    let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
    let view = safetensors::tensor::TensorView::new(safetensors::Dtype::F32, vec![3], &bytes).unwrap();
    safetensors::serialize([("a", view)], None).unwrap().into()
}

fn learner_message() -> impl Strategy<Value = LearnerMessage> {
    let epoch = (any::<u64>(), any::<u64>(), proptest::option::of(any::<[f32; 3]>()));
    let epoch = epoch.prop_map(|(epoch, version, numbers)| {
        let weights = numbers.map(|numbers| WeightSet::new(version, weights(numbers)).unwrap());
        LearnerMessage::Epoch(OpenEpoch { epoch, version, weights })
    });
    let leases = (any::<u64>(), vec(any::<u64>(), 0..6));
    prop_oneof![
        run_spec().prop_map(LearnerMessage::Welcome),
        epoch,
        leases.prop_map(|(epoch, episodes)| LearnerMessage::Leases(Leases { epoch, episodes })),
        any::<u64>().prop_map(|epoch| LearnerMessage::Closed { epoch }),
        any::<String>().prop_map(|reason| LearnerMessage::Stop { reason }),
        Just(LearnerMessage::Heartbeat),
    ]
}

/// Receives as the learner does.
fn from_actor(bytes: &[u8]) -> Option<ActorMessage> {
    let message = ActorMessage::from_wire(wire::FromActor::decode(bytes).ok()?, &spec()).ok()?;
    assert_legal_actor(&message, &spec());
    Some(message)
}

/// Receives as an actor does.
fn from_learner(bytes: &[u8]) -> Option<LearnerMessage> {
    let message = LearnerMessage::from_wire(wire::FromLearner::decode(bytes).ok()?).ok()?;
    assert_legal_learner(&message);
    Some(message)
}

/// Calls `receive` with every beginning of `bytes`, and with `bytes` but for one bit, for every bit.
fn damage<T>(mut bytes: Vec<u8>, receive: impl Fn(&[u8]) -> T) {
    for length in 0..bytes.len() {
        receive(&bytes[..length]);
    }
    for at in 0..bytes.len() {
        for bit in 0..8 {
            bytes[at] ^= 1 << bit;
            receive(&bytes);
            bytes[at] ^= 1 << bit;
        }
    }
}

proptest! {
    #[test]
    fn an_actors_message_survives(message in actor_message()) {
        let bytes = message.clone().into_wire().encode_to_vec();
        prop_assert_eq!(from_actor(&bytes), Some(message));
    }

    #[test]
    fn a_learners_message_survives(message in learner_message()) {
        let bytes = message.clone().into_wire().encode_to_vec();
        prop_assert_eq!(from_learner(&bytes), Some(message));
    }
}

proptest! {
    // Each is hundreds or thousands of messages.
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn an_actors_message_damaged_is_refused_or_legal(message in actor_message()) {
        damage(message.into_wire().encode_to_vec(), from_actor);
    }

    #[test]
    fn a_learners_message_damaged_is_refused_or_legal(message in learner_message()) {
        damage(message.into_wire().encode_to_vec(), from_learner);
    }
}
