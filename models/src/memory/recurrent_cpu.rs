//! Recurrent cells on the CPU: their loop over time, with a backward of its own.
//!
//! libtorch's packed loops add to the weights' gradients at every time step. Here a time step needs one matrix product
//! forward and one backward; all else is one product for all rows. With `a` the input part of the gates' arguments and
//! `s` the state part:
//!
//! ```text
//! a = W x + b                                                 all rows at once
//! s = U h + c,   (h', ...) = cell(a, s, ...)                  step by step
//! (da, ds, dh, ...) = cell's gradients,   dh += ds U          step by step, backwards
//! dW = da^T x    dU = ds^T h    db = sum da    dc = sum ds    dx = da W     all rows at once
//! ```
//!
//! The products are libtorch's; a [`Cell`] is plain Rust (`elementwise.rs`).

use std::marker::PhantomData;
use std::ops::Range;

use tch::{Device, Kind, Tensor};

use super::elementwise::{floats, floats_mut, widest};
use super::trajectory::{Step, Trajectory, empty, narrow};
use super::{Scan, State, add_gradients};
use crate::packing::Packing;

/// `W [gates hidden, inputs]`, `U [gates hidden, hidden]`, `b`, `c [gates hidden]`.
pub(super) type Parameters<'a> = [&'a Tensor; 4];

/// What a kind of cell computes for some rows of one time step. Both functions must be `#[inline(always)]`, since only
/// inlined code is compiled for the machine's vectors. Loops with one slice written and few read are vectorised.
pub(super) trait Cell: 'static {
    /// Gates of a unit: columns of `a` and `s`, one block of `hidden` columns a gate.
    const GATES: usize;
    /// Whether `a` and `s` are not just added, so that their gradients differ.
    const TWO_PARTS: bool;
    /// Whether it carries a second vector beside `h`, as the LSTM does.
    const CARRIES_CELL: bool;

    /// The state after the step. Leaves in `a`, and with two parts in `s`, what the backward needs.
    fn forward(step: Forward<'_>);

    /// The gradients of one step.
    fn backward(step: Backward<'_>);
}

/// Some rows of one time step. The cell's slices are empty where there is none.
pub(super) struct Forward<'a> {
    pub(super) hidden: usize,
    /// `W x + b`.
    pub(super) a: &'a mut [f32],
    /// `U h`, to which `c` is yet to be added.
    pub(super) s: &'a mut [f32],
    /// One row for all.
    pub(super) c: &'a [f32],
    pub(super) h: &'a [f32],
    pub(super) cell: &'a [f32],
    pub(super) next_h: &'a mut [f32],
    pub(super) next_cell: &'a mut [f32],
}

/// The gradients of some rows of one time step.
pub(super) struct Backward<'a> {
    pub(super) hidden: usize,
    /// What the forward left there, to be turned into da.
    pub(super) a: &'a mut [f32],
    /// With two parts as `a`, to be turned into ds; else room for anything.
    pub(super) s: &'a mut [f32],
    /// State before the step.
    pub(super) h: &'a [f32],
    pub(super) cell: &'a [f32],
    /// State after the step: its `h`.
    pub(super) next_h: &'a [f32],
    /// d loss / d output.
    pub(super) grad_output: &'a [f32],
    /// d loss / d h after the step, to which `grad_output` is yet to be added; to be turned into that before the step, but
    /// for what comes through `s`.
    pub(super) dh: &'a mut [f32],
    /// d loss / d cell after the step, to be turned into that before it.
    pub(super) dcell: &'a mut [f32],
}

