//! Studies: environments x memories x seeds, each a run directory of its own.
//!
//! | module | holds |
//! |---|---|
//! | [`plan`] | the study file, and the trials that it means |
//! | [`dir`] | the study's directory: which trials are done, failed, or claimed by another process |
//! | [`runner`] | trials as child processes, some at a time |
//! | [`view`] | progress of trials and of the whole |

pub mod dir;
pub mod plan;
pub mod runner;
mod view;
