//! S4D over whole sequences on the CPU: the recurrence itself, and a backward of its own.
//!
//! Channels do not mix within the state, so they are cut into blocks, which threads share; every number is computed in the
//! same order however many threads there are (loops: `s4d_block_cpu.rs`). With `s' = A s + B u`, `v = Re(C s') + D u` (here C holds the 2 of `s4d.rs`), `d` = d loss / dv and `*`
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

use super::elementwise::{floats, floats_mut, in_blocks, sigmoid, widest};
use super::s4d_block_cpu::{
    Columns, Forward, LANES, Lanes, Reverse, STEPS, Stretch, System, backward, copy_lanes, forward,
};
use super::{Backward, Scan, State, add_gradients};
use crate::packing::Packing;

/// Steps of a block's mode that are worth a thread, about 0.2 ms.
const THREADS_WORK: usize = 20_000;

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
        let modes = (numbers - 1) / 6;
        let plan = Plan::new(packing, threads);
        let system = to_blocks(&layers.system.tr().unsqueeze(0));
        let mut state = to_blocks(&Tensor::cat(&[&initial.0[0], &initial.0[1]], 2).transpose(1, 2));
        let u = input.linear(&layers.input[0], Some(&layers.input[1]));
        let mut v = empty(&[blocks(hidden), packing.rows(), 1]);
        let stretches = if keep { plan.stretches.len() as i64 } else { 0 };
        let mut before = empty(&[blocks(hidden), stretches, 2 * modes]);
        plan.forward(floats(&u), hidden as usize, &system, [&mut state, &mut v, &mut before]);

        let v = to_rows(&v, hidden, threads);
        let activated = v.gelu("none");
        let z = activated.linear(&layers.output[0], Some(&layers.output[1]));
        let output = glu(&z, threads);
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
    fn backward(mut self, grad_output: &Tensor) -> Tensor {
        let threads = self.plan.threads;
        let Layers { input: [weight, bias], output: [output_weight, output_bias], system } = &self.layers;
        let (gradients, grad_input) = tch::no_grad(|| {
            let sum = |x: &Tensor| x.sum_dim_intlist(0, false, Kind::Float);
            glu_backward(&mut self.z, &grad_output.contiguous(), threads);
            let dz = &self.z;
            let dv = self.v.gelu_backward(&dz.mm(output_weight), "none").contiguous();
            let mut du = empty(&[self.system.size()[0], self.u.size()[0], 1]);
            let mut grad_system = self.system.zeros_like();
            let [u, dv] = [&self.u, &dv].map(floats);
            let hidden = self.u.size()[1];
            self.plan.backward([u, dv], hidden as usize, [&self.system, &self.before], [&mut grad_system, &mut du]);
            let du = to_rows(&du, hidden, threads);
            let grad_system = from_blocks(&grad_system, hidden).squeeze_dim(0).tr().contiguous();
            let layers = [du.tr().mm(&self.input), sum(&du), dz.tr().mm(&self.activated), sum(dz)];
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

/// As [`from_blocks`], of `[blocks, rows, 1, LANES]` to `[rows, hidden]`; several times as fast as libtorch.
fn to_rows(x: &Tensor, hidden: i64, threads: usize) -> Tensor {
    let rows = x.size()[1] as usize;
    let mut gathered = Tensor::empty([rows as i64, hidden], (Kind::Float, tch::Device::Cpu));
    let (lanes, hidden): (&[Lanes], usize) = (floats(x).as_chunks().0, hidden as usize);
    let share = rows.div_ceil(threads);
    let work = floats_mut(&mut gathered).chunks_mut(share * hidden).enumerate().collect();
    in_threads(threads, work, |(i, part): (usize, &mut [f32])| {
        for (row, to) in (i * share..).zip(part.chunks_exact_mut(hidden)) {
            for (block, to) in to.chunks_mut(LANES).enumerate() {
                copy_lanes(&lanes[block * rows + row][..to.len()], to);
            }
        }
    });
    gathered
}

/// `z [rows, 2 hidden]` to its GLU `[rows, hidden]`.
fn glu(z: &Tensor, threads: usize) -> Tensor {
    let [rows, width] = z.size()[..] else { unreachable!("a matrix") };
    let mut output = Tensor::empty([rows, width / 2], (Kind::Float, tch::Device::Cpu));
    let (share, width) = ((rows as usize).div_ceil(threads), width as usize);
    let work = floats(z).chunks(share * width).zip(floats_mut(&mut output).chunks_mut(share * width / 2));
    in_threads(threads, work.collect(), |(z, output)| glu_forward(z, output, width / 2));
    output
}

/// Turns `z [rows, 2 hidden]` into d loss / dz, given d loss / d GLU.
fn glu_backward(z: &mut Tensor, grad_output: &Tensor, threads: usize) {
    let [rows, width] = z.size()[..] else { unreachable!("a matrix") };
    let (share, width) = ((rows as usize).div_ceil(threads), width as usize);
    let work = floats_mut(z).chunks_mut(share * width).zip(floats(grad_output).chunks(share * width / 2));
    in_threads(threads, work.collect(), |(z, grad)| glu_reverse(z, grad, width / 2));
}

widest! {
    fn glu_forward(z: &[f32], output: &mut [f32], hidden: usize) = glu_rows
}

#[inline(always)]
fn glu_rows(z: &[f32], output: &mut [f32], hidden: usize) {
    for (z, output) in z.chunks_exact(2 * hidden).zip(output.chunks_exact_mut(hidden)) {
        let (p, q) = z.split_at(hidden);
        for ((output, p), q) in output.iter_mut().zip(p).zip(q) {
            *output = p * sigmoid(*q);
        }
    }
}

widest! {
    fn glu_reverse(z: &mut [f32], grad: &[f32], hidden: usize) = glu_backward_rows
}

#[inline(always)]
fn glu_backward_rows(z: &mut [f32], grad: &[f32], hidden: usize) {
    for (z, grad) in z.chunks_exact_mut(2 * hidden).zip(grad.chunks_exact(hidden)) {
        let (p, q) = z.split_at_mut(hidden);
        in_blocks(p, q, grad, |p, q, grad| {
            let gate = sigmoid(*q);
            let through = grad * gate;
            *q = through * *p * (1.0 - gate);
            *p = through;
        });
    }
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
        in_threads(self.threads, work.collect(), forward);
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
        in_threads(self.threads, work.collect(), backward);
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

#[cfg(test)]
mod tests {
    use tch::{Device, Kind, Tensor};

    use super::super::State;
    use super::{Layers, scan_in_threads};
    use crate::packing::Packing;

    /// Output, last state, d loss / d input and parameters, in this many threads.
    fn run(threads: usize) -> Vec<Tensor> {
        let random = |size: &[i64], seed: i64| {
            let numbers = Tensor::arange(size.iter().product::<i64>(), (Kind::Float, Device::Cpu));
            ((numbers * 12.9898 + seed).sin() * 0.5).view(size).set_requires_grad(true)
        };
        let (hidden, modes, packing) = (70, 3, Packing::new(&[40, 1, 33, 32, 64]));
        let input = [random(&[hidden, 5], 0), random(&[hidden], 1)];
        let output = [random(&[2 * hidden, hidden], 2), random(&[2 * hidden], 3)];
        let system = random(&[hidden, 6 * modes + 1], 4);
        let parameters: Vec<Tensor> = input.iter().chain(&output).chain([&system]).map(Tensor::shallow_clone).collect();
        let x = random(&[packing.rows(), 5], 5);
        let state = State([6, 7].map(|seed| random(&[5, hidden, modes], seed).detach()).into());
        let scan = scan_in_threads(Layers { input, output, system }, &x, &packing, &state, threads);
        let grad_input = (scan.backward.expect("the input wants gradients"))(&scan.output.cos());
        let mut all = vec![scan.output, grad_input];
        all.extend(scan.state.0);
        all.extend(parameters.iter().map(Tensor::grad));
        all
    }

    #[test]
    fn any_number_of_threads_gives_the_same() {
        let one = run(1);
        for threads in [2, 3, 7, 300] {
            for (i, (some, one)) in run(threads).iter().zip(&one).enumerate() {
                assert_eq!(some.size(), one.size());
                assert!(one.abs().max().double_value(&[]) > 0.0 && some.equal(one), "tensor {i}, {threads} threads");
            }
        }
    }
}