widest! {
    fn forward<C: Cell>(step: Forward<'_>) = C::forward
}

widest! {
    fn backward<C: Cell>(step: Backward<'_>) = C::backward
}

/// One time step, without gradients: `input [rows, inputs]` and the state to the next state, whose `h` is the output.
pub(super) fn step<C: Cell>([w, u, b, c]: Parameters<'_>, input: &Tensor, state: &State) -> (Tensor, State) {
    tch::no_grad(|| {
        let before: Vec<Tensor> = state.0.iter().map(Tensor::contiguous).collect();
        let mut next: Vec<Tensor> = before.iter().map(Tensor::empty_like).collect();
        let (mut a, mut s) = (b.addmm(input, &w.tr()), before[0].mm(&u.tr()));
        let (next_h, next_cell) = next.split_at_mut(1);
        forward::<C>(Forward {
            hidden: u.size()[1] as usize,
            a: floats_mut(&mut a),
            s: floats_mut(&mut s),
            c: floats(c),
            h: floats(&before[0]),
            cell: before.get(1).map_or(&[], floats),
            next_h: floats_mut(&mut next_h[0]),
            next_cell: next_cell.first_mut().map_or(&mut [], floats_mut),
        });
        (next[0].shallow_clone(), State(next))
    })
}

/// Whole sequences: packed `input [rows, inputs]`. If `input` wants gradients, what the backward needs is kept.
pub(super) fn scan<C: Cell>(parameters: Parameters<'_>, input: &Tensor, packing: &Packing, initial: &State) -> Scan {
    let keep = input.requires_grad();
    tch::no_grad(|| {
        let [w, u, b, c] = parameters;
        let hidden = u.size()[1] as usize;
        let gates = C::GATES * hidden;
        // Small products are faster on a copy. The GRU's have been without, and keep their bits.
        let transposed = if C::TWO_PARTS { u.tr() } else { u.tr().contiguous() };
        let mut a = b.addmm(input, &w.tr());
        let kept_s = keep && C::TWO_PARTS;
        let mut s = empty(if kept_s { packing.rows() } else { packing.sequences() }, gates);
        let mut h = Trajectory::new(packing, &initial.0[0]);
        let mut cell = C::CARRIES_CELL.then(|| Trajectory::new(packing, &initial.0[1]));
        let steps = Step::all(packing);
        for step in &steps {
            let s_rows = if kept_s { step.now.clone() } else { 0..step.now.len() };
            let _ = h.before(step).mm_out(&narrow(&s, &s_rows), &transposed);
            let (h, next_h) = h.slices(step);
            let (cell, next_cell) = cell.as_mut().map_or((&[][..], &mut [][..]), |cell| cell.slices(step));
            let (a, s) = (rows_mut(&mut a, &step.now, gates), rows_mut(&mut s, &s_rows, gates));
            forward::<C>(Forward { hidden, a, s, c: floats(c), h, cell, next_h, next_cell });
        }
        let output = h.after();
        let last = packing.last_rows();
        let state = [Some(&h), cell.as_ref()].into_iter().flatten().map(|x| x.after().index_select(0, &last));
        let state = State(state.collect());
        let backward = keep.then(|| {
            let tape = Tape::<C> {
                parameters: parameters.map(Tensor::shallow_clone),
                steps,
                input: input.detach(),
                a,
                s,
                h,
                cell,
                of: PhantomData,
            };
            Box::new(move |grad_output: &Tensor| tape.backward(grad_output)) as super::Backward
        });
        Scan { output, state, computed_steps: packing.rows(), backward }
    })
}

/// What the backward needs.
struct Tape<C> {
    parameters: [Tensor; 4],
    steps: Vec<Step>,
    input: Tensor,
    /// As [`Cell::forward`] leaves it, a row for each packed row; then da.
    a: Tensor,
    /// With two parts as `a`, then ds; else room for one step.
    s: Tensor,
    h: Trajectory,
    cell: Option<Trajectory>,
    of: PhantomData<C>,
}

impl<C: Cell> Tape<C> {
    /// From d loss / d output to d loss / d input; adds to the parameters' gradients.
    fn backward(mut self, grad_output: &Tensor) -> Tensor {
        let (gradients, grad_input) = tch::no_grad(|| {
            self.backward_in_time(&grad_output.contiguous());
            let (da, ds) = (&self.a, if C::TWO_PARTS { &self.s } else { &self.a });
            let sum = |x: &Tensor| x.sum_dim_intlist(0, false, Kind::Float);
            let sum_da = sum(da);
            let sum_ds = if C::TWO_PARTS { sum(ds) } else { sum_da.shallow_clone() };
            let grad_input = da.mm(&self.parameters[0]);
            ([da.tr().mm(&self.input), ds.tr().mm(&self.h.all_before(&self.steps)), sum_da, sum_ds], grad_input)
        });
        add_gradients(&self.parameters.each_ref(), &gradients);
        grad_input
    }

    /// Turns `a` into da and `s` into ds.
    fn backward_in_time(&mut self, grad_output: &Tensor) {
        let u = &self.parameters[1];
        let hidden = u.size()[1] as usize;
        let gates = C::GATES * hidden;
        let sequences = self.steps[0].now.len();
        let mut dh = Tensor::zeros([sequences as i64, hidden as i64], (Kind::Float, Device::Cpu));
        let cell_width = if C::CARRIES_CELL { hidden } else { 0 };
        let mut dcell = vec![0.0; sequences * cell_width];
        for step in self.steps.iter().rev() {
            let alive = 0..step.now.len();
            let s_rows = if C::TWO_PARTS { &step.now } else { &alive };
            let (h, next_h) = self.h.slices(step);
            let cell = self.cell.as_mut().map_or(&[][..], |cell| cell.slices(step).0);
            backward::<C>(Backward {
                hidden,
                a: rows_mut(&mut self.a, &step.now, gates),
                s: rows_mut(&mut self.s, s_rows, gates),
                h,
                cell,
                next_h,
                grad_output: &floats(grad_output)[step.now.start * hidden..step.now.end * hidden],
                dh: rows_mut(&mut dh, &alive, hidden),
                dcell: &mut dcell[..alive.end * cell_width],
            });
            if step.now.start > 0 {
                let ds = if C::TWO_PARTS { &self.s } else { &self.a };
                let _ = narrow(&dh, &alive).addmm_(&narrow(ds, &step.now), u);
            }
        }
    }
}

fn rows_mut<'a>(tensor: &'a mut Tensor, rows: &Range<usize>, width: usize) -> &'a mut [f32] {
    &mut floats_mut(tensor)[rows.start * width..rows.end * width]
}

