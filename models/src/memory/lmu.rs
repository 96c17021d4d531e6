//! `lmu`: Legendre memory unit (Voelker, Kajić and Eliasmith, 2019).
//!
//! ```text
//! u  = e_x . x + e_h . h + e_m . m        one number
//! m' = A m + B u                          the last theta values of u, as Legendre polynomials' coefficients
//! h' = tanh(W_x x + W_h h + W_m m'),      y = h'
//! ```
//!
//! Learned: `encoder_input [1, inputs]` e_x and `encoder_state [1, hidden]` e_h, uniform within `+-sqrt(3 / columns)`;
//! `encoder_memory [1, memory]` e_m, 0; `weight_input [hidden, inputs]` W_x, `weight_state [hidden, hidden]` W_h and
//! `weight_memory [hidden, memory]` W_m, Xavier normal. There are no biases. A and B ([`sliding_window`]) follow from the
//! options; they are not learned and not saved. State: `h [rows, hidden]` and `m [rows, memory]`. Nothing differs from
//! upstream POPGym.
//!
//! On the CPU a scan has a backward of its own, see `lmu_cpu.rs`.

use serde::{Deserialize, Serialize};
use tch::nn::{Init, Path};
use tch::{Device, Kind, Tensor};

use super::elementwise::on_cpu;
use super::{Memory, MemoryKind, Scan, State, check_hidden_size, check_size, lmu_cpu, scan_by_steps};
use crate::packing::Packing;

/// Largest order of the memory; the discretisation's time and memory grow with its cube and square.
const MAX_ORDER: i64 = 1024;
/// Longest window, in steps.
const MAX_THETA: f64 = 65_536.0;

/// Options of [`Lmu`].
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LmuOptions {
    /// Width of h and of the output, 1 to 4,096; the paper's is 256.
    pub hidden_size: i64,
    /// Length of the window that the memory holds, in time steps, 1 to 65,536; the paper's is 64.
    pub theta: f64,
    /// Number of Legendre polynomials that describe the window, 1 to 1,024; the paper's is 256.
    pub memory_size: i64,
}

impl Default for LmuOptions {
    fn default() -> Self {
        Self { hidden_size: 256, theta: 64.0, memory_size: 256 }
    }
}

/// One LMU layer.
#[derive(Debug)]
pub struct Lmu {
    hidden_size: i64,
    memory_size: i64,
    parameters: Parameters,
}

/// The learned parameters and the fixed ones, shapes as above; `window_input` is `[1, memory]`.
#[derive(Debug)]
pub(super) struct Parameters {
    pub(super) encoder_input: Tensor,
    pub(super) encoder_state: Tensor,
    pub(super) encoder_memory: Tensor,
    pub(super) weight_input: Tensor,
    pub(super) weight_state: Tensor,
    pub(super) weight_memory: Tensor,
    pub(super) window: Tensor,
    pub(super) window_input: Tensor,
}

impl Parameters {
    /// The learned ones.
    pub(super) fn learned(&self) -> [&Tensor; 6] {
        [
            &self.encoder_input,
            &self.encoder_state,
            &self.encoder_memory,
            &self.weight_input,
            &self.weight_state,
            &self.weight_memory,
        ]
    }

    /// The same tensors.
    pub(super) fn shallow_clone(&self) -> Self {
        let [encoder_input, encoder_state, encoder_memory, weight_input, weight_state, weight_memory] =
            self.learned().map(Tensor::shallow_clone);
        let [window, window_input] = [&self.window, &self.window_input].map(Tensor::shallow_clone);
        Self {
            encoder_input,
            encoder_state,
            encoder_memory,
            weight_input,
            weight_state,
            weight_memory,
            window,
            window_input,
        }
    }
}

