//! The DNC on the CPU: a loop over time with a backward of its own.
//!
//! A time step needs three matrix products forward, two for the controller's gates and one for the interface, and two
//! backward; the products of the input, the output and all weights' gradients are one for all rows. They are libtorch's; the
//! rest is plain Rust: the LSTM's pointwise part here, the memory cells in `dnc_forward.rs` and `dnc_backward.rs`.
//!
//! The output jumps where two usages cross (`dnc.rs`), so that agreement but for rounding would not do: `act` and `scan`
//! compute a row with the same bits, however many others there are ([`add_product`]).
//!
//! ```text
//! a = W x + U [h ; r] + b,   i, f, o = sigmoid(a_i, a_f, a_o),   g = tanh(a_g)
//! c' = f c + i g,   t = tanh(c'),   h' = o t
//! dc' += dh' o (1 - t^2),   da = [dc' g i (1 - i), dc' c f (1 - f), dc' i (1 - g^2), dh' t o (1 - o)],   dc = dc' f
//! ```
//!
//! `U` is `weight_state` and the read vectors' part of `weight_input`.

// Only inlined code is compiled for the caller's instruction set.
#![allow(clippy::inline_always)]

use tch::{Kind, Tensor};

use super::dnc::Dnc;
use super::dnc_cells::{FIELDS, Sizes};
use super::elementwise::{floats, floats_mut, sigmoid, tanh, widest};
use super::trajectory::{Step, Trajectory, empty, narrow};
use super::{Backward, Scan, State, add_gradients, dnc_backward, dnc_forward};
use crate::packing::Packing;

/// Contiguous tensors of the state: h, c, the cells' fields, read vectors.
fn contiguous(state: &State) -> Vec<Tensor> {
    state.0.iter().map(Tensor::contiguous).collect()
}

fn fields(state: &[Tensor]) -> [&[f32]; FIELDS] {
    std::array::from_fn(|field| floats(&state[2 + field]))
}

/// One time step, without gradients.
pub(super) fn act(dnc: &Dnc, input: &Tensor, state: &State) -> (Tensor, State) {
    tch::no_grad(|| {
        let (s, state) = (dnc.sizes(), contiguous(state));
        let rows = input.size()[0];
        let mut a = dnc.bias().repeat([rows, 1]);
        add_product(&mut a, input, &dnc.of_input().tr());
        add_product(&mut a, &state[0], &dnc.weight_state.tr());
        add_product(&mut a, &state[8], &dnc.of_reads().tr());
        let mut z = empty(rows, dnc.hidden as usize + s.reads());
        let mut next: Vec<Tensor> = state[1..8].iter().map(Tensor::empty_like).collect();
        let hidden = dnc.hidden as usize;
        lstm(floats_mut(&mut a), floats(&state[1]), floats_mut(&mut next[0]), floats_mut(&mut z), hidden);
        let h = z.narrow(1, 0, dnc.hidden);
        let mut xi = dnc.bias_interface.repeat([rows, 1]);
        add_product(&mut xi, &h, &dnc.weight_interface.tr());
        let mut after = next[1..].iter_mut();
        let step = dnc_forward::Rows {
            before: fields(&state),
            after: std::array::from_fn(|_| floats_mut(after.next().expect("a tensor for each field"))),
            xi: floats_mut(&mut xi),
            z: floats_mut(&mut z),
            trace: &mut vec![0.0; s.trace()],
        };
        dnc_forward::step(s, step, &mut dnc_forward::Scratch::new(s));
        let output = dnc.bias_output.addmm(&z, &dnc.weight_output.tr());
        next.insert(0, h.contiguous());
        next.push(z.narrow(1, dnc.hidden, s.reads() as i64).contiguous());
        (output, State(next))
    })
}

/// `out += x weight`. The bits of a row do not depend on the number of rows, as far as libtorch sees to it for 16 and more;
/// fewer, for which it has other ways, are filled up.
fn add_product(out: &mut Tensor, x: &Tensor, weight: &Tensor) {
    const ROWS: i64 = 16;
    let rows = x.size()[0];
    if rows >= ROWS {
        let _ = out.addmm_(x, weight);
    } else {
        let [mut filled, x] = [&*out, x].map(|x| x.constant_pad_nd([0, 0, 0, ROWS - rows]));
        out.copy_(&filled.addmm_(&x, weight).narrow(0, 0, rows));
    }
}

