//! `s4d`: a diagonal state space model ("On the parameterization and initialization of diagonal state space models", Gu et
//! al., 2022; paper: S4D).
//!
//! Each of the `hidden` channels is a system of its own with `modes = state_size / 2` complex modes:
//!
//! ```text
//! u = W_i x + b_i
//! A = -exp(a) + i w         z = A dt         dt = exp(d)
//! Abar = exp(z)             Bbar = B (exp(z) - 1) / A                          zero-order hold
//! s' = Abar s + Bbar u      v = 2 Re(sum_n C_n s'_n) + D u
//! y = GLU(W_o GELU(v) + b_o)                                                    GLU(p, q) = p sigmoid(q)
//! ```
//!
//! `log_decay, frequency [hidden, modes]` (a, w), `state_input, state_output [hidden, modes, 2]` (B, C as real and imaginary
//! parts), `skip, log_step [hidden]` (D, d), `input.weight [hidden, inputs]`, `output.weight [2 hidden, hidden]`.
//! State: real and imaginary part of s, `[rows, hidden, modes]` each.
//!
//! On the CPU a scan is a loop over time between two products of all rows (`s4d_scan_cpu.rs`). Elsewhere, where many small
//! operators cost more, it cuts sequences into chunks of l steps. Within a chunk the system is a convolution with
//! `K[j] = 2 Re(sum_n C_n Bbar_n Abar_n^j)`, one `[l, l]` matrix a channel; the state goes from chunk to chunk:
//!
//! ```text
//! v_i = sum_{j <= i} K[i - j] u_j + D u_i + 2 Re(sum_n C_n Abar_n^{i + 1} s_n)
//! s'  = Abar^l s + sum_j Abar^{l - 1 - j} Bbar u_j
//! ```
//!
//! What differs from upstream POPGym: Abar and Bbar follow from the parameters at every call, where upstream's actors keep
//! those of their first; a scan takes and returns a state; and what upstream never uses is not there (4,096 weights).

use serde::{Deserialize, Serialize};
use tch::nn::{Init, Path};
use tch::{Device, Kind, Tensor};

use super::elementwise::on_cpu;
use super::{Memory, MemoryKind, Scan, State, s4d_cpu, s4d_scan_cpu};
use crate::chunks::Chunks;
use crate::init::{Linear, uniform};
use crate::packing::Packing;

/// Steps that a convolution spans at most.
const CHUNK: i64 = 64;

/// Many small linear systems.
#[derive(Debug)]
pub struct S4d {
    hidden_size: i64,
    modes: i64,
    input: Linear,
    log_decay: Tensor,
    frequency: Tensor,
    state_input: Tensor,
    state_output: Tensor,
    skip: Tensor,
    log_step: Tensor,
    output: Linear,
}

/// The options of [`S4d`].
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct S4dOptions {
    /// Number of channels and width of the output, 1 to 4,096; the paper's is 256.
    pub hidden_size: i64,
    /// Numbers of a channel's state: even, each two are one complex mode; the paper's is 16.
    pub state_size: i64,
}

impl Default for S4dOptions {
    fn default() -> Self {
        Self { hidden_size: 256, state_size: 16 }
    }
}

impl MemoryKind for S4d {
    const NAME: &'static str = "s4d";
    const PAPER_NAME: &'static str = "S4D";
    const PAPER: &'static str = "Gu et al., 2022";
    type Options = S4dOptions;

    fn new(path: &Path<'_>, input_width: i64, options: &S4dOptions) -> Result<Self, String> {
        let hidden_size = super::check_hidden_size(options.hidden_size)?;
        let state_size = options.state_size;
        if !(2..=1024).contains(&state_size) || state_size % 2 != 0 {
            return Err(format!("`state_size` is {state_size}, allowed is an even number of 2..=1024"));
        }
        let modes = state_size / 2;
        let harmonics = Tensor::arange(modes, (Kind::Float, path.device())) * std::f64::consts::PI;
        let ones = Tensor::from_slice(&[1f32, 0.0]).expand([hidden_size, modes, 2], false);
        // Real and imaginary part together have variance 1.
        let complex_normal = Init::Randn { mean: 0.0, stdev: 0.5f64.sqrt() };
        Ok(Self {
            hidden_size,
            modes,
            input: Linear::new(&(path / "input"), input_width, hidden_size, uniform(input_width)),
            log_decay: path.var("log_decay", &[hidden_size, modes], Init::Const(0.5f64.ln())),
            frequency: path.var_copy("frequency", &harmonics.expand([hidden_size, modes], false)),
            state_input: path.var_copy("state_input", &ones),
            state_output: path.var("state_output", &[hidden_size, modes, 2], complex_normal),
            skip: path.var("skip", &[hidden_size], Init::Randn { mean: 0.0, stdev: 1.0 }),
            log_step: path.var("log_step", &[hidden_size], Init::Uniform { lo: 0.001f64.ln(), up: 0.1f64.ln() }),
            output: Linear::new(&(path / "output"), hidden_size, 2 * hidden_size, uniform(hidden_size)),
        })
    }
}

