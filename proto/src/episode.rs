//! Episodes: what an actor did, as columns.

use bytes::Bytes;
use popgym_envs::space::{Leaf, Space, Value};
use prost::Message as _;

use crate::error::within;
use crate::{WireError, limits, wire};

/// What every episode of a run looks like.
#[derive(Clone, Debug, PartialEq)]
pub struct EpisodeSpec {
    /// The environment's observation space.
    pub observation: Space,
    /// The space of the actions that are stored: the policy's own, its real components unbounded but finite.
    pub action: Space,
    /// No episode is longer, in steps.
    pub max_steps: u32,
}

/// Rows of one space, the two parts of their values apart.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Columns {
    /// `[rows, discrete width]` classes, row-major.
    pub discrete: Bytes,
    /// `[rows, real width]` reals, row-major.
    pub real: Vec<f32>,
}

/// One episode of `T` = [`Episode::steps`] steps. Whoever holds one that came from [`Episode::from_wire`] holds a legal
/// one: lengths fit, numbers are finite, classes are in range.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Episode {
    /// Its number within the epoch.
    pub index: u64,
    /// `T`, at least 1.
    pub steps: usize,
    /// `o_0 .. o_T`: `T + 1` rows.
    pub observations: Columns,
    /// `a_0 .. a_{T-1}`: `T` rows, as the policy drew them.
    pub actions: Columns,
    /// `r_0 .. r_{T-1}`, of the environment.
    pub rewards: Vec<f64>,
    /// Log-probabilities of the actions as the actor computed them, nats.
    pub log_probs: Vec<f32>,
    /// The task itself ended.
    pub terminated: bool,
    /// A time limit was reached. Both can be set together; one is.
    pub truncated: bool,
}

/// Episodes of one epoch, sampled with one version.
#[derive(Clone, Debug, PartialEq)]
pub struct EpisodeBatch {
    /// The epoch.
    pub epoch: u64,
    /// The version of the weights they were sampled with.
    pub version: u64,
    /// The episodes, at least one.
    pub episodes: Vec<Episode>,
}

impl EpisodeSpec {
    /// Checks that any such episode can travel.
    ///
    /// # Errors
    /// Episodes that are too long, or too large for one message.
    pub fn check(&self) -> Result<(), WireError> {
        within("max_steps", self.max_steps, 1..=limits::MAX_EPISODE_STEPS)?;
        let largest = self.largest_episode();
        let most = limits::MAX_MESSAGE_BYTES - limits::MESSAGE_OVERHEAD_BYTES;
        if largest > most {
            return Err(WireError::Length {
                field: "an episode of the greatest length",
                length: largest,
                allowed: format!("0..={most} bytes"),
            });
        }
        Ok(())
    }

    /// Size of the columns of an episode of the greatest length, in bytes.
    fn largest_episode(&self) -> usize {
        let row = |space: &Space| space.discrete_width() + size_of::<f32>() * space.real_width();
        let step = row(&self.observation) + row(&self.action) + size_of::<f64>() + size_of::<f32>();
        (self.max_steps as usize).saturating_add(1).saturating_mul(step)
    }

    /// Size of the largest message with such episodes, in bytes.
    pub fn largest_message(&self) -> usize {
        let overhead = limits::MESSAGE_OVERHEAD_BYTES + limits::MAX_EPISODES * limits::EPISODE_OVERHEAD_BYTES;
        (limits::EPISODES_MESSAGE_BYTES.max(self.largest_episode()) + overhead).min(limits::MAX_MESSAGE_BYTES)
    }
}

impl Episode {
    /// Undiscounted sum of the rewards.
    pub fn total_return(&self) -> f64 {
        self.rewards.iter().sum()
    }

    /// Size of its columns as they travel, in bytes.
    pub fn wire_bytes(&self) -> usize {
        let columns = |columns: &Columns| columns.discrete.len() + size_of_val(&columns.real[..]);
        columns(&self.observations)
            + columns(&self.actions)
            + size_of_val(&self.rewards[..])
            + size_of_val(&self.log_probs[..])
    }