/// Whole sequences: packed `input [rows, inputs]`, `initial` in packed order. If `input` wants gradients, what the backward
/// needs is kept.
pub(super) fn scan(dnc: &Dnc, input: &Tensor, packing: &Packing, initial: &State) -> Scan {
    tch::no_grad(|| {
        let mut tape = Tape::new(dnc, input, packing, initial);
        tape.forward(dnc);
        let output = dnc.bias_output.addmm(&tape.z.after(), &dnc.weight_output.tr());
        let state = tape.last(dnc, &packing.last_rows(), initial);
        let backward = input.requires_grad().then(|| {
            let dnc = dnc.shallow_clone();
            Box::new(move |grad_output: &Tensor| tape.backward(&dnc, grad_output)) as Backward
        });
        Scan { output, state, computed_steps: packing.rows(), backward }
    })
}

impl Dnc {
    fn sizes(&self) -> Sizes {
        Sizes { cells: self.cells as usize, width: self.width as usize, heads: self.heads as usize }
    }

    fn bias(&self) -> Tensor {
        &self.bias_input + &self.bias_state
    }

    fn inputs(&self) -> i64 {
        self.weight_input.size()[1] - self.heads * self.width
    }

    /// The gates' weights for the input, `[4 hidden, inputs]`.
    fn of_input(&self) -> Tensor {
        self.weight_input.narrow(1, 0, self.inputs())
    }

    /// The gates' weights for the read vectors, `[4 hidden, reads]`.
    fn of_reads(&self) -> Tensor {
        self.weight_input.narrow(1, self.inputs(), self.heads * self.width)
    }
}

/// All that the steps compute, a row for each packed row.
struct Tape {
    steps: Vec<Step>,
    input: Tensor,
    /// Controller's output and read vectors.
    z: Trajectory,
    /// Gates; then their gradients.
    a: Tensor,
    /// Interface; then its gradients.
    xi: Tensor,
    /// The LSTM's cells.
    c: Trajectory,
    /// The memory's fields.
    fields: [Trajectory; FIELDS],
    trace: Vec<f32>,
}

impl Tape {
    fn new(dnc: &Dnc, input: &Tensor, packing: &Packing, initial: &State) -> Self {
        let (s, rows) = (dnc.sizes(), packing.rows());
        let initial = &initial.0;
        let mut a = dnc.bias().repeat([rows, 1]);
        add_product(&mut a, input, &dnc.of_input().tr());
        Self {
            steps: Step::all(packing),
            input: input.detach(),
            z: Trajectory::new(packing, &Tensor::cat(&[&initial[0], &initial[8]], 1)),
            a,
            xi: dnc.bias_interface.repeat([rows, 1]),
            c: Trajectory::new(packing, &initial[1]),
            fields: std::array::from_fn(|field| Trajectory::new(packing, &initial[2 + field].flatten(1, -1))),
            trace: vec![0.0; rows as usize * s.trace()],
        }
    }

    fn forward(&mut self, dnc: &Dnc) {
        let (s, hidden) = (dnc.sizes(), dnc.hidden as usize);
        let (of_h, of_reads, interface) = (dnc.weight_state.tr(), dnc.of_reads().tr(), dnc.weight_interface.tr());
        let reads = dnc.heads * dnc.width;
        let mut scratch = dnc_forward::Scratch::new(s);
        for step in &self.steps {
            let now = &step.now;
            let [mut a, mut xi] = [&self.a, &self.xi].map(|x| narrow(x, now));
            let mut z = self.z.after_step(step);
            let z_before = self.z.before(step);
            add_product(&mut a, &z_before.narrow(1, 0, dnc.hidden), &of_h);
            add_product(&mut a, &z_before.narrow(1, dnc.hidden, reads), &of_reads);
            let (c_before, c) = self.c.slices(step);
            lstm(floats_mut(&mut a), c_before, c, floats_mut(&mut z), hidden);
            add_product(&mut xi, &z.narrow(1, 0, dnc.hidden), &interface);

            let pairs = self.fields.each_mut().map(|field| field.slices(step));
            let rows = dnc_forward::Rows {
                before: pairs.each_ref().map(|(before, _)| *before),
                after: pairs.map(|(_, after)| after),
                xi: floats_mut(&mut xi),
                z: floats_mut(&mut z),
                trace: &mut self.trace[now.start * s.trace()..now.end * s.trace()],
            };
            dnc_forward::step(s, rows, &mut scratch);
        }
    }

