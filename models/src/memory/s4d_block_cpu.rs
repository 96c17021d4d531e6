//! S4D's recurrence on a block of channels, and its gradients. Equations: `s4d_scan_cpu.rs`.
//!
//! The loops handle one mode of all the block's channels at a time, over a stretch of steps.

// Only inlined code is compiled for the caller's instruction set.
#![allow(clippy::inline_always)]

use super::elementwise::widest;

/// Channels of a block.
pub(super) const LANES: usize = 32;
/// Steps of a stretch.
pub(super) const STEPS: usize = 32;

/// A number for each channel of a block.
pub(super) type Lanes = [f32; LANES];

/// Copies a block's part of a row; a whole one, the most frequent, without a call.
#[inline(always)]
pub(super) fn copy_lanes(from: &[f32], to: &mut [f32]) {
    match (<&Lanes>::try_from(from), <&mut Lanes>::try_from(&mut *to)) {
        (Ok(from), Ok(to)) => *to = *from,
        _ => to.copy_from_slice(from),
    }
}

/// Consecutive steps of a sequence.
pub(super) struct Stretch {
    pub(super) sequence: usize,
    /// Its packed rows.
    pub(super) rows: Vec<usize>,
    /// Whether the sequence ends with it.
    pub(super) last: bool,
}

/// A block's columns of a matrix `[rows, hidden]`.
#[derive(Clone, Copy)]
pub(super) struct Columns<'a> {
    pub(super) numbers: &'a [f32],
    pub(super) hidden: usize,
    pub(super) first: usize,
}

impl Columns<'_> {
    #[inline(always)]
    fn gather(&self, rows: &[usize]) -> [Lanes; STEPS] {
        let lanes = LANES.min(self.hidden - self.first);
        let mut gathered = [[0.0; LANES]; STEPS];
        for (to, row) in gathered.iter_mut().zip(rows) {
            copy_lanes(&self.numbers[row * self.hidden + self.first..][..lanes], &mut to[..lanes]);
        }
        gathered
    }
}

/// A block's system.
#[derive(Clone, Copy)]
pub(super) struct System<'a> {
    numbers: &'a [Lanes],
    modes: usize,
    skip: &'a Lanes,
}

impl<'a> System<'a> {
    pub(super) fn new(numbers: &'a [Lanes]) -> Self {
        let (skip, numbers) = numbers.split_last().expect("D is there");
        Self { numbers, modes: numbers.len() / 6, skip }
    }

    /// Real and imaginary parts of a mode's A, B and C.
    #[inline(always)]
    fn mode(&self, mode: usize) -> [&'a Lanes; 6] {
        std::array::from_fn(|part| &self.numbers[part * self.modes + mode])
    }
}

/// What a block's forward reads and writes.
pub(super) struct Forward<'a> {
    pub(super) stretches: &'a [Stretch],
    pub(super) u: Columns<'a>,
    pub(super) system: System<'a>,
    /// `[sequences, 2 modes]`: all real parts, then all imaginary ones.
    pub(super) state: &'a mut [Lanes],
    /// `[rows]`.
    pub(super) v: &'a mut [Lanes],
    /// `[stretches, 2 modes]` or nothing.
    pub(super) before: &'a mut [Lanes],
}

widest! {
    /// Advances a block's states by all steps.
    pub(super) fn forward(block: Forward<'_>) = forward_block
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

/// What a block's backward reads and writes.
pub(super) struct Reverse<'a> {
    pub(super) stretches: &'a [Stretch],
    pub(super) u: Columns<'a>,
    pub(super) dv: Columns<'a>,
    pub(super) system: System<'a>,
    /// `[stretches, 2 modes]`.
    pub(super) before: &'a [Lanes],
    /// `[6 modes + 1]`, is added to.
    pub(super) grad_system: &'a mut [Lanes],
    /// `[rows]`.
    pub(super) du: &'a mut [Lanes],
}

widest! {
    /// A block's gradients.
    pub(super) fn backward(block: Reverse<'_>) = backward_block
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

#[cfg(test)]
mod tests {
    use super::super::elementwise::numbers;
    use super::{
        Columns, Forward, LANES, Lanes, Reverse, Stretch, System, backward, backward_block, forward, forward_block,
    };

    fn lanes(count: usize, seed: usize) -> Vec<Lanes> {
        numbers(count * LANES, seed).as_chunks().0.iter().map(|lanes| lanes.map(|x| x * 0.1)).collect()
    }

    #[test]
    fn every_instruction_set_gives_the_same_bits() {
        let stretches = [
            Stretch { sequence: 0, rows: (0..32).collect(), last: false },
            Stretch { sequence: 0, rows: vec![32, 34], last: true },
            Stretch { sequence: 1, rows: vec![33], last: true },
        ];
        for (hidden, modes) in [(1, 1), (19, 8), (32, 3), (45, 2)] {
            let [u, dv] = [0, 1].map(|seed| numbers(35 * hidden, seed));
            let [u, dv] = [&u, &dv].map(|numbers| Columns { numbers, hidden, first: (hidden - 1) / LANES * LANES });
            let system = lanes(6 * modes + 1, 2);
            let run = |wide: bool| {
                let (mut state, mut v, mut du) = (lanes(4 * modes, 3), lanes(35, 4), lanes(35, 5));
                let (mut before, mut grad_system) = (lanes(6 * modes, 6), lanes(6 * modes + 1, 7));
                let (stretches, system) = (&stretches, System::new(&system));
                let work = Forward { stretches, u, system, state: &mut state, v: &mut v, before: &mut before };
                (if wide { forward } else { forward_block })(work);
                let (grad, before) = (&mut grad_system, &before);
                let work = Reverse { stretches, u, dv, system, before, grad_system: grad, du: &mut du };
                (if wide { backward } else { backward_block })(work);
                [state, v, du, grad_system].map(|x| x.as_flattened().iter().map(|x| x.to_bits()).collect::<Vec<_>>())
            };
            assert_eq!(run(true), run(false), "hidden {hidden}, modes {modes}");
        }
    }
}
