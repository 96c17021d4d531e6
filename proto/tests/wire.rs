//! What arrives is either exactly what was sent, or refused; nothing panics.

use bytes::Bytes;
use popgym_envs::space::{Leaf, Slab, Space};
use popgym_proto::{
    ActorMessage, Columns, Episode, EpisodeBatch, EpisodeBuilder, EpisodeSpec, Hello, LearnerMessage, Leases,
    OpenEpoch, PROTOCOL_VERSION, RunSpec, WeightSet, WireError, fingerprint, limits, wire,
};
use proptest::prelude::*;
use prost::Message;

#[path = "common/legal.rs"]
mod legal;

use legal::{assert_legal_actor, assert_legal_learner};

/// The spaces of RepeatPreviousEasy.
fn repeat_previous() -> EpisodeSpec {
    EpisodeSpec { observation: Space::Discrete(4), action: Space::MultiDiscrete(vec![4]), max_steps: 64 }
}

/// Discrete and real components everywhere.
fn mixed() -> EpisodeSpec {
    let observation = Space::Tuple(vec![Space::Discrete(3), Space::uniform_box(2, -1.0, 1.0), Space::Discrete(200)]);
    let free = Space::uniform_box(1, f32::NEG_INFINITY, f32::INFINITY);
    EpisodeSpec { observation, action: Space::Tuple(vec![Space::MultiDiscrete(vec![2, 5]), free]), max_steps: 20 }
}

fn columns(space: &Space, rows: usize, numbers: &mut impl Iterator<Item = u32>) -> Columns {
    let mut slab = Slab::new(space, 0);
    for _ in 0..rows {
        for leaf in space.leaves() {
            let number = numbers.next().unwrap_or(0);
            match leaf {
                Leaf::Discrete { classes } => slab.discrete.push((number % u32::from(classes)) as u8),
                Leaf::Real { .. } => slab.real.push(number as f32 / 1e9),
            }
        }
    }
    Columns { discrete: slab.discrete.into(), real: slab.real }
}

fn episode(spec: &EpisodeSpec, index: u64, steps: usize, seed: u32) -> Episode {
    let mut numbers = (0..).map(move |i: u32| (i ^ seed).wrapping_mul(2_654_435_761) >> 3);
    Episode {
        index,
        steps,
        observations: columns(&spec.observation, steps + 1, &mut numbers),
        actions: columns(&spec.action, steps, &mut numbers),
        rewards: (&mut numbers).take(steps).map(f64::from).collect(),
        log_probs: (&mut numbers).take(steps).map(|x| -(x as f32)).collect(),
        terminated: seed.is_multiple_of(2),
        truncated: !seed.is_multiple_of(2) || seed.is_multiple_of(3),
    }
}

fn batch_bytes(spec: &EpisodeSpec, sizes: &[usize], seed: u32) -> (EpisodeBatch, Vec<u8>) {
    let episodes =
        sizes.iter().enumerate().map(|(i, &steps)| episode(spec, i as u64, steps, seed + i as u32)).collect();
    let batch = EpisodeBatch { epoch: 7, version: 6, episodes };
    let bytes = ActorMessage::Episodes(batch.clone()).into_wire().encode_to_vec();
    (batch, bytes)
}

/// Decodes and checks as the learner does; what passes must be legal.
fn receive(bytes: &[u8], spec: &EpisodeSpec) -> Option<ActorMessage> {
    let message = ActorMessage::from_wire(wire::FromActor::decode(bytes).ok()?, spec).ok()?;
    assert_legal_actor(&message, spec);
    Some(message)
}

proptest! {
    #[test]
    fn episodes_survive_the_wire(sizes in prop::collection::vec(1..=20_usize, 1..5), seed in 0..1000_u32) {
        let spec = mixed();
        let (batch, bytes) = batch_bytes(&spec, &sizes, seed);
        prop_assert_eq!(receive(&bytes, &spec), Some(ActorMessage::Episodes(batch)));
    }

    #[test]
    fn flipped_bits_never_make_an_illegal_episode(seed in 0..1000_u32, flips in prop::collection::vec(any::<(prop::sample::Index, u8)>(), 1..4)) {
        let spec = mixed();
        let (_, mut bytes) = batch_bytes(&spec, &[3, 20, 1], seed);
        for (at, bit) in flips {
            let at = at.index(bytes.len());
            bytes[at] ^= 1 << (bit % 8);
        }
        receive(&bytes, &spec);
    }

    #[test]
    fn noise_never_panics(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        receive(&bytes, &mixed());
        let message = wire::FromLearner::decode(&bytes[..]);
        if let Ok(Ok(message)) = message.map(LearnerMessage::from_wire) {
            assert_legal_learner(&message);
        }
    }
}