/// A `[order, order]` and B `[order]` in f64: `m' = A m + B u` holds the last `theta` steps of u. With
/// `a_ij = (2i + 1) / theta * (-1 if i < j else (-1)^(i - j + 1))` and `b_i = (2i + 1) / theta * (-1)^i` the system
/// `dm/dt = a m + b u` is Padé's approximation of a delay (Voelker et al., 2019); between two steps u is held
/// (zero-order hold), so that `exp([a b; 0 0]) = [A B; 0 1]`.
pub fn sliding_window(order: i64, theta: f64) -> (Tensor, Tensor) {
    let n = order + 1;
    let sign = |power: i64| if power % 2 == 0 { 1.0 } else { -1.0 };
    let entry = |i: i64, j: i64| match (i == order, j == order) {
        (true, _) => 0.0,
        (false, true) => (2 * i + 1) as f64 / theta * sign(i),
        (false, false) => (2 * i + 1) as f64 / theta * if i < j { -1.0 } else { sign(i - j + 1) },
    };
    let numbers: Vec<f64> = (0..n * n).map(|k| entry(k / n, k % n)).collect();
    let exp = Tensor::from_slice(&numbers).view([n, n]).matrix_exp().narrow(0, 0, order);
    (exp.narrow(1, 0, order).contiguous(), exp.select(1, order).contiguous())
}

impl MemoryKind for Lmu {
    const NAME: &'static str = "lmu";
    const PAPER_NAME: &'static str = "LMU";
    const PAPER: &'static str = "Voelker et al., 2019";
    type Options = LmuOptions;

    fn new(path: &Path<'_>, input_width: i64, options: &LmuOptions) -> Result<Self, String> {
        let hidden_size = check_hidden_size(options.hidden_size)?;
        let memory_size = check_size("memory_size", options.memory_size, MAX_ORDER)?;
        let theta = options.theta;
        if !(1.0..=MAX_THETA).contains(&theta) {
            return Err(format!("`theta` is {theta}, allowed is 1..={MAX_THETA}"));
        }
        let (window, window_input) = sliding_window(memory_size, theta);
        let constant = |x: &Tensor| x.to_kind(Kind::Float).to_device(path.device());
        let encoder = |name, width: i64| {
            let bound = (3.0 / width as f64).sqrt();
            path.var(name, &[1, width], Init::Uniform { lo: -bound, up: bound })
        };
        let xavier = |name, width: i64| {
            let stdev = (2.0 / (hidden_size + width) as f64).sqrt();
            path.var(name, &[hidden_size, width], Init::Randn { mean: 0.0, stdev })
        };
        let parameters = Parameters {
            encoder_input: encoder("encoder_input", input_width),
            encoder_state: encoder("encoder_state", hidden_size),
            encoder_memory: path.var("encoder_memory", &[1, memory_size], Init::Const(0.0)),
            weight_input: xavier("weight_input", input_width),
            weight_state: xavier("weight_state", hidden_size),
            weight_memory: xavier("weight_memory", memory_size),
            window: constant(&window),
            window_input: constant(&window_input).unsqueeze(0),
        };
        Ok(Self { hidden_size, memory_size, parameters })
    }
}

impl Memory for Lmu {
    fn output_width(&self) -> i64 {
        self.hidden_size
    }

    fn initial_state(&self, rows: i64, device: Device) -> State {
        let zeros = |width| Tensor::zeros([rows, width], (Kind::Float, device));
        State(vec![zeros(self.hidden_size), zeros(self.memory_size)])
    }

    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        let p = &self.parameters;
        let (h, m) = (&state.0[0], &state.0[1]);
        let [window, window_input] = [&p.window, &p.window_input].map(|x| x.to_kind(input.kind()));
        // Not as products with one column, whose bits would depend on the number of rows.
        let dot = |x: &Tensor, e: &Tensor| (x * e).sum_dim_intlist(1, true, None::<Kind>);
        let u = dot(input, &p.encoder_input) + dot(h, &p.encoder_state) + dot(m, &p.encoder_memory);
        let product = |x: &Tensor, weight: &Tensor| x.linear(weight, None::<&Tensor>);
        let m = product(m, &window) + u * window_input;
        let h = product(input, &p.weight_input) + product(h, &p.weight_state) + product(&m, &p.weight_memory);
        let h = h.tanh();
        (h.shallow_clone(), State(vec![h, m]))
    }

    fn act(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        if !on_cpu(input) {
            return tch::no_grad(|| self.step(input, state));
        }
        lmu_cpu::act(&self.parameters, input, state)
    }

    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        if !on_cpu(input) {
            return scan_by_steps(self, input, packing, state);
        }
        lmu_cpu::scan(&self.parameters, input, packing, state)
    }
}
