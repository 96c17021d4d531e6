//! The terms of PPO's loss, step by step: pure functions of columns `[steps]`.

use tch::Tensor;

/// The clipped surrogate objective (Schulman et al., 2017, equation 7), to be maximised:
/// `min(A rho, A clip(rho, 1 - clip, 1 + clip))` with `rho = exp(log_prob - old_log_prob)`.
pub fn surrogate(log_prob: &Tensor, old_log_prob: &Tensor, advantages: &Tensor, clip: f64) -> Tensor {
    let ratio = (log_prob - old_log_prob).exp();
    let clipped = ratio.clamp(1.0 - clip, 1.0 + clip) * advantages;
    (ratio * advantages).minimum(&clipped)
}

/// The critic's squared error, never more than `most` and without a gradient beyond (RLlib's `vf_clip_param`; it is not the
/// clipping of the value's change of Schulman et al.'s own code).
pub fn clamped_squared_error(values: &Tensor, targets: &Tensor, most: f64) -> Tensor {
    (values - targets).square().clamp_max(most)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Powers of two: the ratios are 2 and 1/2 to rounding, all else is exact.
    #[test]
    fn surrogates_by_hand() {
        let ln2 = std::f64::consts::LN_2;
        let cases = [
            // log ratio, advantage, objective with clip 0.25, d objective / d log-probability
            (ln2, 1.0, 1.25, 0.0),
            (ln2, -1.0, -2.0, -2.0),
            (-ln2, 1.0, 0.5, 0.5),
            (-ln2, -2.0, -1.5, 0.0),
            (0.0, 3.0, 3.0, 3.0),
            (0.0, 0.0, 0.0, 0.0),
        ];
        for (log_ratio, advantage, expected, slope) in cases {
            let log_prob = Tensor::from(-1.0 + log_ratio).set_requires_grad(true);
            let objective = surrogate(&log_prob, &Tensor::from(-1.0), &Tensor::from(advantage), 0.25);
            objective.backward();
            assert!((objective.double_value(&[]) - expected).abs() < 1e-12, "{log_ratio} {advantage}");
            assert!((log_prob.grad().double_value(&[]) - slope).abs() < 1e-12, "{log_ratio} {advantage}");
        }
    }

    #[test]
    fn squared_errors_by_hand() {
        for (value, target, expected, slope) in
            [(0.5, 0.0, 0.25, 1.0), (1.0, 3.0, 4.0, -4.0), (5.0, 1.0, 10.0, 0.0), (-9.0, 1.0, 10.0, 0.0)]
        {
            let value = Tensor::from(value).set_requires_grad(true);
            let error = clamped_squared_error(&value, &Tensor::from(target), 10.0);
            error.backward();
            assert!((error.double_value(&[]) - expected).abs() < 1e-12);
            assert!((value.grad().double_value(&[]) - slope).abs() < 1e-12);
        }
    }
}
