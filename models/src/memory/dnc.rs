//! `dnc`: Differentiable Neural Computer, an LSTM that reads and writes an external memory (Graves et al., 2016; the
//! variant of the package `dnc` 1.1.0).
//!
//! With N cells of width W, R read heads and one write head; x is the input, a prime the value after the step:
//!
//! ```text
//! h', c' = LSTM([x ; r], h, c)                          gates i, f, g, o
//! xi = W_xi h' + b_xi                                   in this order:
//!   R read keys kr (tanh), R read strengths sr (softplus), write key kw (tanh), write strength sw (softplus),
//!   erase e (sigmoid), write vector v (tanh), R free gates f (sigmoid), allocation gate ga (sigmoid),
//!   write gate gw (sigmoid), R times three read modes m (softmax): backward, forward, content
//! content(M, k, s) = softmax over cells of s (M k) / (|M| |k| + 1e-6)
//! U' = (U + (1 - U) w) prod_r (1 - f_r wr_r)            usage
//! u = 1e-6 + (1 - 1e-6) U', in rising order;  a = (1 - u) times the product of all u before     allocation
//! w' = gw (ga a + (1 - ga) content(M, kw, sw))          write weights
//! M' = M (1 - w' e^T) + w' v^T                          memory
//! L'_ij = (1 - w'_i - w'_j) L_ij + w'_i p_j, L'_ii = 0  link: j was written before i
//! p' = (1 - sum w') p + w'                              precedence
//! wr' = m_0 (L'^T wr) + m_1 (L' wr) + m_2 content(M', kr, sr)     read weights
//! r' = wr' M';   y = W_o [h' ; r'] + b_o
//! ```
//!
//! `weight_input [4 hidden, inputs + R W]`, `weight_state [4 hidden, hidden]`, two biases `[4 hidden]`,
//! `weight_interface [R W + 3 W + 5 R + 3, hidden]`, `weight_output [hidden, hidden + R W]`. State, in this order:
//! `h`, `c` `[rows, hidden]`, memory `[rows, N, W]`, link `[rows, N, N]`, precedence `[rows, N]`, read weights
//! `[rows, R, N]`, write weights, usage `[rows, N]`, read vectors `[rows, R W]`.
//!
//! Equal usages are ordered by their cell, and gradients pass through the usages but not through their order. The output
//! jumps where two usages cross: rounding can decide which of two cells as good as equally used is written.
//!
//! What differs from POPGym:
//! - Its training form gives the controller read vectors of zero, while its actors feed them back. Here every form does.
//! - It builds the memory after the optimiser, which so never trains it. Here it is trained.
//! - It clips the controller's output to +-20. An LSTM's is within +-1.
//!
//! On the CPU see `dnc_cpu.rs`.

use serde::{Deserialize, Serialize};
use tch::nn::Path;
use tch::{Device, Kind, Tensor};

use super::elementwise::on_cpu;
use super::{Memory, MemoryKind, Scan, State, dnc_cpu, scan_by_steps};
use crate::init::uniform;
use crate::packing::Packing;

/// Keeps logarithmic scales away from zero: in usages, and under the cosine's fraction.
pub(super) const SMALL: f64 = 1e-6;

/// Options of [`Dnc`].
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DncOptions {
    /// Width of the controller's state and of the output, 1 to 4,096; the paper's is 256.
    pub hidden_size: i64,
    /// Number of memory cells; the paper's is 16.
    pub cells: i64,
    /// Width of a memory cell; the paper's is 16.
    pub cell_size: i64,
    /// Number of read heads; the paper's is 4.
    pub read_heads: i64,
}

impl Default for DncOptions {
    fn default() -> Self {
        Self { hidden_size: 256, cells: 16, cell_size: 16, read_heads: 4 }
    }
}

/// A differentiable neural computer with one LSTM layer as its controller.
#[derive(Debug)]
pub struct Dnc {
    pub(super) hidden: i64,
    pub(super) cells: i64,
    pub(super) width: i64,
    pub(super) heads: i64,
    pub(super) weight_input: Tensor,
    pub(super) weight_state: Tensor,
    pub(super) bias_input: Tensor,
    pub(super) bias_state: Tensor,
    pub(super) weight_interface: Tensor,
    pub(super) bias_interface: Tensor,
    pub(super) weight_output: Tensor,
    pub(super) bias_output: Tensor,
}

