//! The wire between actors and the learner: messages, limits, and the only place where messages become checked types.
//!
//! | module | what it holds |
//! |---|---|
//! | [`limits`] | every size limit, deadline, window and queue, with its arithmetic |
//! | [`message`] | the two directions of a session: [`ActorMessage`], [`LearnerMessage`] |
//! | [`run`] | [`RunSpec`], [`Hello`], and the fingerprint by which both sides know that they build the same policy |
//! | [`episode`] | [`Episode`], checked against an [`EpisodeSpec`]; [`EpisodeBuilder`] for who samples it |
//! | [`monitor`] | the HTTP port of both programs: metrics, health |
//! | [`token`] | the secret that actors show |
//! | [`transport`] | channel and server settings, the same care on both sides |
//! | [`wire`] | the generated code; nothing outside this crate reads its fields |
//!
//! Whatever a peer sends ends as a domain type or as a [`WireError`]; nothing here panics on input.
#![forbid(unsafe_code)]

pub mod episode;
pub mod error;
pub mod limits;
pub mod message;
pub mod monitor;
pub mod run;
pub mod token;
pub mod transport;

#[allow(missing_docs, unreachable_pub, clippy::all, clippy::pedantic)]
pub mod wire {
    //! Generated from `proto/popgym.proto`.
    tonic::include_proto!("popgym.v1");
}

pub use episode::{Columns, Episode, EpisodeBatch, EpisodeBuilder, EpisodeSpec};
pub use error::WireError;
pub use message::{ActorMessage, LearnerMessage, Leases, OpenEpoch, WeightSet};
pub use run::{Fingerprint, Hello, RunSpec, fingerprint};
pub use token::Token;

/// Grows with every change after which an older actor and a newer learner would misunderstand each other.
pub const PROTOCOL_VERSION: u32 = 2;