/// A complex tensor as its real and imaginary parts.
struct Complex {
    re: Tensor,
    im: Tensor,
}

impl Complex {
    fn of_pairs(pairs: &Tensor) -> Self {
        Self { re: pairs.select(-1, 0), im: pairs.select(-1, 1) }
    }

    fn times(&self, other: &Complex) -> Complex {
        Complex { re: &self.re * &other.re - &self.im * &other.im, im: &self.re * &other.im + &self.im * &other.re }
    }

    fn over(&self, other: &Complex) -> Complex {
        let square = other.re.square() + other.im.square();
        let product = self.times(&Complex { re: other.re.shallow_clone(), im: -&other.im });
        Complex { re: product.re / &square, im: product.im / &square }
    }

    fn map(&self, function: impl Fn(&Tensor) -> Tensor) -> Complex {
        Complex { re: function(&self.re), im: function(&self.im) }
    }
}

impl S4d {
    /// Abar and Bbar, `[hidden, modes]`.
    fn discretise(&self) -> (Complex, Complex) {
        let step = self.log_step.exp().unsqueeze(1);
        let a = Complex { re: -self.log_decay.exp(), im: self.frequency.shallow_clone() };
        let z = a.map(|part| part * &step);
        let (size, cos, sin) = (z.re.exp(), z.im.cos(), z.im.sin());
        // exp(z) - 1, without the cancellation of a small z.
        let half = (&z.im * 0.5).sin();
        let grown = Complex { re: z.re.expm1() * &cos - half.square() * 2.0, im: &size * &sin };
        let b = Complex::of_pairs(&self.state_input).times(&grown.over(&a));
        (Complex { re: &size * cos, im: size * sin }, b)
    }

    /// What the loop over time on the CPU needs.
    fn layers(&self, with_graph: bool) -> s4d_scan_cpu::Layers {
        let system = || {
            let (a, b) = self.discretise();
            let c = Complex::of_pairs(&self.state_output).map(|part| part * 2.0);
            Tensor::cat(&[a.re, a.im, b.re, b.im, c.re, c.im, self.skip.unsqueeze(1)], 1)
        };
        let [input, output] = [&self.input, &self.output].map(|layer| layer.parameters().map(Tensor::shallow_clone));
        s4d_scan_cpu::Layers { input, output, system: if with_graph { system() } else { tch::no_grad(system) } }
    }

    /// `v [rows, hidden]` to the output.
    fn finish(&self, v: &Tensor) -> Tensor {
        self.output.forward(&v.gelu("none")).glu(1)
    }

    /// The system as matrices over a chunk's steps.
    fn chunk_system(&self, size: i64) -> ChunkSystem {
        let kind = self.skip.kind();
        // The errors of a power grow with the exponent; f64 has room for that.
        let (a, b) = self.discretise();
        let wide = |x: &Tensor| x.to_kind(Kind::Double).unsqueeze(2);
        let c = Complex::of_pairs(&self.state_output).map(|part| wide(part) * 2.0);
        let powers = powers(&a.map(wide), size + 1);
        let driven = b.map(wide).times(&powers.map(|part| part.narrow(2, 0, size)));
        let seen = c.times(&powers.map(|part| part.narrow(2, 1, size)));

        let kernel = c.times(&driven).re.sum_dim_intlist([1i64].as_slice(), false, None::<Kind>).to_kind(kind);
        let skip = self.skip.unsqueeze(1).constant_pad_nd([0, size - 1]);
        // Row i: K[i - size + 1], .., K[i], with zeros for what is before the start.
        let rows = (kernel + skip).constant_pad_nd([size - 1, 0]).unfold(1, size, 1);
        let halves = |x: &Complex, sign: f64| Tensor::cat(&[&x.re, &(&x.im * sign)], 1).to_kind(kind);
        ChunkSystem {
            convolution: rows.flip([2]).transpose(1, 2),
            from_state: halves(&seen, -1.0),
            to_state: halves(&driven.map(|part| part.flip([2])), 1.0).transpose(1, 2),
            powers: powers.map(|part| part.to_kind(kind)),
        }
    }
}

/// What a chunk of steps does to `u [hidden, chunks, steps]` and to states `[hidden, chunks, 2 modes]` (all real parts, then
/// all imaginary ones).
struct ChunkSystem {
    /// From u to v, `[hidden, steps, steps]`.
    convolution: Tensor,
    /// From the state before to v, `[hidden, 2 modes, steps]`.
    from_state: Tensor,
    /// From u to the state after, `[hidden, steps, 2 modes]`.
    to_state: Tensor,
    /// Abar to the powers from 0 to the number of steps, `[hidden, modes, steps + 1]`.
    powers: Complex,
}

