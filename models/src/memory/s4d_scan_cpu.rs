//! S4D over whole sequences on the CPU: the recurrence itself, and a backward of its own.
//!
//! Channels do not mix within the state, so they are cut into blocks, which threads share; every number is computed in the
//! same order however many threads there are. A block's loop handles one mode of all its channels at a time, over a
//! stretch of steps. With `s' = A s + B u`, `v = Re(C s') + D u` (here C holds the 2 of `s4d.rs`), `d` = d loss / dv and `*`
//! for conjugates:
//!
//! ```text
//! ds' = C* d + (A* ds' of the next step)
//! dA = ds' s*     dB = ds' u     dC = d s'*     dD = d u           summed over steps
//! du = Re(B* ds') + D d
//! ```
//!
//! The forward keeps the state before each stretch only; the backward computes the states within again.

// Only inlined code is compiled for the caller's instruction set.
#![allow(clippy::inline_always)]

use tch::{Kind, Tensor};

use super::elementwise::{floats, floats_mut, widest};
use super::{Backward, Scan, State, add_gradients};
use crate::packing::Packing;

/// Channels of a block.
const LANES: usize = 32;
/// Steps of a stretch.
const STEPS: usize = 32;
/// Numbers of a step and channel beside the modes': of D.
const SKIP: i64 = 1;
/// Steps of a block's mode that are worth a thread, about 0.2 ms.
const THREADS_WORK: usize = 20_000;

/// A number for each channel of a block.
type Lanes = [f32; LANES];

/// The weights and biases of the two linear layers, and the systems between them.
pub(super) struct Layers {
    pub(super) input: [Tensor; 2],
    pub(super) output: [Tensor; 2],
    /// Real and imaginary parts of Abar, Bbar and 2 C, and D: `[hidden, 6 modes + 1]`, with the graph that leads to it.
    pub(super) system: Tensor,
}

/// Whole sequences: packed `input [rows, inputs]`. If `input` wants gradients, what the backward needs is kept.
pub(super) fn scan(layers: Layers, input: &Tensor, packing: &Packing, initial: &State) -> Scan {
    let [hidden, numbers] = layers.system.size()[..] else { unreachable!("a matrix") };
    let work = packing.rows() * numbers / 6 * blocks(hidden);
    let threads = (tch::get_num_threads() as usize).min(work as usize / THREADS_WORK).max(1);
    scan_in_threads(layers, input, packing, initial, threads)
}

fn scan_in_threads(layers: Layers, input: &Tensor, packing: &Packing, initial: &State, threads: usize) -> Scan {
    let keep = input.requires_grad();
    tch::no_grad(|| {
        let [hidden, numbers] = layers.system.size()[..] else { unreachable!("a matrix") };
        let modes = (numbers - SKIP) / 6;
        let plan = Plan::new(packing, threads);
        let system = to_blocks(&layers.system.tr().unsqueeze(0));
        let mut state = to_blocks(&Tensor::cat(&[&initial.0[0], &initial.0[1]], 2).transpose(1, 2));
        let u = input.linear(&layers.input[0], Some(&layers.input[1]));
        let mut v = empty(&[blocks(hidden), packing.rows(), 1]);
        let stretches = if keep { plan.stretches.len() as i64 } else { 0 };
        let mut before = empty(&[blocks(hidden), stretches, 2 * modes]);
        plan.forward(floats(&u), hidden as usize, &system, [&mut state, &mut v, &mut before]);

        let v = from_blocks(&v, hidden).squeeze_dim(1);
        let activated = v.gelu("none");
        let z = activated.linear(&layers.output[0], Some(&layers.output[1]));
        let output = z.glu(1);
        let last = from_blocks(&state, hidden).transpose(1, 2).chunk(2, 2);
        let backward = keep.then(|| {
            let input = input.detach();
            let tape = Tape { layers, plan, input, u, system, before, v, activated, z };
            Box::new(move |grad_output: &Tensor| tape.backward(grad_output)) as Backward
        });
        Scan { output, state: State(last), computed_steps: packing.rows(), backward }
    })
}

/// What the backward needs.
struct Tape {
    layers: Layers,
    plan: Plan,
    input: Tensor,
    u: Tensor,
    /// In blocks, as is `before`.
    system: Tensor,
    /// The state before each stretch.
    before: Tensor,
    v: Tensor,
    /// GELU(v).
    activated: Tensor,
    /// What the GLU is taken of.
    z: Tensor,
}