#[test]
fn a_truncated_message_is_refused_or_legal() {
    let spec = mixed();
    let (batch, bytes) = batch_bytes(&spec, &[3, 20, 1], 5);
    for length in 0..bytes.len() {
        // Cut within the encoding of one message: never the whole batch.
        assert_ne!(receive(&bytes[..length], &spec), Some(ActorMessage::Episodes(batch.clone())), "at {length}");
    }
}

#[test]
fn an_episode_is_small() {
    let spec = repeat_previous();
    let (_, bytes) = batch_bytes(&spec, &[51], 1);
    let per_step = bytes.len() as f64 / 51.0;
    assert!(per_step < 40.0, "{per_step:.1} bytes a step");
}

#[test]
fn each_lie_is_named() {
    let spec = mixed();
    let good = episode(&spec, 3, 4, 2).into_wire();
    let refused = |change: &dyn Fn(&mut wire::Episode)| {
        let mut wire = good.clone();
        change(&mut wire);
        Episode::from_wire(wire, &spec).unwrap_err().to_string()
    };
    assert!(Episode::from_wire(good.clone(), &spec).is_ok());
    assert_eq!(refused(&|e| e.steps = 0), "steps is 0, allowed is 1..=20");
    assert_eq!(refused(&|e| e.steps = u32::MAX), "steps is 4294967295, allowed is 1..=20");
    assert_eq!(
        refused(&|e| e.rewards = Bytes::new()),
        "rewards has length 0, allowed is 4 rows of 1 values of 8 bytes"
    );
    assert_eq!(
        refused(&|e| e.observations_discrete = Bytes::from_static(&[0; 8])),
        "observations_discrete has length 8, allowed is 5 rows of 2 values of 1 bytes"
    );
    let classes = Bytes::from_static(&[0, 0, 0, 9, 0, 0, 0, 0]);
    assert_eq!(refused(&|e| e.actions_discrete = classes.clone()), "actions_discrete[3] is 9, allowed is 0..5");
    let nan: Vec<u8> = [0.0, f32::NAN, 0.0, 0.0].iter().flat_map(|x| x.to_le_bytes()).collect();
    assert_eq!(refused(&|e| e.log_probs = nan.clone().into()), "log_probs[1] is NaN, allowed is a finite number");
    let infinite: Vec<u8> = [0.0, 0.0, f64::INFINITY, 0.0].iter().flat_map(|x| x.to_le_bytes()).collect();
    assert_eq!(refused(&|e| e.rewards = infinite.clone().into()), "rewards[2] is inf, allowed is a finite number");
    let end = refused(&|e| (e.terminated, e.truncated) = (false, false));
    assert_eq!(end, "end is neither, allowed is terminated, truncated or both");
}

#[test]
fn what_is_no_episode_is_refused() {
    let spec = mixed();
    let refused = |episodes: Vec<Bytes>| {
        let bytes = wire::Episodes { epoch: 0, version: 0, episodes }.encode_to_vec();
        EpisodeBatch::from_wire(wire::Episodes::decode(&bytes[..]).unwrap(), &spec).unwrap_err()
    };
    // Two bytes each: counted before they are looked into.
    assert_eq!(
        refused(vec![Bytes::new(); 1 << 20]).to_string(),
        "episodes has length 1048576, allowed is 1..=4096 episodes"
    );
    assert_eq!(refused(vec![Bytes::new()]).to_string(), "steps is 0, allowed is 1..=20");
    let endless = refused(vec![Bytes::from_static(&[0x1a, 0xff, 0xff, 0xff, 0xff, 0x0f])]);
    assert_eq!(endless.reason(), "encoding");
    assert!(endless.to_string().starts_with("episode is no message: "), "{endless}");
}

