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
        let transposed = u.tr();
        let mut a = b.addmm(input, &w.tr());
        let kept_s = keep && C::TWO_PARTS;
        let mut s = empty(if kept_s { packing.rows() } else { packing.sequences() }, gates);
        let mut h = Trajectory::new(packing, &initial.0[0]);
        let mut cell = C::CARRIES_CELL.then(|| Trajectory::new(packing, &initial.0[1]));
        let steps = Step::all(packing);
        for step in &steps {
            let s_rows = if kept_s { step.now.clone() } else { 0..step.now.len() };
            let _ = h.before(step).mm_out(&narrow(&s, &s_rows), &transposed);
            let (h, next_h) = h.slices(step, hidden);
            let (cell, next_cell) = cell.as_mut().map_or((&[][..], &mut [][..]), |cell| cell.slices(step, hidden));
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
            let h: Vec<Tensor> = self.steps.iter().map(|step| self.h.before(step)).collect();
            let sum = |x: &Tensor| x.sum_dim_intlist(0, false, Kind::Float);
            let sum_da = sum(da);
            let sum_ds = if C::TWO_PARTS { sum(ds) } else { sum_da.shallow_clone() };
            let grad_input = da.mm(&self.parameters[0]);
            ([da.tr().mm(&self.input), ds.tr().mm(&Tensor::cat(&h, 0)), sum_da, sum_ds], grad_input)
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
            let (h, next_h) = self.h.slices(step, hidden);
            let cell = self.cell.as_mut().map_or(&[][..], |cell| cell.slices(step, hidden).0);
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

/// The packed rows of a time step, and where in a [`Trajectory`] their states before it stand.
struct Step {
    now: Range<usize>,
    before: Range<usize>,
}

impl Step {
    fn all(packing: &Packing) -> Vec<Self> {
        let mut start = 0;
        packing
            .steps()
            .map(|now| {
                let before = start..start + now.len();
                start = now.start + packing.sequences() as usize;
                Self { now, before }
            })
            .collect()
    }
}

/// States before the first step and after each, in one tensor: `[sequences + rows, hidden]`.
struct Trajectory {
    states: Tensor,
    sequences: usize,
}

impl Trajectory {
    fn new(packing: &Packing, initial: &Tensor) -> Self {
        let sequences = packing.sequences();
        let states = empty(sequences + packing.rows(), initial.size()[1] as usize);
        states.narrow(0, 0, sequences).copy_(initial);
        Self { states, sequences: sequences as usize }
    }

    fn before(&self, step: &Step) -> Tensor {
        narrow(&self.states, &step.before)
    }

    /// After each step, a row for each packed row.
    fn after(&self) -> Tensor {
        let rows = self.sequences..self.states.size()[0] as usize;
        narrow(&self.states, &rows)
    }

    /// The numbers before and after a step.
    fn slices(&mut self, step: &Step, hidden: usize) -> (&[f32], &mut [f32]) {
        let start = (step.now.start + self.sequences) * hidden;
        let (before, after) = floats_mut(&mut self.states).split_at_mut(start);
        (&before[step.before.start * hidden..step.before.end * hidden], &mut after[..step.now.len() * hidden])
    }
}

fn rows_mut<'a>(tensor: &'a mut Tensor, rows: &Range<usize>, width: usize) -> &'a mut [f32] {
    &mut floats_mut(tensor)[rows.start * width..rows.end * width]
}

fn narrow(tensor: &Tensor, rows: &Range<usize>) -> Tensor {
    tensor.narrow(0, rows.start as i64, rows.len() as i64)
}

fn empty(rows: i64, width: usize) -> Tensor {
    Tensor::empty([rows, width as i64], (Kind::Float, Device::Cpu))
}
