//! Memories: the recurrent core of a policy, as one function in three forms.
//!
//! - [`Memory::step`]: one time step for a batch of rows, of libtorch's operators alone: the definition;
//! - [`Memory::act`]: the same without gradients, as fast as the CPU can; what actors run;
//! - [`Memory::scan`]: whole packed sequences, in the most parallel form the mathematics allows; what the learner runs.
//!
//! They agree within `1e-5 max(1, largest |output|)`. Only `step` must be written; the others follow from it, slowly, as
//! in `tests/examples/custom/src/decay.rs`, a memory of a user's own. One of this crate also needs its `mod` line here, a
//! line in [`Registry::standard`], and a row in the table of sizes in `tests/memory.rs`; all other tests of this crate then
//! run on it without being told.

use std::sync::Arc;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use tch::nn::{Path, VarStore};
use tch::{Device, Tensor};

use crate::ModelError;
use crate::packing::Packing;

mod cell_weights;
mod dnc;
mod dnc_backward;
mod dnc_cells;
mod dnc_cpu;
mod dnc_forward;
mod elementwise;
mod elman;
mod elman_cpu;
mod fart;
mod frame_stack;
mod fwp;
mod gru;
mod gru_cpu;
mod indrnn;
mod indrnn_cpu;
mod linear_attention;
mod lmu;
mod lmu_cpu;
mod lstm;
mod lstm_cpu;
mod mlp;
mod pos_mlp;
mod recurrent_cpu;
mod s4d;
mod s4d_block_cpu;
mod s4d_cpu;
mod s4d_scan_cpu;
mod tcn;
mod trajectory;
mod windows;

pub use dnc::{Dnc, DncOptions};
pub use elman::Elman;
pub use fart::{Fart, FartOptions};
pub use frame_stack::{FrameStack, FrameStackOptions};
pub use fwp::{Fwp, FwpOptions};
pub use gru::Gru;
pub use indrnn::IndRnn;
pub use lmu::{Lmu, LmuOptions, sliding_window};
pub use lstm::Lstm;
pub use mlp::Mlp;
pub use pos_mlp::PosMlp;
pub use s4d::{S4d, S4dOptions};
pub use tcn::{Tcn, TcnOptions};

/// The recurrent state of a batch: tensors with one row a sequence (`[rows, ...]`).
#[derive(Debug, Default)]
pub struct State(pub Vec<Tensor>);

impl State {
    /// Sets these rows to zero, the state at the start of an episode.
    pub fn reset_rows(&mut self, rows: &[i64]) {
        if rows.is_empty() {
            return;
        }
        for tensor in &mut self.0 {
            let index = Tensor::from_slice(rows).to_device(tensor.device());
            let _ = tensor.index_fill_(0, &index, 0.0);
        }
    }

    /// The state with just these rows, in this order.
    #[must_use]
    pub fn select(&self, rows: &[i64]) -> State {
        State(
            self.0
                .iter()
                .map(|tensor| tensor.index_select(0, &Tensor::from_slice(rows).to_device(tensor.device())))
                .collect(),
        )
    }

    /// The state of `rows` rows from `start` on.
    fn narrow(&self, start: i64, rows: i64) -> State {
        State(self.0.iter().map(|tensor| tensor.narrow(0, start, rows)).collect())
    }

    /// The state's first `rows` rows, cut off from the graph that computed them.
    pub(crate) fn carry(&self, rows: i64) -> State {
        State(self.0.iter().map(|tensor| tensor.narrow(0, 0, rows).detach()).collect())
    }
}

/// Takes d loss / d output `[rows, output width]`, adds to the memory's own parameter gradients, and returns
/// d loss / d input `[rows, input width]`.
pub type Backward = Box<dyn FnOnce(&Tensor) -> Tensor>;

/// What [`Memory::scan`] returns.
pub struct Scan {
    /// Outputs of all packed rows, `[rows, output width]`.
    pub output: Tensor,
    /// State of each sequence after its last step, in packed order.
    pub state: State,
    /// Time steps computed; more than the packed rows where a memory pads.
    pub computed_steps: i64,
    /// The memory's own backward, for one that does not leave it to autograd. `output` is then detached.
    pub backward: Option<Backward>,
}

/// A memory: a function of an input sequence, step by step or all at once.
pub trait Memory: Send {
    /// Width of an output vector.
    fn output_width(&self) -> i64;