impl Tape {
    /// From d loss / d output to d loss / d input; adds to the parameters' gradients.
    fn backward(self, grad_output: &Tensor) -> Tensor {
        let Layers { input: [weight, bias], output: [output_weight, output_bias], system } = &self.layers;
        let (gradients, grad_input) = tch::no_grad(|| {
            let sum = |x: &Tensor| x.sum_dim_intlist(0, false, Kind::Float);
            let dz = self.z.glu_backward(grad_output, 1);
            let dv = self.v.gelu_backward(&dz.mm(output_weight), "none").contiguous();
            let mut du = empty(&[self.system.size()[0], self.u.size()[0], 1]);
            let mut grad_system = self.system.zeros_like();
            let [u, dv] = [&self.u, &dv].map(floats);
            let hidden = self.u.size()[1];
            self.plan.backward([u, dv], hidden as usize, [&self.system, &self.before], [&mut grad_system, &mut du]);
            let du = from_blocks(&du, hidden).squeeze_dim(1);
            let grad_system = from_blocks(&grad_system, hidden).squeeze_dim(0).tr().contiguous();
            let layers = [du.tr().mm(&self.input), sum(&du), dz.tr().mm(&self.activated), sum(&dz)];
            let [d_weight, d_bias, d_output_weight, d_output_bias] = layers;
            ([d_weight, d_bias, grad_system, d_output_weight, d_output_bias], du.mm(weight))
        });
        add_gradients(&[weight, bias, system, output_weight, output_bias], &gradients);
        grad_input
    }
}

/// Number of blocks.
fn blocks(hidden: i64) -> i64 {
    (hidden + LANES as i64 - 1) / LANES as i64
}

fn empty(sizes: &[i64]) -> Tensor {
    Tensor::empty([sizes, &[LANES as i64]].concat(), (Kind::Float, tch::Device::Cpu))
}

/// `[a, b, hidden]` to `[blocks, a, b, LANES]`, with zeros in the last block's unused lanes.
fn to_blocks(x: &Tensor) -> Tensor {
    let [a, b, hidden] = x.size()[..] else { unreachable!("three dimensions") };
    let padded = x.constant_pad_nd([0, blocks(hidden) * LANES as i64 - hidden]);
    padded.reshape([a, b, blocks(hidden), LANES as i64]).permute([2, 0, 1, 3]).contiguous()
}

/// The inverse of [`to_blocks`].
fn from_blocks(x: &Tensor, hidden: i64) -> Tensor {
    let [blocks, a, b, lanes] = x.size()[..] else { unreachable!("four dimensions") };
    x.permute([1, 2, 0, 3]).reshape([a, b, blocks * lanes]).narrow(2, 0, hidden).contiguous()
}

/// The numbers of each block.
fn parts(x: &Tensor) -> impl Iterator<Item = &[Lanes]> {
    let lanes = floats(x).as_chunks().0;
    (0..x.size()[0] as usize).map(move |block| &lanes[share(block, x)])
}

fn parts_mut(x: &mut Tensor) -> Vec<&mut [Lanes]> {
    let each = share(0, x).len();
    let count = x.size()[0];
    let mut rest = floats_mut(x).as_chunks_mut().0;
    (0..count).map(|_| rest.split_off_mut(..each).expect("blocks are equal")).collect()
}

/// A block's numbers among all.
fn share(block: usize, x: &Tensor) -> std::ops::Range<usize> {
    let each = x.numel() / LANES / x.size()[0] as usize;
    block * each..(block + 1) * each
}

/// Consecutive steps of a sequence.
struct Stretch {
    sequence: usize,
    /// Its packed rows.
    rows: Vec<usize>,
    /// Whether the sequence ends with it.
    last: bool,
}

/// What is done in which order.
struct Plan {
    /// Sequence by sequence, in the order of time.
    stretches: Vec<Stretch>,
    threads: usize,
}

impl Plan {
    fn new(packing: &Packing, threads: usize) -> Self {
        let starts: Vec<usize> = packing.steps().map(|now| now.start).collect();
        let mut stretches = Vec::new();
        for (sequence, &length) in packing.lengths().iter().enumerate() {
            let steps = &starts[..length as usize];
            stretches.extend(steps.chunks(STEPS).map(|starts| {
                let rows = starts.iter().map(|start| start + sequence).collect();
                Stretch { sequence, rows, last: false }
            }));
            stretches.last_mut().expect("no sequence is empty").last = true;
        }
        Self { stretches, threads }
    }

    /// From `u [rows, hidden]` and `system` to v; turns `state` from the initial into the last one; keeps the state before
    /// each stretch in `before` if that has room for it. All but u in blocks.
    fn forward(&self, u: &[f32], hidden: usize, system: &Tensor, [state, v, before]: [&mut Tensor; 3]) {
        let written = parts_mut(state).into_iter().zip(parts_mut(v)).zip(parts_mut(before));
        let work = parts(system).zip(written).enumerate().map(|(block, (system, ((state, v), before)))| {
            let u = Columns { numbers: u, hidden, first: block * LANES };
            Forward { stretches: &self.stretches, u, system: System::new(system), state, v, before }
        });
        in_threads(self.threads, work.collect(), |block| forward(block));
    }