impl MemoryKind for Dnc {
    const NAME: &'static str = "dnc";
    const PAPER_NAME: &'static str = "DNC";
    const PAPER: &'static str = "Graves et al., 2016";
    type Options = DncOptions;

    fn new(path: &Path<'_>, input_width: i64, options: &DncOptions) -> Result<Self, String> {
        let hidden = super::check_hidden_size(options.hidden_size)?;
        let cells = super::check_size("cells", options.cells, 512)?;
        let width = super::check_size("cell_size", options.cell_size, 512)?;
        let heads = super::check_size("read_heads", options.read_heads, 64)?;
        let (gates, reads, interface) = (4 * hidden, heads * width, interface_width(width, heads));
        let init = uniform(hidden);
        Ok(Self {
            hidden,
            cells,
            width,
            heads,
            weight_input: path.var("weight_input", &[gates, input_width + reads], init),
            weight_state: path.var("weight_state", &[gates, hidden], init),
            bias_input: path.var("bias_input", &[gates], init),
            bias_state: path.var("bias_state", &[gates], init),
            weight_interface: path.var("weight_interface", &[interface, hidden], init),
            bias_interface: path.var("bias_interface", &[interface], init),
            weight_output: path.var("weight_output", &[hidden, hidden + reads], uniform(hidden + reads)),
            bias_output: path.var("bias_output", &[hidden], uniform(hidden + reads)),
        })
    }
}

fn interface_width(width: i64, heads: i64) -> i64 {
    heads * width + 3 * width + 5 * heads + 3
}

impl Memory for Dnc {
    fn output_width(&self) -> i64 {
        self.hidden
    }

    fn initial_state(&self, rows: i64, device: Device) -> State {
        let (n, w, r) = (self.cells, self.width, self.heads);
        let zeros = |shape: &[i64]| Tensor::zeros([&[rows], shape].concat(), (Kind::Float, device));
        let controller = [zeros(&[self.hidden]), zeros(&[self.hidden])];
        let memory = [zeros(&[n, w]), zeros(&[n, n]), zeros(&[n]), zeros(&[r, n]), zeros(&[n]), zeros(&[n])];
        State(controller.into_iter().chain(memory).chain([zeros(&[r * w])]).collect())
    }

    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        let [h, c, memory, link, precedence, read_weights, write_weights, usage, reads] = &state.0[..] else {
            panic!("nine tensors")
        };
        let (h, c) = Tensor::cat(&[input, reads], 1).lstm_cell(
            &[h, c],
            &self.weight_input,
            &self.weight_state,
            Some(&self.bias_input),
            Some(&self.bias_state),
        );
        let xi = Interface::new(self, &h.linear(&self.weight_interface, Some(&self.bias_interface)));

        let kept: Tensor = 1.0 - xi.free_gates * read_weights;
        let retention = kept.prod_dim_int(1, false, None::<Kind>);
        let usage = (usage + (1.0 - usage) * write_weights) * retention;
        let allocated = &xi.allocation_gate * self.allocation(&usage);
        let content = content(memory, &xi.write_key, &xi.write_strength).squeeze_dim(1);
        let w: Tensor = &xi.write_gate * (allocated + (1.0 - &xi.allocation_gate) * content);

        let (down, across) = (w.unsqueeze(2), w.unsqueeze(1));
        let memory = memory * (1.0 - &down * xi.erase) + &down * xi.write_vector;
        let others = 1.0 - Tensor::eye(self.cells, (input.kind(), input.device()));
        let stays: Tensor = 1.0 - (&down + across);
        let link = (stays * link + &down * precedence.unsqueeze(1)) * others;
        let precedence = (1.0 - w.sum_dim_intlist(1, true, None::<Kind>)) * precedence + &w;

