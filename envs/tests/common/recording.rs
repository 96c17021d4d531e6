//! Recorded episodes: one JSON object each, and their replay.

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
pub(crate) fn replay_line(registry: &Registry, episode: usize, line: &str) -> Result<(String, usize), String> {
    let trace: Trace = serde_json::from_str(line).map_err(|error| error.to_string())?;
    let entry = registry.get(&trace.env).map_err(|error| error.to_string())?;
    let steps = replay(entry.make().as_mut(), &trace);
    steps
        .map(|steps| (entry.id().to_owned(), steps))
        .map_err(|reason| format!("{}, episode {episode}, {reason}", entry.id()))
}
