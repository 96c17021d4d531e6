//! An episode is the same whoever samples it, beside whichever others.

use std::collections::BTreeMap;

use popgym_actor::{Rollout, invariance};
use popgym_envs::Value;
use popgym_models::memory;
use popgym_proto::{Columns, Episode, EpisodeSpec, RunSpec};
use tch::Tensor;

fn spec(env: &str, memory: &str) -> RunSpec {
    let memories = memory::Registry::standard();
    RunSpec {
        run: "test".to_owned(),
        env: popgym_envs::Registry::standard().canonical(env).unwrap().to_owned(),
        observability: popgym_envs::Observability::Partial,
        max_episode_steps: 1024,
        memory: memory.to_owned(),
        memory_options: memories.get(memory).unwrap().resolve(&toml::Table::new()).unwrap(),
        policy_options: toml::from_str("log_std_min = -inf\nlog_std_max = inf").unwrap(),
        seed: 7,
        lag: 0,
        rows: 32,
        evaluation: false,
        greedy: false,
    }
}

fn rollout(spec: RunSpec, slots: u32, weights: Option<&[u8]>) -> Rollout {
    tch::set_num_threads(1);
    let (envs, memories) = (popgym_envs::Registry::standard(), memory::Registry::standard());
    let mut rollout = Rollout::new(&envs, &memories, spec, slots).unwrap();
    let own = rollout.policy().to_bytes();
    rollout.open(3, 2, Some(weights.unwrap_or(&own))).unwrap();
    rollout
}

/// Episodes by index. Leases come `chunk` at a time.
fn play(rollout: &mut Rollout, indices: &[u64], chunk: usize) -> BTreeMap<u64, Episode> {
    let (mut finished, mut chunks) = (Vec::new(), indices.chunks(chunk));
    let mut steps = 0;
    loop {
        if rollout.waiting() == 0
            && let Some(chunk) = chunks.next()
        {
            rollout.lease(chunk.iter().copied());
        }
        if rollout.is_idle() {
            break;
        }
        rollout.step(&mut finished).unwrap();
        steps += 1;
        assert!(steps < 100_000, "episodes end");
    }
    assert_eq!(finished.len(), indices.len());
    finished.into_iter().map(|episode| (episode.index, episode)).collect()
}

#[test]
fn an_episode_does_not_depend_on_slots_neighbours_or_order() {
    let indices: Vec<u64> = (0..60).collect();
    let shuffled: Vec<u64> = (0..60).map(|i| i * 7 % 60).collect();
    for (env, memory) in
        [("PositionOnlyCartPoleEasy", "gru"), ("RepeatPreviousEasy", "gru"), ("PositionOnlyPendulumEasy", "mlp")]
    {
        let spec = spec(env, memory);
        let mut reference = rollout(spec.clone(), 20, None);
        let weights = reference.policy().to_bytes();
        let expected = play(&mut reference, &indices, 60);
        for (slots, chunk, indices) in [(1, 60, &indices), (3, 1, &indices), (64, 60, &shuffled), (33, 10, &shuffled)] {
            let mut other = rollout(spec.clone(), slots, Some(&weights));
            assert!(play(&mut other, indices, chunk) == expected, "{env}, {memory}, {slots} slots, {chunk} at a time");
        }
    }
}

#[test]
fn episodes_are_legal_and_end_at_the_limit() {
    for env in ["PositionOnlyPendulumEasy", "BattleshipEasy", "RepeatFirstEasy"] {
        let spec = RunSpec { max_episode_steps: 9, ..spec(env, "gru") };
        let mut rollout = rollout(spec, 16, None);
        let episodes = EpisodeSpec {
            observation: popgym_envs::Registry::standard().get(env).unwrap().spec.observation.clone(),
            action: rollout.policy().distribution().stored_space(),
            max_steps: 9,
        };
        for (_, episode) in play(&mut rollout, &(0..20).collect::<Vec<_>>(), 20) {
            assert!(episode.steps < 9 || episode.truncated);
            assert_eq!(Episode::from_wire(episode.clone().into_wire(), &episodes).unwrap(), episode);
        }
    }
}

#[test]
fn streams_differ_by_epoch_and_purpose() {
    let training = spec("RepeatPreviousEasy", "gru");
    let mut first = rollout(training.clone(), 16, None);
    let weights = first.policy().to_bytes();
    let expected = play(&mut first, &[0], 1);
    let evaluation = RunSpec { evaluation: true, ..training };
    assert!(play(&mut rollout(evaluation, 16, Some(&weights)), &[0], 1) != expected);
    first.open(4, 2, None).unwrap();
    assert!(play(&mut first, &[0], 1) != expected);
    first.open(3, 2, None).unwrap();
    assert!(play(&mut first, &[0], 1) == expected);
}

#[test]
fn a_greedy_policy_takes_the_likeliest_actions() {
    let drawn = RunSpec { evaluation: true, ..spec("RepeatPreviousEasy", "gru") };
    let mut first = rollout(drawn.clone(), 16, None);
    let weights = first.policy().to_bytes();
    let mut greedy = rollout(RunSpec { greedy: true, ..drawn }, 16, Some(&weights));
    let played = play(&mut greedy, &[0, 1, 2], 3);
    assert!(played != play(&mut first, &[0, 1, 2], 3));
    for episode in played.values() {
        assert!(episode.log_probs.iter().all(|&log_prob| log_prob.to_bits() == 0));
        let policy = greedy.policy();
        let mut state = policy.initial_state(1);
        for t in 0..episode.steps {
            let class = |columns: &Columns, t: usize| columns.discrete[t];
            let mut features = vec![0.0; policy.encoder().width()];
            let seen = [class(&episode.observations, t)];
            let previous = [if t > 0 { class(&episode.actions, t - 1) } else { 0 }];
            let value = |discrete| Value { discrete, real: &[] };
            policy.encoder().encode(value(&seen), value(&previous), t == 0, &mut features);
            let features = Tensor::from_slice(&features).view([1, -1]);
            let (params, next) = policy.act(&features, &state);
            let params = Vec::<f32>::try_from(params.view(-1)).unwrap();
            let action = class(&episode.actions, t);
            let most = params.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            assert!(most - params[action as usize] < 1e-6, "step {t}: {params:?}, took {action}");
            state = next;
        }
    }
}

#[test]
fn an_epoch_that_is_over_leaves_nothing_behind() {
    let spec = spec("RepeatPreviousEasy", "gru");
    let mut rollout = rollout(spec, 8, None);
    rollout.lease(0..20);
    rollout.step(&mut Vec::new()).unwrap();
    assert_eq!((rollout.live(), rollout.waiting()), (8, 12));
    rollout.open(4, 2, None).unwrap();
    assert!(rollout.is_idle());
    assert_eq!(play(&mut rollout, &[5, 6], 2).keys().copied().collect::<Vec<_>>(), [5, 6]);
    let missing = rollout.open(5, 3, None).unwrap_err().to_string();
    assert!(missing.contains("version 3"), "{missing}");
    assert!(rollout.open(5, 3, Some(b"nonsense")).is_err());
}

#[test]
fn rows_are_independent_here() {
    let rollout = rollout(spec("RepeatPreviousEasy", "gru"), 8, None);
    assert!(invariance::rows_are_independent(rollout.policy(), 128));
}