        let (backward, forward) = (read_weights.matmul(&link), read_weights.matmul(&link.transpose(1, 2)));
        let found = self::content(&memory, &xi.read_keys, &xi.read_strengths);
        let [to_backward, to_forward, to_content] = xi.modes;
        let read_weights = to_backward * backward + to_forward * forward + to_content * found;
        let reads = read_weights.matmul(&memory).flatten(1, 2);
        let output = Tensor::cat(&[&h, &reads], 1).linear(&self.weight_output, Some(&self.bias_output));
        (output, State(vec![h, c, memory, link, precedence, read_weights, w, usage, reads]))
    }

    fn act(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        if on_cpu(input) && input.size()[0] > 0 {
            dnc_cpu::act(self, input, state)
        } else {
            tch::no_grad(|| self.step(input, state))
        }
    }

    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        if on_cpu(input) {
            dnc_cpu::scan(self, input, packing, state)
        } else {
            scan_by_steps(self, input, packing, state)
        }
    }
}

impl Dnc {
    /// The same parameters.
    pub(super) fn shallow_clone(&self) -> Self {
        let Self { hidden, cells, width, heads, .. } = *self;
        Self {
            hidden,
            cells,
            width,
            heads,
            weight_input: self.weight_input.shallow_clone(),
            weight_state: self.weight_state.shallow_clone(),
            bias_input: self.bias_input.shallow_clone(),
            bias_state: self.bias_state.shallow_clone(),
            weight_interface: self.weight_interface.shallow_clone(),
            bias_interface: self.bias_interface.shallow_clone(),
            weight_output: self.weight_output.shallow_clone(),
            bias_output: self.bias_output.shallow_clone(),
        }
    }

    /// How well each cell would do for a new entry, `[rows, cells]`.
    fn allocation(&self, usage: &Tensor) -> Tensor {
        let (rising, order) = (SMALL + (1.0 - SMALL) * usage).sort_stable(true, 1, false);
        let one = rising.narrow(1, 0, 1).ones_like();
        let before = Tensor::cat(&[one, rising.narrow(1, 0, self.cells - 1)], 1).cumprod(1, None::<Kind>);
        usage.zeros_like().scatter(1, &order, &((1.0 - rising) * before))
    }
}

/// Weights over the cells of `memory [rows, cells, width]` by likeness to `keys [rows, keys, width]`, with `strengths
/// [rows, keys, 1]`: `[rows, keys, cells]`.
fn content(memory: &Tensor, keys: &Tensor, strengths: &Tensor) -> Tensor {
    let norm = |x: &Tensor| x.norm_scalaropt_dim(2, 2, false);
    let lengths = norm(keys).unsqueeze(2) * norm(memory).unsqueeze(1) + SMALL;
    (strengths * (keys.matmul(&memory.transpose(1, 2)) / lengths)).softmax(2, None::<Kind>)
}

/// What the controller tells the memory, with sizes of 1 where a rule broadcasts.
struct Interface {
    read_keys: Tensor,
    read_strengths: Tensor,
    write_key: Tensor,
    write_strength: Tensor,
    erase: Tensor,
    write_vector: Tensor,
    free_gates: Tensor,
    allocation_gate: Tensor,
    write_gate: Tensor,
    modes: [Tensor; 3],
}

impl Interface {
    fn new(dnc: &Dnc, xi: &Tensor) -> Self {
        let (w, r) = (dnc.width, dnc.heads);
        let sizes = [r * w, r, w, 1, w, w, r, 1, 1, 3 * r];
        let [read_keys, read_strengths, write_key, write_strength, erase, write_vector, free, allocation, write, modes] =
            &xi.split_with_sizes(sizes, 1)[..]
        else {
            panic!("as many parts as sizes")
        };
        let modes = modes.view([-1, r, 3]).softmax(2, None::<Kind>);
        Self {
            read_keys: read_keys.tanh().view([-1, r, w]),
            read_strengths: read_strengths.softplus().unsqueeze(2),
            write_key: write_key.tanh().unsqueeze(1),
            write_strength: write_strength.softplus().unsqueeze(2),
            erase: erase.sigmoid().unsqueeze(1),
            write_vector: write_vector.tanh().unsqueeze(1),
            free_gates: free.sigmoid().unsqueeze(2),
            allocation_gate: allocation.sigmoid(),
            write_gate: write.sigmoid(),
            modes: [0, 1, 2].map(|mode| modes.narrow(2, mode, 1)),
        }
    }
}
