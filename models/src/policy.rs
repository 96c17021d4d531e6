//! The paper's outer model: encoder, projection, memory, actor and critic.
//!
//! ```text
//! u = LayerNorm(W0 x + b0)              128 wide, no affine part
//! u = (1 - s) u + s PE[t]               where the memory wants a positional encoding (`positional.rs`)
//! z = LeakyReLU(W1 u + b1)              128 wide
//! m = memory(z)
//! actor, critic: Linear 128, LeakyReLU, Linear 128, LeakyReLU, Linear to the outputs; nothing shared after m
//! ```
//!
//! Source: Morad et al., ICLR 2023, appendix, and the package's base model. First weights: orthogonal for W0, W1 and the
//! first two layers of each head, normal with standard deviation 0.01 for the last, biases uniform within
//! `+-1/sqrt(fan_in)`; memories have their own.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use popgym_envs::Space;
use serde::{Deserialize, Serialize};
use tch::nn::{Path, VarStore};
use tch::{Device, Kind, Tensor};

use crate::ModelError;
use crate::distribution::ActionDistribution;
use crate::encoder::Encoder;
use crate::init::{Linear, ORTHOGONAL, SMALL_NORMAL, leaky_relu};
use crate::memory::{self, Backward, Memory, State};
use crate::packing::Packing;
use crate::positional::PositionalEncoding;
use crate::weights::{self, WeightsError};

/// Width of the projection, which is the memory's input, and of the heads' layers.
pub const WIDTH: i64 = 128;

/// Options of the policy outside its memory.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyOptions {
    /// Smallest log standard deviation of a continuous action (`-inf`: no bound, as in the paper).
    pub log_std_min: f64,
    /// Largest log standard deviation of a continuous action (`inf`: no bound, as in the paper).
    pub log_std_max: f64,
}

/// All that a policy is built from.
#[derive(Clone, Debug)]
pub struct PolicySpec {
    /// The environment's observation space.
    pub observation: Space,
    /// The environment's action space.
    pub action: Space,
    /// Name of the memory.
    pub memory: String,
    /// Options of the memory.
    pub memory_options: toml::Table,
    /// Options of the policy.
    pub options: PolicyOptions,
    /// The most steps of an episode.
    pub max_steps: u32,
}

/// A recurrent actor-critic.
pub struct Policy {
    store: VarStore,
    parameters: BTreeMap<String, Tensor>,
    encoder: Encoder,
    projection: Linear,
    positional: Option<PositionalEncoding>,
    preprocessor: Linear,
    memory: Box<dyn Memory>,
    actor: Head,
    critic: Head,
    distribution: ActionDistribution,
}

/// What [`Policy::scan`] returns, in packed order.
pub struct Outputs {
    /// Distribution parameters, `[rows, parameters]`.
    pub params: Tensor,
    /// Values of the observations, `[rows]`.
    pub values: Tensor,
    /// Time steps that the memory computed, padding included.
    pub computed_steps: i64,
    cuts: Vec<Cut>,
}

/// Where the graph is cut for a memory with a backward of its own.
struct Cut {
    input: Tensor,
    output: Tensor,
    backward: Backward,
}

impl Outputs {
    /// Adds d `loss` / d parameter to the gradient of every parameter. `loss` is a scalar made from these outputs.
    pub fn backward(self, loss: &Tensor) {
        loss.backward();
        let carried = self.cuts.into_iter().map(|cut| {
            let grad_input = (cut.backward)(&cut.output.grad());
            (cut.input * grad_input).sum(Kind::Float)
        });
        if let Some(sum) = carried.reduce(|a, b| a + b) {
            sum.backward();
        }
    }
}