    /// The state before the first step, all zeros, for `rows` sequences.
    fn initial_state(&self, rows: i64, device: Device) -> State;

    /// Whether the policy adds a positional encoding to the input.
    fn positional(&self) -> bool {
        false
    }

    /// One time step: `input [rows, input width]` to `output [rows, output width]` and the next state. Made of libtorch's
    /// operators alone, with no number of rows read, so that it can be differentiated, run in f64, and traced.
    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State);

    /// As [`Memory::step`], without gradients.
    fn act(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        tch::no_grad(|| self.step(input, state))
    }

    /// Whole sequences: packed `input [rows, input width]`; `state` before their first step, in packed order.
    ///
    /// Gradients, those of the parameters too, are to be had only if `input` requires them. None flow into `state`.
    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        scan_by_steps(self, input, packing, state)
    }

    /// Puts parameters back where they are allowed to be: called after every optimiser's step.
    fn constrain(&self) {}
}

/// [`Memory::scan`] as a loop over [`Memory::step`], with autograd's gradients.
pub fn scan_by_steps<M: Memory + ?Sized>(memory: &M, input: &Tensor, packing: &Packing, state: &State) -> Scan {
    let mut state = State(state.0.iter().map(Tensor::shallow_clone).collect());
    // States of sequences that have ended, the shortest first.
    let mut ended: Vec<State> = Vec::new();
    let mut outputs = Vec::new();
    for now in packing.steps() {
        let (alive, before) = (now.len() as i64, state.0.first().map_or(0, |tensor| tensor.size()[0]));
        if alive < before {
            ended.push(state.narrow(alive, before - alive));
            state = state.narrow(0, alive);
        }
        let (output, next) = memory.step(&input.narrow(0, now.start as i64, alive), &state);
        outputs.push(output);
        state = next;
    }
    ended.push(state);
    let last = (0..ended[0].0.len()).map(|i| {
        let parts: Vec<&Tensor> = ended.iter().rev().map(|state| &state.0[i]).collect();
        Tensor::cat(&parts, 0)
    });
    let state = State(last.collect());
    Scan { output: Tensor::cat(&outputs, 0), state, computed_steps: packing.rows(), backward: None }
}

/// The options of a memory whose only one is its width.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HiddenSize {
    /// Width of the state, where there is one, and of the output, 1 to 4,096; the paper's is 256.
    pub hidden_size: i64,
}

impl Default for HiddenSize {
    fn default() -> Self {
        Self { hidden_size: 256 }
    }
}

/// A kind of memory that can be built by name.
pub trait MemoryKind: Memory + Sized + 'static {
    /// Its name in configurations, for example `gru`.
    const NAME: &'static str;
    /// Its name in POPGym's tables, for example `GRU`.
    const PAPER_NAME: &'static str;
    /// Where it comes from, for example `Cho et al., 2014`.
    const PAPER: &'static str;
    /// Its options: the keys of the configuration's `[memory]` table beside `name`.
    type Options: Serialize + DeserializeOwned + Default;

    /// A memory with fresh weights below `path`.
    ///
    /// # Errors
    /// Which option is impossible, its value, and what is allowed.
    fn new(path: &Path<'_>, input_width: i64, options: &Self::Options) -> Result<Self, String>;
}

/// How large a memory is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sizes {
    /// Numbers that are learned.
    pub parameters: usize,
    /// Numbers that one sequence carries from step to step.
    pub state: usize,
}