    /// The state after each sequence's last step, which is in these rows; in the shapes of the initial one.
    fn last(&self, dnc: &Dnc, rows: &Tensor, initial: &State) -> State {
        let z = self.z.after().index_select(0, rows);
        let mut state = vec![z.narrow(1, 0, dnc.hidden).contiguous()];
        for (numbers, like) in [&self.c].into_iter().chain(&self.fields).zip(&initial.0[1..]) {
            state.push(numbers.after().index_select(0, rows).view_as(like));
        }
        state.push(z.narrow(1, dnc.hidden, dnc.heads * dnc.width).contiguous());
        State(state)
    }

    /// From d loss / d output to d loss / d input; adds to the parameters' gradients.
    fn backward(mut self, dnc: &Dnc, grad_output: &Tensor) -> Tensor {
        let (gradients, grad_input) = tch::no_grad(|| {
            let grad_output = grad_output.contiguous();
            let recurrent = Tensor::cat(&[&dnc.weight_state, &dnc.of_reads()], 1);
            self.backward_steps(dnc, &grad_output.mm(&dnc.weight_output), &recurrent);
            let sum = |x: &Tensor| x.sum_dim_intlist(0, false, Kind::Float);
            let (da, dxi) = (&self.a, &self.xi);
            let d_recurrent = da.tr().mm(&self.z.all_before(&self.steps));
            let reads = dnc.heads * dnc.width;
            let d_input = Tensor::cat(&[da.tr().mm(&self.input), d_recurrent.narrow(1, dnc.hidden, reads)], 1);
            let d_state = d_recurrent.narrow(1, 0, dnc.hidden).contiguous();
            let d_interface = dxi.tr().mm(&self.z.after().narrow(1, 0, dnc.hidden));
            let d_output = grad_output.tr().mm(&self.z.after());
            let biases = [sum(da), sum(da), sum(dxi), sum(&grad_output)];
            let grad_input = da.mm(&dnc.of_input());
            ([d_input, d_state, d_interface, d_output].into_iter().chain(biases).collect::<Vec<_>>(), grad_input)
        });
        let weights = [&dnc.weight_input, &dnc.weight_state, &dnc.weight_interface, &dnc.weight_output];
        let biases = [&dnc.bias_input, &dnc.bias_state, &dnc.bias_interface, &dnc.bias_output];
        add_gradients(&[weights, biases].concat(), &gradients);
        grad_input
    }

    /// Turns `a` and `xi` into their gradients. `dz` holds what comes through the output alone.
    fn backward_steps(&mut self, dnc: &Dnc, dz: &Tensor, recurrent: &Tensor) {
        let (s, hidden, sequences) = (dnc.sizes(), dnc.hidden as usize, self.steps[0].now.len());
        let mut scratch = dnc_backward::Scratch::new(s);
        let mut dc = vec![0.0; sequences * hidden];
        let mut gradients = s.fields().map(|width| vec![0.0; sequences * width]);
        for step in self.steps.iter().rev() {
            let now = &step.now;
            let [mut a, mut xi, dz_now] = [&self.a, &self.xi, dz].map(|x| narrow(x, now));
            let pairs = self.fields.each_mut().map(|field| field.slices(step));
            let rows = dnc_backward::Rows {
                before: pairs.each_ref().map(|(before, _)| *before),
                after: pairs.map(|(_, after)| &*after),
                xi: floats_mut(&mut xi),
                grad_z: floats(&dz_now),
                trace: &mut self.trace[now.start * s.trace()..now.end * s.trace()],
                gradients: gradients.each_mut().map(Vec::as_mut_slice),
            };
            dnc_backward::step(s, rows, &mut scratch);
            let _ = dz_now.narrow(1, 0, dnc.hidden).addmm_(&xi, &dnc.weight_interface);
            let (c_before, c) = self.c.slices(step);
            lstm_backward(floats_mut(&mut a), c_before, c, floats(&dz_now), &mut dc[..now.len() * hidden], hidden);
            if let Some(before) = self.z.rows_before(step) {
                let _ = narrow(dz, &before).addmm_(&a, recurrent);
            }
        }
    }
}