impl Policy {
    /// A policy with fresh weights, drawn from libtorch's global generator (`tch::manual_seed`).
    ///
    /// # Errors
    /// An unknown memory, impossible options or spaces.
    pub fn new(spec: &PolicySpec, memories: &memory::Registry, device: Device) -> Result<Self, ModelError> {
        spec.validate()?;
        let store = VarStore::new(device);
        let root = store.root();
        let encoder = Encoder::new(&spec.observation, &spec.action, device);
        let bounds = (spec.options.log_std_min, spec.options.log_std_max);
        let distribution = ActionDistribution::new(&spec.action, bounds)?;
        let projection = Linear::new(&(&root / "projection"), encoder.width() as i64, WIDTH, ORTHOGONAL);
        let preprocessor = Linear::new(&(&root / "preprocessor"), WIDTH, WIDTH, ORTHOGONAL);
        let memory = memories.get(&spec.memory)?.build(&(&root / "memory"), WIDTH, &spec.memory_options)?;
        let positional = memory
            .positional()
            .then(|| PositionalEncoding::new(&(&root / "positional"), WIDTH, i64::from(spec.max_steps)));
        let actor = Head::new(&(&root / "actor"), memory.output_width(), distribution.width() as i64);
        let critic = Head::new(&(&root / "critic"), memory.output_width(), 1);
        let parameters = store.variables().into_iter().collect();
        Ok(Self {
            store,
            parameters,
            encoder,
            projection,
            positional,
            preprocessor,
            memory,
            actor,
            critic,
            distribution,
        })
    }

    /// Where the weights are.
    pub fn device(&self) -> Device {
        self.store.device()
    }

    /// Turns observations into input vectors.
    pub fn encoder(&self) -> &Encoder {
        &self.encoder
    }

    /// What the actor head's numbers mean.
    pub fn distribution(&self) -> &ActionDistribution {
        &self.distribution
    }

    /// The trainable parameters by name.
    pub fn parameters(&self) -> &BTreeMap<String, Tensor> {
        &self.parameters
    }

    /// Puts parameters back where they are allowed to be: to be called after every optimiser's step.
    pub fn constrain(&self) {
        self.memory.constrain();
    }

    /// Names and shapes of all parameters, one a line: equal for two policies that can exchange weights.
    pub fn signature(&self) -> String {
        self.parameters.iter().fold(String::new(), |mut text, (name, tensor)| {
            let _ = writeln!(text, "{name} f32 {:?}", tensor.size());
            text
        })
    }

    /// The weights as safetensors.
    pub fn to_bytes(&self) -> Vec<u8> {
        weights::to_bytes(&self.parameters)
    }

    /// Replaces the weights by those of a safetensors file; on an error nothing has been changed.
    ///
    /// # Errors
    /// What differs in names, shapes or types, or numbers that are not finite.
    pub fn load(&mut self, bytes: &[u8]) -> Result<(), WeightsError> {
        weights::load_into(&self.parameters, bytes)
    }

    /// The state at the start of an episode, for `rows` episodes: the memory's, and the time step (f32 `[rows]`) where there is a
    /// positional encoding.
    pub fn initial_state(&self, rows: i64) -> State {
        let mut state = self.memory.initial_state(rows, self.device());
        state.0.extend(self.positional.as_ref().map(|_| Tensor::zeros([rows], (Kind::Float, self.device()))));
        state
    }

    /// One time step without the critic: input vectors `[rows, input width]` to distribution parameters
    /// `[rows, parameters]` and the next state. No gradients.
    pub fn act(&self, features: &Tensor, state: &State) -> (Tensor, State) {
        tch::no_grad(|| {
            let (output, state) = self.remember(features, state, |input, state| self.memory.act(input, state));
            (self.distribution.bound(self.actor.forward(&output)), state)
        })
    }

    /// One time step with the critic: as [`Policy::act`], and the values `[rows]`.
    pub fn step(&self, features: &Tensor, state: &State) -> (Tensor, Tensor, State) {
        tch::no_grad(|| self.whole_step(features, state, |input, state| self.memory.act(input, state)))
    }

    /// [`Policy::step`] with gradients, and of libtorch's operators alone.
    pub(crate) fn step_of_operators(&self, features: &Tensor, state: &State) -> (Tensor, Tensor, State) {
        self.whole_step(features, state, |input, state| self.memory.step(input, state))
    }

    fn whole_step(
        &self,
        features: &Tensor,
        state: &State,
        memory: impl FnOnce(&Tensor, &State) -> (Tensor, State),
    ) -> (Tensor, Tensor, State) {
        let (output, state) = self.remember(features, state, memory);
        (self.distribution.bound(self.actor.forward(&output)), self.critic.forward(&output).squeeze_dim(1), state)
    }