type Build = dyn Fn(&Path<'_>, i64, &toml::Table) -> Result<Box<dyn Memory>, String> + Send + Sync;
type Resolve = dyn Fn(&toml::Table) -> Result<toml::Table, String> + Send + Sync;

/// A memory's entry in the [`Registry`].
#[derive(Clone)]
pub struct Entry {
    /// Its name in configurations.
    pub name: &'static str,
    /// Its name in POPGym's tables.
    pub paper_name: &'static str,
    /// Where it comes from.
    pub paper: &'static str,
    build: Arc<Build>,
    resolve: Arc<Resolve>,
}

impl Entry {
    /// The options with every default filled in.
    ///
    /// # Errors
    /// The key that is unknown or has a wrong type.
    pub fn resolve(&self, options: &toml::Table) -> Result<toml::Table, ModelError> {
        (self.resolve)(options).map_err(|problem| self.options_error(problem))
    }

    /// A memory with fresh weights below `path`.
    ///
    /// # Errors
    /// The option that is wrong.
    pub fn build(
        &self,
        path: &Path<'_>,
        input_width: i64,
        options: &toml::Table,
    ) -> Result<Box<dyn Memory>, ModelError> {
        (self.build)(path, input_width, options).map_err(|problem| self.options_error(problem))
    }

    /// How large the memory is with these options.
    ///
    /// # Errors
    /// The option that is wrong.
    pub fn sizes(&self, input_width: i64, options: &toml::Table) -> Result<Sizes, ModelError> {
        let store = VarStore::new(Device::Cpu);
        let memory = self.build(&store.root(), input_width, options)?;
        let numbers = |tensors: &[Tensor]| tensors.iter().map(Tensor::numel).sum();
        Ok(Sizes {
            parameters: numbers(&store.trainable_variables()),
            state: numbers(&memory.initial_state(1, Device::Cpu).0),
        })
    }

    fn options_error(&self, problem: String) -> ModelError {
        ModelError::MemoryOptions { memory: self.name.to_owned(), problem }
    }
}

/// The memories that can be named.
#[derive(Clone, Default)]
pub struct Registry {
    entries: Vec<Entry>,
}

impl Registry {
    /// The memories of this crate.
    pub fn standard() -> Self {
        let mut registry = Self::default();
        registry.register::<Mlp>();
        registry.register::<PosMlp>();
        registry.register::<Elman>();
        registry.register::<Lstm>();
        registry.register::<Gru>();
        registry.register::<IndRnn>();
        registry.register::<Dnc>();
        registry.register::<Fart>();
        registry.register::<Fwp>();
        registry.register::<FrameStack>();
        registry.register::<Tcn>();
        registry.register::<Lmu>();
        registry.register::<S4d>();
        registry
    }

    /// Adds a kind of memory; one of the same name is replaced.
    pub fn register<M: MemoryKind>(&mut self) {
        self.entries.retain(|entry| entry.name != M::NAME);
        self.entries.push(Entry {
            name: M::NAME,
            paper_name: M::PAPER_NAME,
            paper: M::PAPER,
            build: Arc::new(|path, input_width, options| {
                M::new(path, input_width, &parse::<M>(options)?).map(|memory| Box::new(memory) as Box<dyn Memory>)
            }),
            resolve: Arc::new(|options| toml::Table::try_from(parse::<M>(options)?).map_err(|error| error.to_string())),
        });
    }

    /// All entries, in the order of registration.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// The entry called `name`.
    ///
    /// # Errors
    /// An unknown name, with the nearest known one.
    pub fn get(&self, name: &str) -> Result<&Entry, ModelError> {
        self.entries.iter().find(|entry| entry.name == name).ok_or_else(|| {
            let wanted = name.to_lowercase();
            let likeness = |entry: &Entry| strsim::jaro_winkler(&entry.name.to_lowercase(), &wanted);
            let nearest = self.entries.iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b)));
            ModelError::UnknownMemory {
                name: name.to_owned(),
                nearest: nearest.map_or_else(String::new, |entry| entry.name.to_owned()),
            }
        })
    }
}

fn parse<M: MemoryKind>(options: &toml::Table) -> Result<M::Options, String> {
    // Its message alone does not say which key a wrong type stands at.
    options.clone().try_into().map_err(|error: toml::de::Error| error.to_string().trim().replace('\n', " "))
}

/// Adds to the parameters' gradients as autograd would: for a memory with a backward of its own.
fn add_gradients(parameters: &[&Tensor], gradients: &[Tensor]) {
    // tch cannot set a gradient; but d (p . g) / dp = g.
    let products = parameters.iter().zip(gradients).filter(|(parameter, _)| parameter.requires_grad());
    let products = products.map(|(parameter, gradient)| parameter.view(-1).dot(&gradient.view(-1)));
    if let Some(sum) = products.reduce(|a, b| a + b) {
        sum.backward();
    }
}

/// An option `key` that must be 1 to `most`.
fn check_size(key: &str, value: i64, most: i64) -> Result<i64, String> {
    if (1..=most).contains(&value) { Ok(value) } else { Err(format!("`{key}` is {value}, allowed is 1..={most}")) }
}

/// The option `hidden_size`: layers are as large as its square.
fn check_hidden_size(value: i64) -> Result<i64, String> {
    check_size("hidden_size", value, 4096)
}