widest! {
    /// Gates, cells and output of some rows: `a [rows, 4 hidden]` becomes i, f, g, o; the first numbers of each row of `z`
    /// become h.
    fn lstm(a: &mut [f32], c_before: &[f32], c: &mut [f32], z: &mut [f32], hidden: usize) = lstm_rows
}

#[inline(always)]
fn lstm_rows(a: &mut [f32], c_before: &[f32], c: &mut [f32], z: &mut [f32], hidden: usize) {
    let z_width = z.len() / (c.len() / hidden);
    let cells = c_before.chunks_exact(hidden).zip(c.chunks_exact_mut(hidden));
    for ((a, (c_before, c)), z) in a.chunks_exact_mut(4 * hidden).zip(cells).zip(z.chunks_exact_mut(z_width)) {
        let (i_f, g_o) = a.split_at_mut(2 * hidden);
        let (g, o) = g_o.split_at_mut(hidden);
        for gates in [&mut *i_f, &mut *o] {
            for x in gates {
                *x = sigmoid(*x);
            }
        }
        for x in &mut *g {
            *x = tanh(*x);
        }
        let (i, f) = i_f.split_at(hidden);
        for ((((c, c_before), i), f), g) in c.iter_mut().zip(c_before).zip(i).zip(f).zip(g) {
            *c = f * c_before + i * *g;
        }
        for ((h, c), o) in z.iter_mut().zip(c).zip(o) {
            *h = *o * tanh(*c);
        }
    }
}

widest! {
    /// Gradients of the gates of some rows, in their place; `dc` of the cells after becomes that of the cells before. The
    /// first numbers of each row of `dz` are dh.
    fn lstm_backward(a: &mut [f32], c_before: &[f32], c: &[f32], dz: &[f32], dc: &mut [f32], hidden: usize) =
        lstm_backward_rows
}

#[inline(always)]
fn lstm_backward_rows(a: &mut [f32], c_before: &[f32], c: &[f32], dz: &[f32], dc: &mut [f32], hidden: usize) {
    let z_width = dz.len() / (c.len() / hidden);
    let cells = c_before.chunks_exact(hidden).zip(c.chunks_exact(hidden)).zip(dc.chunks_exact_mut(hidden));
    for ((a, ((c_before, c), dc)), dh) in a.chunks_exact_mut(4 * hidden).zip(cells).zip(dz.chunks_exact(z_width)) {
        let (i_f, g_o) = a.split_at_mut(2 * hidden);
        let ((i, f), (g, o)) = (i_f.split_at_mut(hidden), g_o.split_at_mut(hidden));
        for (((dc, c), o), dh) in dc.iter_mut().zip(c).zip(o).zip(dh) {
            let t = tanh(*c);
            *dc += dh * *o * (1.0 - t * t);
            *o = dh * t * (*o * (1.0 - *o));
        }
        for ((i, g), dc) in i.iter_mut().zip(g).zip(&*dc) {
            let di = dc * *g * (*i * (1.0 - *i));
            *g = dc * *i * (1.0 - *g * *g);
            *i = di;
        }
        for ((f, dc), c_before) in f.iter_mut().zip(dc).zip(c_before) {
            let df = *dc * c_before * (*f * (1.0 - *f));
            *dc *= *f;
            *f = df;
        }
    }
}