    /// The memory's output and the next state, by this form of the memory.
    fn remember(
        &self,
        features: &Tensor,
        state: &State,
        memory: impl FnOnce(&Tensor, &State) -> (Tensor, State),
    ) -> (Tensor, State) {
        let Some((time, before)) = state.0.split_last().filter(|_| self.positional.is_some()) else {
            return memory(&self.input(features, None), state);
        };
        let before = State(before.iter().map(Tensor::shallow_clone).collect());
        let (output, mut next) = memory(&self.input(features, Some(time)), &before);
        next.0.push(time + 1.0);
        (output, next)
    }

    /// Whole episodes from their start: packed input vectors `[rows, input width]` to parameters and values.
    ///
    /// With `bptt` > 0 gradients are cut every `bptt` steps of an episode, while the state is carried.
    pub fn scan(&self, features: &Tensor, packing: &Packing, bptt: i64) -> Outputs {
        let times = self.positional.as_ref().map(|_| packing.times(self.device()));
        let input = self.input(features, times.as_ref());
        let mut state = self.memory.initial_state(packing.sequences(), self.device());
        let (mut outputs, mut cuts, mut computed_steps) = (Vec::new(), Vec::new(), 0);
        for span in packing.spans(bptt) {
            let span_input = input.narrow(0, span.first_row, span.packing.rows());
            let scan = self.memory.scan(&span_input, &span.packing, &state.carry(span.packing.sequences()));
            computed_steps += scan.computed_steps;
            state = scan.state;
            let output = match scan.backward {
                Some(backward) if span_input.requires_grad() => {
                    let output = scan.output.detach().set_requires_grad(true);
                    cuts.push(Cut { input: span_input, output: output.shallow_clone(), backward });
                    output
                }
                _ => scan.output,
            };
            outputs.push(output);
        }
        let output = if outputs.len() == 1 { outputs.swap_remove(0) } else { Tensor::cat(&outputs, 0) };
        Outputs {
            params: self.distribution.bound(self.actor.forward(&output)),
            values: self.critic.forward(&output).squeeze_dim(1),
            computed_steps,
            cuts,
        }
    }

    /// The memory's input: projected, normalised, with its time step mixed in, preprocessed.
    fn input(&self, features: &Tensor, times: Option<&Tensor>) -> Tensor {
        let projected = self.projection.forward(features);
        let mut u = projected.layer_norm([WIDTH], None::<&Tensor>, None::<&Tensor>, 1e-5, false);
        if let (Some(positional), Some(times)) = (&self.positional, times) {
            u = positional.mix(&u, times);
        }
        leaky_relu(self.preprocessor.forward(&u))
    }
}

/// Bounds of log standard deviations beyond this leave f32: squares of their exponentials are divided.
const MAX_LOG_STD: f64 = 20.0;

impl PolicySpec {
    fn validate(&self) -> Result<(), ModelError> {
        for (which, space) in [("observation", &self.observation), ("action", &self.action)] {
            space.validate().map_err(|problem| ModelError::Space { which, problem })?;
        }
        let PolicyOptions { log_std_min, log_std_max } = self.options;
        for (key, bound, none) in [("log_std_min", log_std_min, "-inf"), ("log_std_max", log_std_max, "inf")] {
            // Also false for NaN.
            if !(bound.abs() <= MAX_LOG_STD || bound.to_string() == none) {
                let problem =
                    format!("{key} is {bound}, allowed is -{MAX_LOG_STD} to {MAX_LOG_STD}, or {none} for no bound");
                return Err(ModelError::Options(problem));
            }
        }
        if log_std_min <= log_std_max {
            Ok(())
        } else {
            Err(ModelError::Options(format!(
                "log_std_min is {log_std_min} and log_std_max is {log_std_max}; the first may not exceed the second"
            )))
        }
    }
}

/// Actor or critic: three linear layers.
#[derive(Debug)]
struct Head {
    layers: [Linear; 3],
}

impl Head {
    fn new(path: &Path<'_>, inputs: i64, outputs: i64) -> Self {
        Self {
            layers: [
                Linear::new(&(path / "first"), inputs, WIDTH, ORTHOGONAL),
                Linear::new(&(path / "second"), WIDTH, WIDTH, ORTHOGONAL),
                Linear::new(&(path / "output"), WIDTH, outputs, SMALL_NORMAL),
            ],
        }
    }

    fn forward(&self, x: &Tensor) -> Tensor {
        let [first, second, output] = &self.layers;
        output.forward(&leaky_relu(second.forward(&leaky_relu(first.forward(x)))))
    }
}
