//! Episodes of the Python package, version 1.0.7, replayed to the last step.
//!
//! `POPGYM_TRACES=/some/folder cargo test --release -p popgym-envs --test replay` replays every `*.jsonl.gz` of another
//! folder (one JSON object per line and episode) and says how much of each environment matched. A relative path starts
//! at the repository's root.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};

use flate2::read::GzDecoder;
use popgym_envs::{Draws, Env, Leaf, Registry, Slab, Space, Value};
use serde::Deserialize;
use serde_json::Value as Json;

const REAL_TOLERANCE: f32 = 1e-5;

/// The parts of a recorded world that the episode draws step by step, in the order of drawing.
const STEP_DRAWS: [&str; 2] = ["uniform_draws", "observation_noise"];

/// One line of a recording: an episode of `T` steps.
#[derive(Deserialize)]
struct Trace {
    env: String,
    world: serde_json::Map<String, Json>,
    /// `T + 1` points of the observation space.
    obs: Vec<Json>,
    /// `T + 1` points of the state space.
    states: Vec<Json>,
    /// `T` points of the action space.
    actions: Vec<Json>,
    /// `T` numbers.
    rewards: Vec<f64>,
    /// Of the last step.
    terminated: bool,
    /// Of the last step.
    truncated: bool,
}

/// Draws from a recording, and remembers if it was too short.
struct Tape {
    left: std::vec::IntoIter<f64>,
    short: bool,
}

impl Draws for Tape {
    fn uniform(&mut self) -> f64 {
        self.left.next().unwrap_or_else(|| {
            self.short = true;
            0.0
        })
    }

    fn normal_pair(&mut self, _sigma: f64) -> [f64; 2] {
        [self.uniform(), self.uniform()]
    }
}

fn numbers(json: &Json, out: &mut Vec<f64>) -> Result<(), String> {
    match json {
        Json::Array(parts) => parts.iter().try_for_each(|part| numbers(part, out)),
        Json::Number(number) => {
            out.push(number.as_f64().ok_or_else(|| format!("{number} is no f64"))?);
            Ok(())
        }
        other => Err(format!("{other} where a number should be")),
    }
}

/// A recorded point of `space` (the leaves in order, whatever the nesting) as a one-row slab.
fn read(space: &Space, json: &Json) -> Result<Slab, String> {
    let (mut values, leaves) = (Vec::new(), space.leaves());
    numbers(json, &mut values)?;
    if values.len() != leaves.len() {
        return Err(format!("{} numbers where {} should be: {json}", values.len(), leaves.len()));
    }
    let mut slab = Slab::new(space, 0);
    for (leaf, value) in leaves.iter().zip(values) {
        match *leaf {
            Leaf::Real { .. } => slab.real.push(value as f32),
            Leaf::Discrete { classes } if value.fract() == 0.0 && (0.0..f64::from(classes)).contains(&value) => {
                slab.discrete.push(value as u8);
            }
            Leaf::Discrete { classes } => return Err(format!("{value} where a class of 0..{classes} should be")),
        }
    }
    Ok(slab)
}

/// Compares a point with a recorded one: classes exactly, reals within the tolerance.
fn compare(what: &str, space: &Space, recorded: &Json, found: Value<'_>) -> Result<(), String> {
    let slab = read(space, recorded).map_err(|reason| format!("{what}: {reason}"))?;
    let expected = slab.row(0);
    let near = expected.real.iter().zip(found.real).all(|(a, b)| (a - b).abs() <= REAL_TOLERANCE);
    if expected.discrete == found.discrete && expected.real.len() == found.real.len() && near {
        return Ok(());
    }
    Err(format!("{what}: expected {expected:?}, found {found:?}"))
}