#[test]
fn the_largest_message_has_room_for_all_that_an_actor_sends() {
    let one_step = |spec: &EpisodeSpec, index| Bytes::from(episode(spec, index, 1, 1).into_wire().encode_to_vec());
    for spec in [mixed(), repeat_previous()] {
        // All slots may end in one step, and all numbers be large.
        let episodes = (0..limits::MAX_EPISODES as u64).map(|i| one_step(&spec, u64::MAX - i)).collect();
        let batch = wire::Episodes { epoch: u64::MAX, version: u64::MAX, episodes };
        let columns = limits::MAX_EPISODES * episode(&spec, 0, 1, 1).wire_bytes();
        let message = wire::FromActor { message: Some(wire::from_actor::Message::Episodes(batch)) };
        let overhead = message.encoded_len() - columns;
        assert!(spec.largest_message() >= limits::EPISODES_MESSAGE_BYTES + overhead);
    }
    // One that is larger than messages are otherwise travels alone.
    let large = EpisodeSpec { max_steps: 40_000, observation: Space::uniform_box(50, 0.0, 1.0), ..mixed() };
    let alone = episode(&large, 0, 40_000, 1);
    assert!(alone.wire_bytes() > limits::EPISODES_MESSAGE_BYTES);
    let message =
        ActorMessage::Episodes(EpisodeBatch { epoch: u64::MAX, version: u64::MAX, episodes: vec![alone] }).into_wire();
    assert!(message.encoded_len() <= large.largest_message());
}

#[test]
fn names_can_be_shown_anywhere() {
    let spec = mixed();
    let named = |actor: &str| {
        let hello = wire::Hello { actor: actor.to_owned(), slots: 1, ..wire::Hello::default() };
        ActorMessage::from_wire(wire::FromActor { message: Some(wire::from_actor::Message::Hello(hello)) }, &spec)
    };
    for name in ["a", "höst-1", "\u{4e2d}\u{6587}", "it's\"a\\b", &"x".repeat(128)] {
        assert!(named(name).is_ok(), "{name}");
    }
    for name in ["", "a b", "a\nb", "\u{1b}[2J", "\u{202e}evil", "a\u{200b}", "\u{feff}", "\0", &"x".repeat(129)] {
        let told = named(name).unwrap_err().to_string();
        assert!(told.chars().all(|c| !c.is_control() && c != '\u{202e}'), "{told:?}");
        assert!(told.len() < 200, "{told}");
    }
}

#[test]
fn the_builder_gives_what_was_pushed() {
    let spec = mixed();
    let expected = episode(&spec, 9, 6, 4);
    let slab = |space: &Space, columns: &Columns| {
        let mut slab = Slab::new(space, 0);
        slab.discrete.extend_from_slice(&columns.discrete);
        slab.real.extend_from_slice(&columns.real);
        slab
    };
    let observations = slab(&spec.observation, &expected.observations);
    let actions = slab(&spec.action, &expected.actions);
    let mut builder = EpisodeBuilder::default();
    for _ in 0..2 {
        builder.begin(9, observations.row(0));
        for t in 0..6 {
            builder.push(actions.row(t), expected.log_probs[t], expected.rewards[t], observations.row(t + 1));
        }
        let built = builder.finish(expected.terminated, expected.truncated);
        assert_eq!(built, expected);
        assert!((built.total_return() - expected.rewards.iter().sum::<f64>()).abs() < 1e-9);
    }
}

fn run_spec() -> RunSpec {
    let table = |text: &str| toml::from_str(text).unwrap();
    RunSpec {
        run: "first".to_owned(),
        env: "popgym-RepeatPreviousEasy-v0".to_owned(),
        observability: popgym_envs::Observability::Partial,
        max_episode_steps: 64,
        memory: "gru".to_owned(),
        memory_options: table("hidden = 256\nlayers = 1"),
        policy_options: table("log_std_max = inf\nlog_std_min = -inf"),
        seed: u64::MAX,
        lag: 1,
        rows: 128,
        evaluation: false,
        greedy: false,
    }
}

