//! The two directions of a session.

use bytes::Bytes;

use crate::episode::{EpisodeBatch, EpisodeSpec};
use crate::run::{Fingerprint, Hello, RunSpec};
use crate::{WireError, limits, wire};

/// What an actor says.
#[derive(Clone, Debug, PartialEq)]
pub enum ActorMessage {
    /// First of all: who it is.
    Hello(Hello),
    /// It has built environment and policy, and this is their fingerprint.
    Ready(Fingerprint),
    /// Finished episodes.
    Episodes(EpisodeBatch),
    /// It is alive.
    Heartbeat,
}

/// What a learner says.
#[derive(Clone, Debug, PartialEq)]
pub enum LearnerMessage {
    /// The answer to a hello.
    Welcome(RunSpec),
    /// Sampling of an epoch is open.
    Epoch(OpenEpoch),
    /// Episodes to sample.
    Leases(Leases),
    /// The epoch's batch is complete; what is not finished is void.
    Closed {
        /// The epoch.
        epoch: u64,
    },
    /// The run is complete.
    Stop {
        /// Why, in one sentence.
        reason: String,
    },
    /// It is alive.
    Heartbeat,
}

/// The weights of one version.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WeightSet {
    /// Number of completed PPO updates.
    pub version: u64,
    /// Safetensors. Cloning shares them.
    pub bytes: Bytes,
}

impl WeightSet {
    /// Weights that fit a message and have the form of safetensors. What tensors they hold is for the policy to check.
    ///
    /// # Errors
    /// Weights that are too large or are not safetensors.
    pub fn new(version: u64, bytes: Bytes) -> Result<Self, WireError> {
        let most = limits::MAX_MESSAGE_BYTES - limits::MESSAGE_OVERHEAD_BYTES;
        if bytes.len() > most {
            let allowed = format!("1..={most} bytes");
            return Err(WireError::Length { field: "weights", length: bytes.len(), allowed });
        }
        safetensors::SafeTensors::deserialize(&bytes)
            .map_err(|error| WireError::Weights { field: "weights", problem: error.to_string() })?;
        Ok(Self { version, bytes })
    }
}

/// The epoch that is open for sampling.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OpenEpoch {
    /// The epoch.
    pub epoch: u64,
    /// The version it is sampled with.
    pub version: u64,
    /// The weights of `version`; `None`: the session has them already.
    pub weights: Option<WeightSet>,
}

/// Episodes that an actor is to sample, of one epoch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Leases {
    /// The epoch.
    pub epoch: u64,
    /// Their indices within the epoch, in the order in which to start them.
    pub episodes: Vec<u64>,
}

impl ActorMessage {
    /// Reads an actor's message off the wire.
    ///
    /// # Errors
    /// The first field that is not allowed.
    pub fn from_wire(wire: wire::FromActor, spec: &EpisodeSpec) -> Result<Self, WireError> {
        use wire::from_actor::Message;
        match wire.message.ok_or(WireError::Missing { field: "message" })? {
            Message::Hello(hello) => Hello::from_wire(hello).map(Self::Hello),
            Message::Ready(ready) => {
                let length = ready.fingerprint.len();
                let allowed = || "32 bytes".to_owned();
                Fingerprint::try_from(&ready.fingerprint[..]).map(Self::Ready).map_err(|_| WireError::Length {
                    field: "fingerprint",
                    length,
                    allowed: allowed(),
                })
            }
            Message::Episodes(batch) => EpisodeBatch::from_wire(batch, spec).map(Self::Episodes),
            Message::Heartbeat(wire::Heartbeat {}) => Ok(Self::Heartbeat),
        }
    }

    /// The message as it travels.
    pub fn into_wire(self) -> wire::FromActor {
        use wire::from_actor::Message;
        let message = match self {
            Self::Hello(hello) => Message::Hello(hello.into_wire()),
            Self::Ready(fingerprint) => {
                Message::Ready(wire::Ready { fingerprint: Bytes::copy_from_slice(&fingerprint) })
            }
            Self::Episodes(batch) => Message::Episodes(batch.into_wire()),
            Self::Heartbeat => Message::Heartbeat(wire::Heartbeat {}),
        };
        wire::FromActor { message: Some(message) }
    }
}

impl LearnerMessage {
    /// Reads a learner's message off the wire.
    ///
    /// # Errors
    /// The first field that is not allowed.
    pub fn from_wire(wire: wire::FromLearner) -> Result<Self, WireError> {
        use wire::from_learner::Message;
        match wire.message.ok_or(WireError::Missing { field: "message" })? {
            Message::Welcome(wire::Welcome { spec }) => {
                RunSpec::from_wire(spec.ok_or(WireError::Missing { field: "spec" })?).map(Self::Welcome)
            }
            Message::Epoch(wire::Epoch { epoch, version, weights }) => {
                let weights = if weights.is_empty() { None } else { Some(WeightSet::new(version, weights)?) };
                Ok(Self::Epoch(OpenEpoch { epoch, version, weights }))
            }
            Message::Leases(wire::Leases { epoch, episodes }) => {
                if episodes.len() > limits::MAX_LEASES {
                    let allowed = format!("0..={} leases", limits::MAX_LEASES);
                    return Err(WireError::Length { field: "leases", length: episodes.len(), allowed });
                }
                Ok(Self::Leases(Leases { epoch, episodes }))
            }
            Message::Closed(wire::Closed { epoch }) => Ok(Self::Closed { epoch }),
            Message::Stop(wire::Stop { reason }) => {
                Ok(Self::Stop { reason: reason.chars().take(limits::MAX_REASON_CHARS).collect() })
            }
            Message::Heartbeat(wire::Heartbeat {}) => Ok(Self::Heartbeat),
        }
    }

    /// The message as it travels.
    pub fn into_wire(self) -> wire::FromLearner {
        use wire::from_learner::Message;
        let message = match self {
            Self::Welcome(spec) => Message::Welcome(wire::Welcome { spec: Some(spec.into_wire()) }),
            Self::Epoch(OpenEpoch { epoch, version, weights }) => {
                let weights = weights.map(|weights| weights.bytes).unwrap_or_default();
                Message::Epoch(wire::Epoch { epoch, version, weights })
            }
            Self::Leases(Leases { epoch, episodes }) => Message::Leases(wire::Leases { epoch, episodes }),
            Self::Closed { epoch } => Message::Closed(wire::Closed { epoch }),
            Self::Stop { reason } => Message::Stop(wire::Stop { reason }),
            Self::Heartbeat => Message::Heartbeat(wire::Heartbeat {}),
        };
        wire::FromLearner { message: Some(message) }
    }
}