    /// From u and d loss / dv `[rows, hidden]` to `grad_system`, which is added to, and du. All but the first two in blocks.
    fn backward(
        &self,
        rows: [&[f32]; 2],
        hidden: usize,
        [system, before]: [&Tensor; 2],
        [grad_system, du]: [&mut Tensor; 2],
    ) {
        let written = parts_mut(grad_system).into_iter().zip(parts_mut(du));
        let work = parts(system).zip(parts(before)).zip(written).enumerate();
        let work = work.map(|(block, ((system, before), (grad_system, du)))| {
            let [u, dv] = rows.map(|numbers| Columns { numbers, hidden, first: block * LANES });
            Reverse { stretches: &self.stretches, u, dv, system: System::new(system), before, grad_system, du }
        });
        in_threads(self.threads, work.collect(), |block| backward(block));
    }
}

/// Does the work of all blocks, each thread a share of them.
fn in_threads<T: Send>(threads: usize, mut blocks: Vec<T>, work: impl Fn(T) + Sync) {
    let (share, work) = (blocks.len().div_ceil(threads), &work);
    std::thread::scope(|scope| {
        while blocks.len() > share {
            let others = blocks.split_off(blocks.len() - share);
            scope.spawn(move || others.into_iter().for_each(work));
        }
        blocks.into_iter().for_each(work);
    });
}

/// A block's columns of a matrix `[rows, hidden]`.
#[derive(Clone, Copy)]
struct Columns<'a> {
    numbers: &'a [f32],
    hidden: usize,
    first: usize,
}

impl Columns<'_> {
    #[inline(always)]
    fn gather(&self, rows: &[usize]) -> [Lanes; STEPS] {
        let lanes = LANES.min(self.hidden - self.first);
        let mut gathered = [[0.0; LANES]; STEPS];
        for (to, row) in gathered.iter_mut().zip(rows) {
            to[..lanes].copy_from_slice(&self.numbers[row * self.hidden + self.first..][..lanes]);
        }
        gathered
    }
}

/// A block's system.
#[derive(Clone, Copy)]
struct System<'a> {
    numbers: &'a [Lanes],
    modes: usize,
    skip: &'a Lanes,
}

impl<'a> System<'a> {
    fn new(numbers: &'a [Lanes]) -> Self {
        let (skip, numbers) = numbers.split_last().expect("D is there");
        Self { numbers, modes: numbers.len() / 6, skip }
    }

    /// Real and imaginary parts of a mode's A, B and C.
    #[inline(always)]
    fn mode(&self, mode: usize) -> [&'a Lanes; 6] {
        std::array::from_fn(|part| &self.numbers[part * self.modes + mode])
    }
}

/// A block's forward.
struct Forward<'a> {
    stretches: &'a [Stretch],
    u: Columns<'a>,
    system: System<'a>,
    /// `[sequences, 2 modes]`: all real parts, then all imaginary ones.
    state: &'a mut [Lanes],
    /// `[rows]`.
    v: &'a mut [Lanes],
    /// `[stretches, 2 modes]` or nothing.
    before: &'a mut [Lanes],
}

widest! {
    fn forward(block: Forward<'_>) = forward_block
}

#[inline(always)]
fn forward_block(block: Forward<'_>) {
    let Forward { stretches, u, system, state, v, before } = block;
    let modes = system.modes;
    for (i, stretch) in stretches.iter().enumerate() {
        let state = &mut state[stretch.sequence * 2 * modes..][..2 * modes];
        if !before.is_empty() {
            before[i * 2 * modes..][..2 * modes].copy_from_slice(state);
        }
        let u = u.gather(&stretch.rows);
        let u = &u[..stretch.rows.len()];
        let mut seen = [[0.0; LANES]; STEPS];
        for (seen, u) in seen.iter_mut().zip(u) {
            for l in 0..LANES {
                seen[l] = u[l] * system.skip[l];
            }
        }
        let (re, im) = state.split_at_mut(modes);
        for mode in 0..modes {
            forward_mode(system.mode(mode), u, &mut re[mode], &mut im[mode], &mut seen);
        }
        for (seen, &row) in seen.iter().zip(&stretch.rows) {
            v[row] = *seen;
        }
    }
}

/// One mode's steps: advances its state and adds what is seen of it.
#[inline(always)]
fn forward_mode(system: [&Lanes; 6], u: &[Lanes], re: &mut Lanes, im: &mut Lanes, seen: &mut [Lanes; STEPS]) {
    let [_, _, _, _, c_re, c_im] = system;
    for (u, seen) in u.iter().zip(seen) {
        (*re, *im) = advance(system, u, re, im);
        for l in 0..LANES {
            seen[l] += re[l] * c_re[l] - im[l] * c_im[l];
        }
    }
}

/// The next state of one mode.
#[inline(always)]
fn advance([a_re, a_im, b_re, b_im, ..]: [&Lanes; 6], u: &Lanes, re: &Lanes, im: &Lanes) -> (Lanes, Lanes) {
    let (mut next_re, mut next_im) = ([0.0; LANES], [0.0; LANES]);
    for l in 0..LANES {
        next_re[l] = (re[l] * a_re[l] - im[l] * a_im[l]) + u[l] * b_re[l];
        next_im[l] = (re[l] * a_im[l] + im[l] * a_re[l]) + u[l] * b_im[l];
    }
    (next_re, next_im)
}

/// A block's backward.
struct Reverse<'a> {
    stretches: &'a [Stretch],
    u: Columns<'a>,
    dv: Columns<'a>,
    system: System<'a>,
    /// `[stretches, 2 modes]`.
    before: &'a [Lanes],
    /// `[6 modes + 1]`, is added to.
    grad_system: &'a mut [Lanes],
    /// `[rows]`.
    du: &'a mut [Lanes],
}