    /// Reads an episode off the wire.
    ///
    /// # Errors
    /// The first block that does not fit `spec`.
    pub fn from_wire(wire: wire::Episode, spec: &EpisodeSpec) -> Result<Self, WireError> {
        // First of all: every length below is computed from it.
        within("steps", wire.steps, 1..=spec.max_steps)?;
        let steps = wire.steps as usize;
        if !wire.terminated && !wire.truncated {
            let allowed = "terminated, truncated or both".to_owned();
            return Err(WireError::Value { field: "end", value: "neither".to_owned(), allowed });
        }
        Ok(Self {
            index: wire.index,
            steps,
            observations: Columns {
                discrete: classes("observations_discrete", wire.observations_discrete, &spec.observation, steps + 1)?,
                real: reals("observations_real", &wire.observations_real, spec.observation.real_width(), steps + 1)?,
            },
            actions: Columns {
                discrete: classes("actions_discrete", wire.actions_discrete, &spec.action, steps)?,
                real: reals("actions_real", &wire.actions_real, spec.action.real_width(), steps)?,
            },
            rewards: doubles("rewards", &wire.rewards, steps)?,
            log_probs: reals("log_probs", &wire.log_probs, 1, steps)?,
            terminated: wire.terminated,
            truncated: wire.truncated,
        })
    }

    /// The episode as it travels.
    pub fn into_wire(self) -> wire::Episode {
        wire::Episode {
            index: self.index,
            // At most `MAX_EPISODE_STEPS` in any episode that is sent; the other side checks it.
            steps: u32::try_from(self.steps).unwrap_or(u32::MAX),
            observations_discrete: self.observations.discrete,
            observations_real: le_bytes(&self.observations.real, f32::to_le_bytes),
            actions_discrete: self.actions.discrete,
            actions_real: le_bytes(&self.actions.real, f32::to_le_bytes),
            rewards: le_bytes(&self.rewards, f64::to_le_bytes),
            log_probs: le_bytes(&self.log_probs, f32::to_le_bytes),
            terminated: self.terminated,
            truncated: self.truncated,
        }
    }
}

impl EpisodeBatch {
    /// Reads a batch off the wire.
    ///
    /// # Errors
    /// The first field of the first episode that is not allowed.
    pub fn from_wire(wire: wire::Episodes, spec: &EpisodeSpec) -> Result<Self, WireError> {
        if !(1..=limits::MAX_EPISODES).contains(&wire.episodes.len()) {
            let allowed = format!("1..={} episodes", limits::MAX_EPISODES);
            return Err(WireError::Length { field: "episodes", length: wire.episodes.len(), allowed });
        }
        let decode = |bytes: Bytes| {
            let wire = wire::Episode::decode(bytes)
                .map_err(|error| WireError::Encoding { field: "episode", problem: error.to_string() })?;
            Episode::from_wire(wire, spec)
        };
        let (epoch, version) = (wire.epoch, wire.version);
        Ok(Self { epoch, version, episodes: wire.episodes.into_iter().map(decode).collect::<Result<_, _>>()? })
    }

    /// The batch as it travels.
    pub fn into_wire(self) -> wire::Episodes {
        let episodes = self.episodes.into_iter().map(|episode| episode.into_wire().encode_to_vec().into()).collect();
        wire::Episodes { epoch: self.epoch, version: self.version, episodes }
    }
}

/// A block of classes: its length and every class checked.
fn classes(field: &'static str, block: Bytes, space: &Space, rows: usize) -> Result<Bytes, WireError> {
    check_length(field, block.len(), space.discrete_width(), 1, rows)?;
    let classes: Vec<u16> = space
        .leaves()
        .into_iter()
        .filter_map(|leaf| match leaf {
            Leaf::Discrete { classes } => Some(classes),
            Leaf::Real { .. } => None,
        })
        .collect();
    if let Some(at) = block.iter().zip(classes.iter().cycle()).position(|(&x, &classes)| u16::from(x) >= classes) {
        let allowed = format!("0..{}", classes[at % classes.len()]);
        return Err(WireError::Element { field, at, value: block[at].to_string(), allowed });
    }
    Ok(block)
}

