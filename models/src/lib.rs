//! The policy of popgym-rs: observation encoder, memory, actor and critic heads, action distributions, weights.
//!
//! | module | holds |
//! |---|---|
//! | [`encoder`] | observation, previous action and first-step flag to one vector |
//! | [`memory`] | the memories, each with `step` (one time step) and `scan` (whole sequences) |
//! | [`policy`] | encoder, memory and heads put together: the paper's outer model |
//! | [`distribution`] | what the actor head's numbers mean, and how an action is drawn |
//! | [`packing`] | sequences of unequal length without padding |
//! | [`export`] | a policy's step as TorchScript |
//! | [`weights`] | weights as safetensors, every name and shape checked |
//! | [`device`] | CPU and CUDA; the CUDA half of libtorch is opened only when asked for |

mod chunks;
pub mod device;
pub mod distribution;
pub mod encoder;
pub mod export;
mod init;
pub mod memory;
pub mod packing;
pub mod policy;
mod positional;
pub mod weights;

pub use distribution::{ActionDistribution, Marginals};
pub use encoder::Encoder;
pub use memory::State;
pub use packing::Packing;
pub use policy::{Policy, PolicyOptions, PolicySpec};
pub use weights::WeightsError;

/// Why a policy cannot be built.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ModelError {
    /// No memory of that name.
    #[error("unknown memory `{name}`; did you mean `{nearest}`? (`learner list memories` lists all)")]
    UnknownMemory {
        /// The name given.
        name: String,
        /// The most similar known name.
        nearest: String,
    },
    /// A memory refused its options.
    #[error("memory `{memory}`: {problem}")]
    MemoryOptions {
        /// The memory's name.
        memory: String,
        /// What is wrong.
        problem: String,
    },
    /// A space that no policy can be made for.
    #[error("{which} space: {problem}")]
    Space {
        /// `observation` or `action`.
        which: &'static str,
        /// What is wrong.
        problem: String,
    },
    /// Options of the policy that make no sense.
    #[error("policy options: {0}")]
    Options(String),
    /// The device that was asked for cannot be had.
    #[error("device: {0}")]
    Device(String),
}
