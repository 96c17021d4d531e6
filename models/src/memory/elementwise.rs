//! Elementwise arithmetic in plain Rust on the numbers of CPU tensors, for the loops of recurrent memories.
//!
//! Multiplications and additions are never fused, so the bits of a result depend on neither the instruction set nor on
//! whether a number is handled by a vector body or its scalar tail.

// Only inlined code is compiled for the caller's instruction set.
#![allow(clippy::inline_always)]

use tch::{Device, Kind, Tensor};

/// The numbers of a contiguous f32 tensor on the CPU. The caller knows that nothing writes to them meanwhile.
#[allow(unsafe_code)]
pub(super) fn floats(tensor: &Tensor) -> &[f32] {
    check(tensor);
    if tensor.numel() == 0 {
        // Its pointer may be null.
        return &[];
    }
    // SAFETY: `check` made sure that `numel` f32 numbers lie at `data_ptr`; they live as long as the tensor does. Tensors
    // may share numbers: the callers, all in this directory, see to it that no slice to be written overlaps another slice
    // that is in use, in any thread, and call no function of libtorch that writes to these numbers while they hold one.
    unsafe { std::slice::from_raw_parts(tensor.data_ptr().cast(), tensor.numel()) }
}

/// As [`floats`], to be written. The caller knows that nothing else looks at these numbers meanwhile.
#[allow(unsafe_code)]
pub(super) fn floats_mut(tensor: &mut Tensor) -> &mut [f32] {
    check(tensor);
    if tensor.numel() == 0 {
        return &mut [];
    }
    // SAFETY: as in `floats`.
    unsafe { std::slice::from_raw_parts_mut(tensor.data_ptr().cast(), tensor.numel()) }
}

/// Whether the loops written for the CPU can take this tensor's numbers.
pub(super) fn on_cpu(tensor: &Tensor) -> bool {
    tensor.kind() == Kind::Float && tensor.device() == Device::Cpu
}

fn check(tensor: &Tensor) {
    assert!(on_cpu(tensor) && tensor.is_contiguous());
}