#[cfg(test)]
mod tests {
    use super::super::elementwise::numbers;
    use super::super::elman_cpu::ElmanCell;
    use super::super::gru_cpu::GruCell;
    use super::super::lstm_cpu::LstmCell;
    use super::{Backward, Cell, Forward, backward, forward};

    const ROWS: usize = 3;

    /// Everything that a step and its gradients write, in bits.
    fn run<C: Cell>(hidden: usize, inputs: &[Vec<f32>; 7], c: &[f32], wide: bool) -> Vec<Vec<u32>> {
        let [mut a, mut s, h, cell, grad_output, mut dh, mut dcell] = inputs.clone();
        let (mut next_h, mut next_cell) = (h.clone(), cell.clone());
        let forward = if wide { forward::<C> } else { C::forward };
        forward(Forward {
            hidden,
            a: &mut a,
            s: &mut s,
            c,
            h: &h,
            cell: &cell,
            next_h: &mut next_h,
            next_cell: &mut next_cell,
        });
        let gates = a.clone();
        let backward = if wide { backward::<C> } else { C::backward };
        backward(Backward {
            hidden,
            a: &mut a,
            s: &mut s,
            h: &h,
            cell: &cell,
            next_h: &next_h,
            grad_output: &grad_output,
            dh: &mut dh,
            dcell: &mut dcell,
        });
        let written = [next_h, next_cell, gates, a, s, dh, dcell];
        written.iter().map(|x| x.iter().map(|x| x.to_bits()).collect()).collect()
    }

    /// The machine's widest vectors, no vectors but those of every machine, and one number at a time.
    fn same_bits<C: Cell>() {
        for hidden in [1, 3, 8, 16, 19, 64, 255, 256] {
            let gates = C::GATES * hidden;
            let widths = [gates, gates, hidden, hidden, hidden, hidden, hidden];
            let mut seed = 0;
            let inputs = widths.map(|width| {
                seed += 1;
                numbers(ROWS * width, seed)
            });
            let c = numbers(gates, 0);
            let wide = run::<C>(hidden, &inputs, &c, true);
            assert_eq!(wide, run::<C>(hidden, &inputs, &c, false), "hidden {hidden}");
            // A unit alone is the scalar tail of a loop.
            let (row, unit) = (ROWS - 1, hidden - 1);
            let alone = inputs.clone().map(|x| {
                let width = x.len() / ROWS;
                (unit..width).step_by(hidden).map(|column| x[row * width + column]).collect()
            });
            let c: Vec<f32> = c.iter().skip(unit).step_by(hidden).copied().collect();
            for (alone, wide) in run::<C>(1, &alone, &c, true).iter().zip(&wide) {
                let width = wide.len() / ROWS;
                let same: Vec<u32> = (unit..width).step_by(hidden).map(|column| wide[row * width + column]).collect();
                assert_eq!(*alone, same, "hidden {hidden}");
            }
        }
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        same_bits::<ElmanCell>();
        same_bits::<GruCell>();
        same_bits::<LstmCell>();
    }
}