/// Replays one recorded episode; gives its number of steps, or the first difference.
fn replay(env: &mut dyn Env, trace: &Trace) -> Result<usize, String> {
    let length = trace.actions.len();
    for (name, found, expected) in [
        ("rewards", trace.rewards.len(), length),
        ("obs", trace.obs.len(), length + 1),
        ("states", trace.states.len(), length + 1),
    ] {
        if found != expected {
            return Err(format!("{found} {name} with {length} actions, expected {expected}"));
        }
    }
    let (mut world, mut drawn) = (trace.world.clone(), Vec::new());
    for key in STEP_DRAWS {
        world.remove(key).map_or(Ok(()), |list| numbers(&list, &mut drawn))?;
    }
    env.set_world(&Json::Object(world)).map_err(|reason| format!("world: {reason}"))?;

    let spec = env.spec().clone();
    let (mut observation, mut state) = (Slab::new(&spec.observation, 1), Slab::new(&spec.state, 1));
    let mut tape = Tape { left: drawn.into_iter(), short: false };
    env.begin(&mut tape, observation.row_mut(0));
    for t in 0..=length {
        let at = |reason: String| format!("step {t}, {reason}");
        if t > 0 {
            let action = read(&spec.action, &trace.actions[t - 1]).map_err(|reason| at(format!("action: {reason}")))?;
            let step = env.step(action.row(0), &mut tape, observation.row_mut(0));
            let expected = trace.rewards[t - 1];
            let near = (step.reward - expected).abs() <= 1e-12 + 1e-9 * expected.abs();
            if !near {
                return Err(at(format!("reward: expected {expected}, found {}", step.reward)));
            }
            if step.done() && t < length {
                return Err(at(format!("length: expected {length} steps, found {t}")));
            }
            let expected = (t == length && trace.terminated, t == length && trace.truncated);
            if (step.terminated, step.truncated) != expected {
                let found = (step.terminated, step.truncated);
                return Err(at(format!("flags (terminated, truncated): expected {expected:?}, found {found:?}")));
            }
        }
        env.state(state.row_mut(0));
        compare("observation", &spec.observation, &trace.obs[t], observation.row(0)).map_err(at)?;
        compare("state", &spec.state, &trace.states[t], state.row(0)).map_err(at)?;
    }
    if !(trace.terminated || trace.truncated) {
        return Err(format!("step {length}: the recorded episode does not end"));
    }
    let left = tape.left.len();
    if tape.short || left > 0 {
        let much =
            if tape.short { "fewer draws than the episode makes".to_owned() } else { format!("{left} too many") };
        return Err(format!("the world holds {much}"));
    }
    Ok(length)
}

/// Replays one line of a recording; gives the id and the number of steps.
fn replay_line(registry: &Registry, episode: usize, line: &str) -> Result<(String, usize), String> {
    let trace: Trace = serde_json::from_str(line).map_err(|error| error.to_string())?;
    let entry = registry.get(&trace.env).map_err(|error| error.to_string())?;
    let steps = replay(entry.make().as_mut(), &trace);
    steps
        .map(|steps| (entry.id().to_owned(), steps))
        .map_err(|reason| format!("{}, episode {episode}, {reason}", entry.id()))
}

/// Replays every recording of a folder; gives episodes and steps by id.
fn replay_folder(registry: &Registry, folder: &Path) -> Result<BTreeMap<String, (usize, usize)>, String> {
    let unreadable = |error: std::io::Error| format!("{}: {error}", folder.display());
    let files: Result<Vec<PathBuf>, _> =
        std::fs::read_dir(folder).map_err(unreadable)?.map(|entry| entry.map(|entry| entry.path())).collect();
    let mut files = files.map_err(unreadable)?;
    files.retain(|path| path.to_string_lossy().ends_with(".jsonl.gz"));
    files.sort();
    if files.is_empty() {
        return Err(format!("{}: no *.jsonl.gz there", folder.display()));
    }
    let mut matched = BTreeMap::new();
    for path in files {
        let file = std::fs::File::open(&path).map_err(|error| format!("{}: {error}", path.display()))?;
        let mut episodes = 0;
        for line in BufReader::new(GzDecoder::new(file)).lines() {
            let at = |reason: String| format!("{}, line {}: {reason}", path.display(), episodes + 1);
            let line = line.map_err(|error| at(error.to_string()))?;
            let (id, steps) = replay_line(registry, episodes, &line).map_err(at)?;
            let sum: &mut (usize, usize) = matched.entry(id).or_default();
            *sum = (sum.0 + 1, sum.1 + steps);
            episodes += 1;
        }
        if episodes == 0 {
            return Err(format!("{}: no episode there", path.display()));
        }
    }
    Ok(matched)
}

fn own_recordings() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/traces")
}

#[test]
fn recorded_episodes_are_replayed() {
    let folder = std::env::var_os("POPGYM_TRACES")
        .map_or_else(own_recordings, |folder| Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(folder));
    let matched = replay_folder(&Registry::standard(), &folder).unwrap_or_else(|reason| panic!("{reason}"));
    let total = matched.values().fold((0, 0), |sum, part| (sum.0 + part.0, sum.1 + part.1));
    let row = |id: &str, episodes: &str, steps: &str| format!("{id:<46}{episodes:>10}{steps:>10}\n");
    let head = format!("\nreplayed from {}\n", folder.display());
    let table: String = [head, row("id", "episodes", "steps")]
        .into_iter()
        .chain(
            matched
                .iter()
                .chain([(&"all of them match".to_owned(), &total)])
                .map(|(id, (episodes, steps))| row(id, &episodes.to_string(), &steps.to_string())),
        )
        .collect();
    // Not `eprint!`, which the test harness keeps to itself.
    std::io::stderr().write_all(table.as_bytes()).unwrap();
}

/// The recordings that come with the crate leave no environment out.
#[test]
fn every_environment_has_a_recording() {
    let matched = replay_folder(&Registry::standard(), &own_recordings()).unwrap();
    for entry in &Registry::standard() {
        assert!(matched.contains_key(entry.id()), "{}", entry.id());
    }
}

