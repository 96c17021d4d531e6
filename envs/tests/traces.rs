//! Episodes of the Python package, version 1.0.7, replayed to the last step.
//!
//! `POPGYM_TRACES` names another folder of recordings (`<id>.jsonl.gz`, one JSON object per line and episode); every
//! environment with a file there is replayed.

mod common;

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

use flate2::read::GzDecoder;
use popgym_envs::{Env, Leaf, Recorded, Registry, Slab, Space, Value};
use serde_json::Value as Json;

const REAL_TOLERANCE: f32 = 1e-5;

/// The parts of a recorded world that the episode draws step by step, in the order of drawing.
const STEP_DRAWS: [&str; 2] = ["uniform_draws", "observation_noise"];

fn folder() -> PathBuf {
    std::env::var_os("POPGYM_TRACES")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/traces"), PathBuf::from)
}

fn numbers(json: &Json, out: &mut Vec<f64>) {
    match json {
        Json::Array(parts) => parts.iter().for_each(|part| numbers(part, out)),
        number => out.push(number.as_f64().unwrap()),
    }
}

/// A recorded point of `space` (the leaves in order, whatever the nesting) as a one-row slab.
fn read(space: &Space, json: &Json) -> Slab {
    let mut values = Vec::new();
    numbers(json, &mut values);
    let leaves = space.leaves();
    assert_eq!(values.len(), leaves.len(), "{json}");
    let mut slab = Slab::new(space, 0);
    for (leaf, value) in leaves.iter().zip(values) {
        match leaf {
            Leaf::Discrete { .. } => {
                assert!(value.fract() == 0.0 && (0.0..256.0).contains(&value), "{value}");
                slab.discrete.push(value as u8);
            }
            Leaf::Real { .. } => slab.real.push(value as f32),
        }
    }
    slab
}

fn assert_close(found: Value<'_>, expected: &Slab, what: &str) {
    assert_eq!(found.discrete, expected.discrete, "{what}");
    assert_eq!(found.real.len(), expected.real.len(), "{what}");
    for (a, b) in found.real.iter().zip(&expected.real) {
        assert!((a - b).abs() <= REAL_TOLERANCE, "{what}: {:?} is not {:?}", found.real, expected.real);
    }
}

/// Replays one recorded episode; returns its number of steps.
fn replay(env: &mut dyn Env, trace: &Json, at: &str) -> usize {
    let spec = env.spec().clone();
    assert_eq!(trace["env"], spec.id.as_str(), "{at}");
    let mut world = trace["world"].clone();
    let mut drawn = Vec::new();
    for key in STEP_DRAWS {
        if let Some(list) = world.as_object_mut().unwrap().remove(key) {
            numbers(&list, &mut drawn);
        }
    }
    env.set_world(&world).unwrap_or_else(|error| panic!("{at}: {error}"));

    let list = |key: &str| trace[key].as_array().unwrap();
    let episode = common::play(env, &mut Recorded::new(drawn), |t, _, action| {
        let recorded = list("actions").get(t).unwrap_or_else(|| panic!("{at}: goes on after step {t}"));
        action.set(0, read(&spec.action, recorded).row(0));
    });

    let steps = episode.steps.len();
    for key in ["actions", "rewards"] {
        assert_eq!(list(key).len(), steps, "{at}: {key}");
    }
    for key in ["obs", "states"] {
        assert_eq!(list(key).len(), steps + 1, "{at}: {key}");
    }
    for t in 0..=steps {
        let at = format!("{at}, time {t}");
        assert_close(episode.observations.row(t), &read(&spec.observation, &list("obs")[t]), &at);
        assert_close(episode.states.row(t), &read(&spec.state, &list("states")[t]), &at);
    }
    for (t, step) in episode.steps.iter().enumerate() {
        let expected = list("rewards")[t].as_f64().unwrap();
        let difference = (step.reward - expected).abs();
        assert!(difference <= 1e-12 + 1e-9 * expected.abs(), "{at}, step {t}: {} is not {expected}", step.reward);
    }
    let last = episode.steps.last().unwrap();
    assert_eq!(trace["terminated"], last.terminated, "{at}");
    assert_eq!(trace["truncated"], last.truncated, "{at}");
    steps
}

#[test]
fn recorded_episodes_are_replayed() {
    let registry = Registry::standard();
    let (mut files, mut steps) = (0, 0);
    for entry in &registry {
        let path = folder().join(format!("{}.jsonl.gz", entry.id()));
        if !path.exists() {
            continue;
        }
        let file = std::fs::File::open(&path).unwrap();
        let mut env = entry.make();
        let mut episodes = 0;
        for (line, text) in BufReader::new(GzDecoder::new(file)).lines().enumerate() {
            let at = format!("{}, line {}", path.display(), line + 1);
            let trace: Json = serde_json::from_str(&text.unwrap()).unwrap_or_else(|error| panic!("{at}: {error}"));
            steps += replay(env.as_mut(), &trace, &at);
            episodes += 1;
        }
        assert!(episodes > 0, "{} holds no episode", path.display());
        files += 1;
    }
    assert!(files > 0, "no recording in {}", folder().display());
    println!("{files} files, {steps} steps");
}

/// The recordings that come with the crate leave no environment out.
#[test]
fn every_environment_has_a_recording() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/traces");
    for entry in &Registry::standard() {
        assert!(folder.join(format!("{}.jsonl.gz", entry.id())).exists(), "{}", entry.id());
    }
}
