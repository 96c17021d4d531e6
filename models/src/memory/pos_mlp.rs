//! `pos_mlp`: [`Mlp`] on an input that holds the time step (paper: PosMLP). It can act by the clock, but remembers nothing.
//!
//! Equations and shapes are those of `mlp.rs`; the policy adds the positional encoding (`positional.rs`).

use tch::nn::Path;
use tch::{Device, Tensor};

use super::{HiddenSize, Memory, MemoryKind, Mlp, Scan, State};
use crate::packing::Packing;

/// Two layers on the present input and the time step.
#[derive(Debug)]
pub struct PosMlp(Mlp);

impl MemoryKind for PosMlp {
    const NAME: &'static str = "pos_mlp";
    const PAPER_NAME: &'static str = "PosMLP";
    const PAPER: &'static str = "Vaswani et al., 2017; Morad et al., 2023";
    type Options = HiddenSize;

    fn new(path: &Path<'_>, input_width: i64, options: &HiddenSize) -> Result<Self, String> {
        Mlp::new(path, input_width, options).map(Self)
    }
}

impl Memory for PosMlp {
    fn output_width(&self) -> i64 {
        self.0.output_width()
    }

    fn initial_state(&self, rows: i64, device: Device) -> State {
        self.0.initial_state(rows, device)
    }

    fn positional(&self) -> bool {
        true
    }

    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        self.0.step(input, state)
    }

    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        self.0.scan(input, packing, state)
    }
}