/// Defines a function that runs `$body`, an `#[inline(always)]` function, compiled for the widest vectors that the machine
/// has.
macro_rules! widest {
    ($(#[$attribute:meta])* $visibility:vis fn $name:ident $(<$generic:ident: $bound:ident>)? ($($argument:ident: $kind:ty),* $(,)?) = $body:path) => {
        $(#[$attribute])*
        #[allow(unsafe_code)]
        $visibility fn $name $(<$generic: $bound>)? ($($argument: $kind),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f")]
                fn avx512 $(<$generic: $bound>)? ($($argument: $kind),*) {
                    $body($($argument),*);
                }
                #[target_feature(enable = "avx2")]
                fn avx2 $(<$generic: $bound>)? ($($argument: $kind),*) {
                    $body($($argument),*);
                }
                if std::arch::is_x86_feature_detected!("avx512f") {
                    // SAFETY: the machine has these instructions.
                    return unsafe { avx512 $(::<$generic>)? ($($argument),*) };
                }
                if std::arch::is_x86_feature_detected!("avx2") {
                    // SAFETY: the machine has these instructions.
                    return unsafe { avx2 $(::<$generic>)? ($($argument),*) };
                }
            }
            $body($($argument),*);
        }
    };
}
pub(super) use widest;

/// `f(&mut x[i], &mut y[i], z[i])`, a block at a time: for parts of rows that lie side by side. A plain loop over them, within
/// a loop over rows, is compiled with one check for all rows whether what is written overlaps what is read; parts of
/// different rows do, so that it would run number by number.
#[inline(always)]
pub(super) fn in_blocks(x: &mut [f32], y: &mut [f32], z: &[f32], f: impl Fn(&mut f32, &mut f32, f32)) {
    const BLOCK: usize = 16;
    let ((x, x_rest), (y, y_rest)) = (x.as_chunks_mut::<BLOCK>(), y.as_chunks_mut::<BLOCK>());
    let (z, z_rest) = z.as_chunks::<BLOCK>();
    for ((x, y), z) in x.iter_mut().zip(y).zip(z) {
        let (mut new_x, mut new_y) = (*x, *y);
        for ((x, y), z) in new_x.iter_mut().zip(&mut new_y).zip(z) {
            f(x, y, *z);
        }
        (*x, *y) = (new_x, new_y);
    }
    for ((x, y), z) in x_rest.iter_mut().zip(y_rest).zip(z_rest) {
        f(x, y, *z);
    }
}

/// `1 / (1 + exp(-x))`, within 2e-7.
#[inline(always)]
pub(super) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// Hyperbolic tangent, within 2e-7.
#[inline(always)]
pub(super) fn tanh(x: f32) -> f32 {
    2.0 / (1.0 + exp(-2.0 * x)) - 1.0
}

/// `exp(x)` for `x` clamped to +-87, relative error below 2e-7; NaN stays NaN. No branch and no table, so that loops over
/// it are vectorised: `exp(x) = 2^k exp(r)` with `k = round(x / ln 2)`, and a polynomial for `exp(r)`, `|r| <= ln(2) / 2`
/// (Cephes, expf.c).
#[inline(always)]
pub(super) fn exp(x: f32) -> f32 {
    /// Added to a small number, leaves its nearest integer in the low bits.
    const ROUND: f32 = 12_582_912.0;
    // ln 2 in two parts; the product of `k` and the first is exact.
    const LN_2_HIGH: f32 = 0.693_359_4;
    const LN_2_LOW: f32 = -2.121_944_4e-4;
    // Not min and max, which would lose a NaN.
    let x = if x > 87.0 { 87.0 } else { x };
    let x = if x < -87.0 { -87.0 } else { x };
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let k = shifted - ROUND;
    let r = x - k * LN_2_HIGH - k * LN_2_LOW;
    let mut p = 1.987_569_1e-4;
    p = p * r + 1.398_2e-3;
    p = p * r + 8.333_452e-3;
    p = p * r + 4.166_579_6e-2;
    p = p * r + 1.666_666_5e-1;
    p = p * r + 0.5;
    let exp_r = p * (r * r) + r + 1.0;
    exp_r * f32::from_bits((shifted.to_bits() << 23).wrapping_add(0x3f80_0000))
}

/// Numbers within +-5 to test loops with.
#[cfg(test)]
pub(super) fn numbers(n: usize, seed: usize) -> Vec<f32> {
    (0..n).map(|i| ((i * 7919 + seed * 104_729) % 10_007) as f32 / 1_000.0 - 5.0).collect()
}

#[cfg(test)]
mod tests {
    use super::{exp, sigmoid, tanh};

    #[test]
    fn functions_are_accurate_and_rise() {
        let mut before = [f32::NEG_INFINITY; 3];
        for i in -3_000_000..=3_000_000 {
            let x = i as f32 * 1e-5;
            let wide = f64::from(x);
            let exact = [1.0, 1.0 / (1.0 + (-wide).exp()), wide.tanh()];
            let found = [exp(x) / wide.exp() as f32, sigmoid(x), tanh(x)];
            for (function, (found, exact)) in found.iter().zip(exact).enumerate() {
                assert!((f64::from(*found) - exact).abs() <= 2e-7, "function {function} of {x}: {found}, not {exact}");
            }
            for (now, before) in [exp(x), sigmoid(x), tanh(x)].into_iter().zip(&mut before) {
                assert!(now >= *before - 1.5e-7 * before.abs(), "falls at {x}: from {before} to {now}");
                *before = now;
            }
        }
    }

    #[test]
    fn limits_are_exact_and_nan_stays() {
        for x in [20.0, 100.0, f32::MAX, f32::INFINITY] {
            assert_eq!((sigmoid(x), tanh(x), tanh(-x)), (1.0, 1.0, -1.0), "{x}");
            assert!((0.0..3e-9).contains(&sigmoid(-x)), "{x}");
        }
        assert_eq!((sigmoid(0.0), tanh(0.0), exp(0.0)), (0.5, 0.0, 1.0));
        assert!(sigmoid(f32::NAN).is_nan() && tanh(f32::NAN).is_nan());
    }
}