/// A block of finite `f32`, `[rows, width]`.
fn reals(field: &'static str, block: &Bytes, width: usize, rows: usize) -> Result<Vec<f32>, WireError> {
    check_length(field, block.len(), width, size_of::<f32>(), rows)?;
    let (values, _) = block.as_chunks();
    let values: Vec<f32> = values.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect();
    match values.iter().position(|x| !x.is_finite()) {
        None => Ok(values),
        Some(at) => Err(not_finite(field, at, values[at].to_string())),
    }
}

/// A block of finite `f64`, `[rows]`.
fn doubles(field: &'static str, block: &Bytes, rows: usize) -> Result<Vec<f64>, WireError> {
    check_length(field, block.len(), 1, size_of::<f64>(), rows)?;
    let (values, _) = block.as_chunks();
    let values: Vec<f64> = values.iter().map(|&bytes| f64::from_le_bytes(bytes)).collect();
    match values.iter().position(|x| !x.is_finite()) {
        None => Ok(values),
        Some(at) => Err(not_finite(field, at, values[at].to_string())),
    }
}

fn not_finite(field: &'static str, at: usize, value: String) -> WireError {
    WireError::Element { field, at, value, allowed: "a finite number".to_owned() }
}

fn check_length(field: &'static str, length: usize, width: usize, size: usize, rows: usize) -> Result<(), WireError> {
    if width.checked_mul(size).and_then(|row| row.checked_mul(rows)) == Some(length) {
        return Ok(());
    }
    Err(WireError::Length { field, length, allowed: format!("{rows} rows of {width} values of {size} bytes") })
}

fn le_bytes<T: Copy, const N: usize>(values: &[T], encode: impl Fn(T) -> [u8; N]) -> Bytes {
    let mut bytes = Vec::with_capacity(N * values.len());
    for &value in values {
        bytes.extend_from_slice(&encode(value));
    }
    bytes.into()
}

/// An episode while it is being sampled. Reused from episode to episode; steps do not allocate once the longest
/// episode so far has been seen.
#[derive(Clone, Debug, Default)]
pub struct EpisodeBuilder {
    index: u64,
    observations_discrete: Vec<u8>,
    observations_real: Vec<f32>,
    actions_discrete: Vec<u8>,
    actions_real: Vec<f32>,
    rewards: Vec<f64>,
    log_probs: Vec<f32>,
}

impl EpisodeBuilder {
    /// Starts episode `index` with its first observation; whatever was there before is dropped.
    pub fn begin(&mut self, index: u64, observation: Value<'_>) {
        self.index = index;
        self.observations_discrete.clear();
        self.observations_real.clear();
        self.actions_discrete.clear();
        self.actions_real.clear();
        self.rewards.clear();
        self.log_probs.clear();
        self.push_observation(observation);
    }

    /// Adds a step: the action as it was drawn, its log-probability, what the environment paid, and what it showed next.
    pub fn push(&mut self, action: Value<'_>, log_prob: f32, reward: f64, next_observation: Value<'_>) {
        self.actions_discrete.extend_from_slice(action.discrete);
        self.actions_real.extend_from_slice(action.real);
        self.log_probs.push(log_prob);
        self.rewards.push(reward);
        self.push_observation(next_observation);
    }

    fn push_observation(&mut self, observation: Value<'_>) {
        self.observations_discrete.extend_from_slice(observation.discrete);
        self.observations_real.extend_from_slice(observation.real);
    }

    /// Steps so far.
    pub fn steps(&self) -> usize {
        self.rewards.len()
    }

    /// The episode, copied out in exact sizes; the builder keeps its storage for the next.
    pub fn finish(&self, terminated: bool, truncated: bool) -> Episode {
        Episode {
            index: self.index,
            steps: self.steps(),
            observations: Columns {
                discrete: Bytes::copy_from_slice(&self.observations_discrete),
                real: self.observations_real.clone(),
            },
            actions: Columns {
                discrete: Bytes::copy_from_slice(&self.actions_discrete),
                real: self.actions_real.clone(),
            },
            rewards: self.rewards.clone(),
            log_probs: self.log_probs.clone(),
            terminated,
            truncated,
        }
    }
}