/// The first recorded episode of an environment.
fn first_episode(id: &str) -> Json {
    let file = std::fs::File::open(own_recordings().join(format!("{id}.jsonl.gz"))).unwrap();
    serde_json::from_str(&BufReader::new(GzDecoder::new(file)).lines().next().unwrap().unwrap()).unwrap()
}

/// Whatever is changed in a recording is found, and said where it is.
#[test]
fn differences_are_found() {
    let registry = Registry::standard();
    let battleship = first_episode("popgym-BattleshipEasy-v0");
    let noisy = first_episode("popgym-NoisyPositionOnlyCartPoleEasy-v0");
    let check = |base: &Json, expected: &str, change: &dyn Fn(&mut Json)| {
        let mut changed = base.clone();
        change(&mut changed);
        let reason = replay_line(&registry, 7, &changed.to_string()).expect_err(expected);
        assert!(reason.contains(expected), "{reason}");
    };
    let pop = |json: &mut Json| drop(json.as_array_mut().unwrap().pop());
    replay_line(&registry, 7, &noisy.to_string()).unwrap();
    let (length, ended) = (noisy["actions"].as_array().unwrap().len(), noisy["terminated"] == true);

    check(&noisy, "popgym-NoisyPositionOnlyCartPoleEasy-v0, episode 7, step 3, observation: expected", &|json| {
        json["obs"][3][1] = (json["obs"][3][1].as_f64().unwrap() + 2e-5).into();
    });
    check(&noisy, "step 4, state: expected", &|json| {
        json["states"][4][1] = (json["states"][4][1].as_f64().unwrap() - 2e-5).into();
    });
    check(&noisy, "step 5, reward: expected 0.00500001, found 0.005", &|json| {
        json["rewards"][4] = 0.005_000_01.into();
    });
    check(&noisy, "flags (terminated, truncated): expected", &|json| json["terminated"] = (!ended).into());
    check(&noisy, "the world holds fewer draws", &|json| {
        let noise = json["world"]["observation_noise"].as_array_mut().unwrap();
        noise.pop();
        // Without noise the last observation is the state itself.
        let state = json["states"][length].clone();
        json["obs"][length] = Json::Array(vec![state[0].clone(), state[2].clone()]);
    });
    check(&noisy, "the world holds 2 too many", &|json| {
        json["world"]["observation_noise"].as_array_mut().unwrap().push(serde_json::json!([0.1, 0.1]));
    });
    check(&noisy, "world: unknown field `wind`", &|json| json["world"]["wind"] = 1.into());
    check(&noisy, "missing field `rewards`", &|json| drop(json.as_object_mut().unwrap().remove("rewards")));
    check(&noisy, "unknown environment `popgym-Unheard-v0`", &|json| json["env"] = "popgym-Unheard-v0".into());
    check(&noisy, "step 2, observation: \"here\" where a number should be", &|json| json["obs"][2][0] = "here".into());

    check(&battleship, "step 2, observation: expected", &|json| {
        json["obs"][2] = (1 - json["obs"][2].as_i64().unwrap()).into();
    });
    check(&battleship, "step 2, observation: 2 where a class of 0..2 should be", &|json| json["obs"][2] = 2.into());
    check(&battleship, "step 1, action: 3 numbers where 2 should be", &|json| {
        json["actions"][0].as_array_mut().unwrap().push(0.into());
    });
    check(&battleship, "rewards with", &|json| pop(&mut json["rewards"]));
    check(&battleship, "flags", &|json| {
        // One step less than was played.
        for key in ["actions", "rewards", "obs", "states"] {
            pop(&mut json[key]);
        }
    });
    check(&battleship, "length: expected", &|json| {
        // One step more.
        for key in ["actions", "rewards", "obs", "states"] {
            let list = json[key].as_array_mut().unwrap();
            list.push(list.last().unwrap().clone());
        }
    });
}

#[test]
fn files_that_hold_no_episodes_are_failures() {
    let registry = Registry::standard();
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("replay-{}", std::process::id()));
    let write = |name: &str, text: &[u8]| {
        let mut gz = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        gz.write_all(text).unwrap();
        std::fs::write(folder.join(name), gz.finish().unwrap()).unwrap();
    };
    let failure = || replay_folder(&registry, &folder).unwrap_err();
    assert!(failure().contains("No such file"), "{}", failure());
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("notes.txt"), "no recording").unwrap();
    assert!(failure().contains("no *.jsonl.gz there"), "{}", failure());
    write("a.jsonl.gz", b"");
    assert!(failure().contains("a.jsonl.gz: no episode there"), "{}", failure());
    write("a.jsonl.gz", format!("{}\n{{\"env\": 3}}\n", first_episode("popgym-BattleshipEasy-v0")).as_bytes());
    assert!(failure().contains("a.jsonl.gz, line 2: invalid type"), "{}", failure());
    std::fs::write(folder.join("a.jsonl.gz"), "not compressed").unwrap();
    assert!(failure().contains("a.jsonl.gz, line 1: "), "{}", failure());
    std::fs::remove_dir_all(&folder).unwrap();
}
