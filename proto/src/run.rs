//! What a run is, who an actor is, and how both know that they mean the same.

use std::fmt::Write as _;

use popgym_envs::Observability;
use sha2::{Digest, Sha256};

use crate::error::{name, within};
use crate::{WireError, limits, wire};

/// SHA-256 of all that actor and learner must agree on.
pub type Fingerprint = [u8; 32];

/// What an actor needs to build the environment and the policy, and to sample a run's episodes. Plain data.
#[derive(Clone, Debug, PartialEq)]
pub struct RunSpec {
    /// The run's name.
    pub run: String,
    /// The environment's canonical id.
    pub env: String,
    /// How much of the environment the agent is shown.
    pub observability: Observability,
    /// An episode that is this many steps long is truncated there.
    pub max_episode_steps: u32,
    /// The memory's name.
    pub memory: String,
    /// The memory's options, all resolved.
    pub memory_options: toml::Table,
    /// The policy's options outside its memory, all resolved.
    pub policy_options: toml::Table,
    /// The seed of every stream of the run.
    pub seed: u64,
    /// Epoch `k` is sampled with version `k - lag` (epoch 0 with version 0). 0 or 1.
    pub lag: u32,
    /// Number of rows that an actor pads its batch to where, on its machine, a row's result depends on the number of
    /// rows. Not used elsewhere.
    pub rows: u32,
    /// Whether episodes use the streams of evaluation instead of those of training.
    pub evaluation: bool,
    /// Whether the likeliest actions are taken instead of drawn ones.
    pub greedy: bool,
}

impl RunSpec {
    /// Checks that every field is within the wire's limits.
    ///
    /// # Errors
    /// The first field that is not.
    pub fn check(&self) -> Result<(), WireError> {
        Self::from_wire(self.clone().into_wire()).map(drop)
    }

    /// Reads a specification off the wire.
    ///
    /// # Errors
    /// The first field that is not allowed.
    pub fn from_wire(wire: wire::RunSpec) -> Result<Self, WireError> {
        Ok(Self {
            run: name("run", wire.run, 1)?,
            env: name("env", wire.env, 1)?,
            observability: observability(&wire.observability)?,
            max_episode_steps: within("max_episode_steps", wire.max_episode_steps, 1..=limits::MAX_EPISODE_STEPS)?,
            memory: name("memory", wire.memory, 1)?,
            memory_options: table("memory_options", &wire.memory_options)?,
            policy_options: table("policy_options", &wire.policy_options)?,
            seed: wire.seed,
            lag: within("lag", wire.lag, 0..=1)?,
            rows: within("rows", wire.rows, limits::MIN_ROWS..=limits::MAX_SLOTS)?,
            evaluation: wire.evaluation,
            greedy: wire.greedy,
        })
    }

    /// The specification as it travels.
    pub fn into_wire(self) -> wire::RunSpec {
        wire::RunSpec {
            run: self.run,
            env: self.env,
            observability: self.observability.name().to_owned(),
            max_episode_steps: self.max_episode_steps,
            memory: self.memory,
            memory_options: self.memory_options.to_string(),
            policy_options: self.policy_options.to_string(),
            seed: self.seed,
            lag: self.lag,
            rows: self.rows,
            evaluation: self.evaluation,
            greedy: self.greedy,
        }
    }
}

fn observability(value: &str) -> Result<Observability, WireError> {
    value.parse().map_err(|_| WireError::Value {
        field: "observability",
        value: format!("`{}`", value.chars().take(32).collect::<String>().escape_debug()),
        allowed: Observability::ALL.map(Observability::name).join(", "),
    })
}

fn table(field: &'static str, text: &str) -> Result<toml::Table, WireError> {
    let check = |length: usize| {
        let allowed = || format!("0..={} bytes", limits::MAX_OPTIONS_BYTES);
        let fits = length <= limits::MAX_OPTIONS_BYTES;
        if fits { Ok(()) } else { Err(WireError::Length { field, length, allowed: allowed() }) }
    };
    check(text.len())?;
    let table: toml::Table = toml::from_str(text)
        .map_err(|error: toml::de::Error| WireError::Toml { field, problem: error.message().trim().to_owned() })?;
    // Its own text can be longer: `1e300` is written out.
    check(table.to_string().len())?;
    Ok(table)
}

/// The first message of an actor: who it is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Hello {
    /// [`crate::PROTOCOL_VERSION`] of the actor. Checked by the learner, so that it can name both versions.
    pub protocol_version: u32,
    /// Version of the actor's package.
    pub build: String,
    /// The actor's name, for people: the same when it reconnects. Two actors may have the same.
    pub actor: String,
    /// Drawn at random by the actor's process, and shown to the learner alone. A connection replaces an older one of the same
    /// name and key, so nobody can end another's.
    pub key: u64,
    /// Grows with each connection of the same process.
    pub incarnation: u64,
    /// Episodes that it can step at a time.
    pub slots: u32,
    /// The run it belongs to; `None`: whichever the learner runs.
    pub run: Option<String>,
}

impl Hello {
    /// Reads a hello off the wire.
    ///
    /// # Errors
    /// The first field that is not allowed.
    pub fn from_wire(wire: wire::Hello) -> Result<Self, WireError> {
        let run = name("run", wire.run, 0)?;
        Ok(Self {
            protocol_version: wire.protocol_version,
            build: name("build", wire.build, 0)?,
            actor: name("actor", wire.actor, 1)?,
            key: wire.key,
            incarnation: wire.incarnation,
            slots: within("slots", wire.slots, 1..=limits::MAX_SLOTS)?,
            run: (!run.is_empty()).then_some(run),
        })
    }

    /// The hello as it travels.
    pub fn into_wire(self) -> wire::Hello {
        wire::Hello {
            protocol_version: self.protocol_version,
            build: self.build,
            actor: self.actor,
            key: self.key,
            incarnation: self.incarnation,
            slots: self.slots,
            run: self.run.unwrap_or_default(),
        }
    }
}

/// The hash by which actor and learner know that they build the same environment and the same policy.
///
/// `env_text` is the Debug form of the environment's `EnvSpec` (`format!("{:?}", env.spec())`): id, spaces, limits.
/// `policy_signature` names every parameter and its shape. Both are as this side built them from `spec`.
pub fn fingerprint(spec: &RunSpec, env_text: &str, policy_signature: &str) -> Fingerprint {
    let mut text = String::new();
    let mut field = |key: &str, value: &str| {
        // The length makes the text unambiguous whatever a value holds. Writing to a string cannot fail.
        let _ = writeln!(text, "{key} {} {value}", value.len());
    };
    field("protocol", &crate::PROTOCOL_VERSION.to_string());
    field("run", &spec.run);
    field("env", &spec.env);
    field("observability", spec.observability.name());
    field("max_episode_steps", &spec.max_episode_steps.to_string());
    field("memory", &spec.memory);
    field("memory_options", &spec.memory_options.to_string());
    field("policy_options", &spec.policy_options.to_string());
    field("seed", &spec.seed.to_string());
    field("lag", &spec.lag.to_string());
    field("rows", &spec.rows.to_string());
    field("evaluation", &spec.evaluation.to_string());
    field("greedy", &spec.greedy.to_string());
    field("env_spec", env_text);
    field("policy", policy_signature);
    Sha256::digest(text.as_bytes()).into()
}