widest! {
    fn backward(block: Reverse<'_>) = backward_block
}

#[inline(always)]
fn backward_block(block: Reverse<'_>) {
    let Reverse { stretches, u, dv, system, before, grad_system, du } = block;
    let modes = system.modes;
    // Of the state after a stretch, real and imaginary parts.
    let mut ds = vec![[[0.0; LANES]; 2]; modes];
    for (i, stretch) in stretches.iter().enumerate().rev() {
        if stretch.last {
            ds.fill([[0.0; LANES]; 2]);
        }
        let [u, dv] = [u, dv].map(|columns| columns.gather(&stretch.rows));
        let (u, dv) = (&u[..stretch.rows.len()], &dv[..stretch.rows.len()]);
        let mut du_here = [[0.0; LANES]; STEPS];
        for ((du, dv), u) in du_here.iter_mut().zip(dv).zip(u) {
            for l in 0..LANES {
                du[l] = dv[l] * system.skip[l];
                grad_system[6 * modes][l] += dv[l] * u[l];
            }
        }
        let (re, im) = before[i * 2 * modes..][..2 * modes].split_at(modes);
        for mode in 0..modes {
            let sums = backward_mode(system.mode(mode), [u, dv], [&re[mode], &im[mode]], &mut ds[mode], &mut du_here);
            for (part, sum) in sums.iter().enumerate() {
                for l in 0..LANES {
                    grad_system[part * modes + mode][l] += sum[l];
                }
            }
        }
        for (du_here, &row) in du_here.iter().zip(&stretch.rows) {
            du[row] = *du_here;
        }
    }
}

/// One mode's steps in reverse: `ds` from that after them to that before them, adds to `du`, and returns the gradients of
/// the mode's part of the system.
#[inline(always)]
fn backward_mode(
    system: [&Lanes; 6],
    [u, dv]: [&[Lanes]; 2],
    before: [&Lanes; 2],
    ds: &mut [Lanes; 2],
    du: &mut [Lanes; STEPS],
) -> [Lanes; 6] {
    let [a_re, a_im, b_re, b_im, c_re, c_im] = system;
    let mut states = [[[0.0; LANES]; 2]; STEPS + 1];
    states[0] = before.map(|part| *part);
    for (t, u) in u.iter().enumerate() {
        let (re, im) = advance(system, u, &states[t][0], &states[t][1]);
        states[t + 1] = [re, im];
    }
    let [ds_re, ds_im] = ds;
    let [mut da_re, mut da_im, mut db_re, mut db_im, mut dc_re, mut dc_im] = [[0.0; LANES]; 6];
    for t in (0..u.len()).rev() {
        let ([before_re, before_im], [re, im]) = (&states[t], &states[t + 1]);
        let (u, dv, du) = (&u[t], &dv[t], &mut du[t]);
        for l in 0..LANES {
            dc_re[l] += dv[l] * re[l];
            dc_im[l] -= dv[l] * im[l];
            let (g_re, g_im) = (ds_re[l] + dv[l] * c_re[l], ds_im[l] - dv[l] * c_im[l]);
            da_re[l] += g_re * before_re[l] + g_im * before_im[l];
            da_im[l] += g_im * before_re[l] - g_re * before_im[l];
            db_re[l] += g_re * u[l];
            db_im[l] += g_im * u[l];
            du[l] += g_re * b_re[l] + g_im * b_im[l];
            ds_re[l] = g_re * a_re[l] + g_im * a_im[l];
            ds_im[l] = g_im * a_re[l] - g_re * a_im[l];
        }
    }
    [da_re, da_im, db_re, db_im, dc_re, dc_im]
}
