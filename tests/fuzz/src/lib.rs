//! Fuzz targets: each takes any bytes and must neither panic, nor hang, nor take memory without measure.
//!
//! | target | what it reads, and what must hold of what is accepted |
//! |---|---|
//! | [`wire()`] | a message, as a learner of several kinds of episodes and as an actor: it is legal and survives the wire |
//! | [`weights()`] | a safetensors file: the numbers are finite and can be written and read again; refused, nothing changed |
//! | [`checkpoint()`] | a manifest and an optimiser: it can be saved and is loaded as it was |
//! | [`configuration()`] | a configuration: as TOML it means the same, and its run can be told to actors |
//! | [`study()`] | a study file: it has so many trials at most, and their configurations resolve |
//! | [`recording()`] | a recorded episode: it is replayed, and no longer than its environment's longest |
//!
//! Each tells whether the input was accepted. `corpus/TARGET/` holds small inputs, most of them found by fuzzing, and every
//! one that ever failed; `tests/corpus.rs` runs them all with the other tests. The targets are programs only with the
//! feature `libfuzzer`. `make fuzz` runs each for half an hour; one, for as long as wanted (new inputs go to the first folder):
//!
//! ```text
//! mkdir -p .cache/fuzz/wire
//! LD_LIBRARY_PATH="$PWD/.libtorch/lib" cargo fuzz run --fuzz-dir tests/fuzz wire --features libfuzzer -s none \
//!     .cache/fuzz/wire tests/fuzz/corpus/wire
//! ```
#![forbid(unsafe_code)]

mod checkpoint;
mod configuration;
mod recording;
mod study;
mod toml_text;
mod weights;
mod wire;

pub use checkpoint::{checkpoint, checkpoint_input};
pub use configuration::configuration;
pub use recording::recording;
pub use study::study;
pub use weights::{weights, weights_example};
pub use wire::{episode_specs, wire};

/// A target: whether it accepts the bytes.
pub type Target = fn(&[u8]) -> bool;

/// All targets by name.
pub const TARGETS: [(&str, Target); 6] = [
    ("wire", wire),
    ("weights", weights),
    ("checkpoint", checkpoint),
    ("configuration", configuration),
    ("study", study),
    ("recording", recording),
];