impl ChunkSystem {
    /// Powers of Abar, `[hidden, exponents, modes]`.
    fn powers_of(&self, exponents: &Tensor) -> Complex {
        self.powers.map(|part| part.index_select(2, exponents).transpose(1, 2))
    }
}

/// States `[hidden, chunks, 2 modes]` after some steps without input: `factors` are powers of Abar that broadcast to
/// `[hidden, chunks, modes]`.
fn decay(state: &Tensor, factors: &Complex) -> Tensor {
    let parts = state.chunk(2, 2);
    let state = Complex { re: parts[0].shallow_clone(), im: parts[1].shallow_clone() }.times(factors);
    Tensor::cat(&[state.re, state.im], 2)
}

/// `a [.., 1]` to the powers 0 to `count - 1` along the last dimension, by doubling.
fn powers(a: &Complex, count: i64) -> Complex {
    let mut table = Complex { re: a.re.ones_like(), im: a.im.zeros_like() };
    let mut factor = a.map(Tensor::shallow_clone);
    let mut done = 1;
    while done < count {
        let more = table.map(|part| part.narrow(-1, 0, done.min(count - done))).times(&factor);
        table = Complex { re: Tensor::cat(&[table.re, more.re], -1), im: Tensor::cat(&[table.im, more.im], -1) };
        factor = factor.times(&factor);
        done *= 2;
    }
    table
}

impl Memory for S4d {
    fn output_width(&self) -> i64 {
        self.hidden_size
    }

    fn initial_state(&self, rows: i64, device: Device) -> State {
        let zeros = || Tensor::zeros([rows, self.hidden_size, self.modes], (Kind::Float, device));
        State(vec![zeros(), zeros()])
    }

    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        let (a, b) = self.discretise();
        let u = self.input.forward(input);
        let driven = b.map(|part| part * u.unsqueeze(2));
        let decayed = Complex { re: state.0[0].shallow_clone(), im: state.0[1].shallow_clone() }.times(&a);
        let next = Complex { re: decayed.re + driven.re, im: decayed.im + driven.im };
        let c = Complex::of_pairs(&self.state_output);
        let seen = (&next.re * c.re - &next.im * c.im).sum_dim_intlist([2i64].as_slice(), false, None::<Kind>);
        (self.finish(&(seen * 2.0 + u * &self.skip)), State(vec![next.re, next.im]))
    }

    fn act(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        tch::no_grad(|| {
            if !on_cpu(input) || self.modes != s4d_cpu::MODES as i64 {
                return self.step(input, state);
            }
            let (a, b) = self.discretise();
            let c = Complex::of_pairs(&self.state_output);
            let system = [[&a.re, &a.im], [&b.re, &b.im], [&c.re, &c.im]];
            let u = self.input.forward(input);
            let (v, next) = s4d_cpu::step(&u, [&state.0[0], &state.0[1]], system, &self.skip);
            (self.finish(&v), State(next.into()))
        })
    }

    fn scan(&self, input: &Tensor, packing: &Packing, state: &State) -> Scan {
        if on_cpu(input) {
            return s4d_scan_cpu::scan(self.layers(input.requires_grad()), input, packing, state);
        }
        let chunks = Chunks::new(packing, CHUNK, input.device());
        let system = self.chunk_system(chunks.size());
        let [weight, bias] = self.input.parameters();
        let (bias, shape) = (bias.unsqueeze(1), [self.hidden_size, -1, chunks.size()]);
        // Channels first, as the products below want them. Padding follows all other steps of its sequence: it changes none.
        let u = bias.addmm(weight, &chunks.cut(input).flatten(0, 1).tr()).view(shape);

        let initial = Tensor::cat(&[&state.0[0], &state.0[1]], 2).transpose(0, 1);
        let whole = system.powers.map(|part| part.select(2, chunks.size()).unsqueeze(1));
        let driven = u.bmm(&Tensor::cat(&[&system.convolution, &system.to_state], 2));
        let [v, added] = driven.split_with_sizes([chunks.size(), 2 * self.modes], 2).try_into().expect("two parts");
        let before = chunks.carry(&initial, &added, 1, |state, added| decay(state, &whole) + added);
        let v = v.baddbmm(&before, &system.from_state, 1.0, 1.0);
        let v = chunks.join(&v.view([self.hidden_size, -1]).tr().contiguous());

        let last = tch::no_grad(|| {
            // Sequences end at different steps of their last chunks. With the padding at the beginning they end together.
            let (last, is_step) = chunks.cut_last(input);
            let u = (bias * is_step.view([1, -1])).addmm(weight, &last.flatten(0, 1).tr()).view(shape);
            let decayed = decay(&chunks.last(&before, 1), &system.powers_of(chunks.last_lengths()));
            decayed + u.bmm(&system.to_state)
        });
        let state = State(last.transpose(0, 1).chunk(2, 2));
        Scan { output: self.finish(&v), state, computed_steps: chunks.rows(), backward: None }
    }
}