#[test]
fn a_run_survives_the_wire() {
    assert_eq!(RunSpec::from_wire(run_spec().into_wire()).unwrap(), run_spec());
    let refused = |change: &dyn Fn(&mut wire::RunSpec)| {
        let mut wire = run_spec().into_wire();
        change(&mut wire);
        RunSpec::from_wire(wire).unwrap_err().to_string()
    };
    assert_eq!(refused(&|r| r.lag = 2), "lag is 2, allowed is 0..=1");
    assert_eq!(refused(&|r| r.rows = 3), "rows is 3, allowed is 16..=4096");
    assert_eq!(refused(&|r| r.run.clear()), "run has length 0, allowed is 1..=128 characters");
    assert_eq!(
        refused(&|r| r.env = "a\nb".to_owned()),
        "env is `a\\nb`, allowed is a name without white space and invisible characters"
    );
    assert!(refused(&|r| r.memory_options = "= 3".to_owned()).starts_with("memory_options is not TOML: "));
    assert_eq!(
        refused(&|r| r.observability = "all".to_owned()),
        "observability is `all`, allowed is partial, full-in-info, full, full-and-partial"
    );
    assert!(refused(&|r| r.policy_options = "[".repeat(100_000)).starts_with("policy_options has length 100000"));
    // Deep nesting must neither overflow the stack nor pass.
    assert!(refused(&|r| r.policy_options = format!("x = {}", "[".repeat(60_000))).contains("not TOML"));
    // What is longer when it is sent on.
    let floats = format!("x = [{}]", "1e300, ".repeat(1000));
    assert!(refused(&|r| r.policy_options = floats.clone()).starts_with("policy_options has length 30"));
}

#[test]
fn the_fingerprint_tells_every_field() {
    let base = fingerprint(&run_spec(), "env", "policy");
    assert_eq!(base, fingerprint(&run_spec(), "env", "policy"));
    let changes: [&dyn Fn(&mut RunSpec); 11] = [
        &|r| r.run.push('x'),
        &|r| r.env.push('x'),
        &|r| r.observability = popgym_envs::Observability::Full,
        &|r| r.max_episode_steps += 1,
        &|r| r.memory.push('x'),
        &|r| drop(r.memory_options.insert("hidden".to_owned(), 255.into())),
        &|r| drop(r.policy_options.remove("log_std_min")),
        &|r| r.seed = 0,
        &|r| r.lag = 0,
        &|r| r.evaluation = true,
        &|r| r.greedy = true,
    ];
    for (i, change) in changes.iter().enumerate() {
        let mut spec = run_spec();
        change(&mut spec);
        assert_ne!(base, fingerprint(&spec, "env", "policy"), "change {i}");
    }
    assert_ne!(base, fingerprint(&run_spec(), "env2", "policy"));
    assert_ne!(base, fingerprint(&run_spec(), "env", "policy2"));
}

#[test]
fn the_other_messages_survive_the_wire() {
    let spec = mixed();
    let hello = Hello {
        protocol_version: PROTOCOL_VERSION,
        build: "0.1.0".to_owned(),
        actor: "a-1".to_owned(),
        key: u64::MAX - 1,
        incarnation: 4,
        slots: 128,
        run: None,
    };
    for message in [ActorMessage::Hello(hello), ActorMessage::Ready([7; 32]), ActorMessage::Heartbeat] {
        assert_eq!(ActorMessage::from_wire(message.clone().into_wire(), &spec), Ok(message));
    }
    let weights = WeightSet::new(3, Bytes::from_static(b"\x02\0\0\0\0\0\0\0{}")).unwrap();
    for message in [
        LearnerMessage::Welcome(run_spec()),
        LearnerMessage::Epoch(OpenEpoch { epoch: 4, version: 3, weights: Some(weights) }),
        LearnerMessage::Epoch(OpenEpoch { epoch: 4, version: 3, weights: None }),
        LearnerMessage::Leases(Leases { epoch: 4, episodes: vec![0, 1, u64::MAX] }),
        LearnerMessage::Closed { epoch: 4 },
        LearnerMessage::Stop { reason: "complete".to_owned() },
        LearnerMessage::Heartbeat,
    ] {
        assert_eq!(LearnerMessage::from_wire(message.clone().into_wire()), Ok(message));
    }
    let empty = ActorMessage::from_wire(wire::FromActor { message: None }, &spec);
    assert_eq!(empty, Err(WireError::Missing { field: "message" }));
    assert!(WeightSet::new(0, Bytes::from_static(b"not weights")).is_err());
    let many = LearnerMessage::Leases(Leases { epoch: 0, episodes: vec![0; limits::MAX_LEASES + 1] });
    assert!(LearnerMessage::from_wire(many.into_wire()).is_err());
}

#[test]
fn an_episode_that_cannot_travel_is_known_before_the_run() {
    assert_eq!(mixed().check(), Ok(()));
    let huge = EpisodeSpec { observation: Space::uniform_box(1000, 0.0, 1.0), max_steps: 65_536, ..mixed() };
    assert!(huge.check().is_err());
}
