//! Generalised advantage estimation (Schulman et al., 2016, equation 16), on the CPU in f64.

/// The value of what follows an episode's last step: 0 where the episode has terminated, also if its time was up at that very
/// step; `last`, that of its last observation, where it was merely truncated and the run bootstraps there
/// (`at_truncation`).
pub fn bootstrap(terminated: bool, at_truncation: bool, last: f64) -> f64 {
    if terminated || !at_truncation { 0.0 } else { last }
}

/// Advantages of one episode.
///
/// `rewards` `r_0 .. r_{T-1}`; `values` `V(o_0) .. V(o_{T-1})`; `bootstrap` is the value of what follows the last step: 0
/// after a termination, `V(o_T)` after a mere truncation if the run bootstraps there. Returns `A_0 .. A_{T-1}`:
///
/// ```text
/// delta_t = r_t + gamma V_{t+1} - V_t
/// A_t     = delta_t + gamma lambda A_{t+1}
/// ```
pub fn advantages(rewards: &[f64], values: &[f64], bootstrap: f64, gamma: f64, lambda: f64) -> Vec<f64> {
    debug_assert_eq!(rewards.len(), values.len());
    let mut advantages = vec![0.0; rewards.len()];
    let (mut next_value, mut next_advantage) = (bootstrap, 0.0);
    for t in (0..rewards.len()).rev() {
        let delta = rewards[t] + gamma * next_value - values[t];
        next_advantage = delta + gamma * lambda * next_advantage;
        next_value = values[t];
        advantages[t] = next_advantage;
    }
    advantages
}

/// What the critic learns: `R_t = A_t + V_t`, of the advantages before they are standardised (reference 3.3). With lambda 1
/// it is the discounted return.
pub fn value_targets(advantages: &[f64], values: &[f64]) -> Vec<f64> {
    advantages.iter().zip(values).map(|(advantage, value)| advantage + value).collect()
}

/// `(x - mean) / max(1e-4, population standard deviation)`, over the whole batch (RLlib's standardisation).
pub fn standardise(values: &mut [f64]) {
    let (mean, variance) = mean_and_variance(values);
    let scale = variance.sqrt().max(1e-4);
    for value in values {
        *value = (*value - mean) / scale;
    }
}

/// Mean and population variance.
pub fn mean_and_variance(values: &[f64]) -> (f64, f64) {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    (mean, values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::{advantages, bootstrap, standardise, value_targets};

    /// Terminated, truncated, both, a single step; in halves and quarters, which are exact.
    #[allow(clippy::float_cmp)]
    #[test]
    fn every_kind_of_end() {
        // gamma 0.5, lambda 1: targets are discounted returns.
        let targets = |rewards: &[f64], values: &[f64], end: f64| {
            value_targets(&advantages(rewards, values, end, 0.5, 1.0), values)
        };
        for (terminated, at_truncation, expected) in
            [(true, true, 0.0), (true, false, 0.0), (false, true, 8.0), (false, false, 0.0)]
        {
            // An episode that is both terminated and truncated counts as terminated.
            let end = bootstrap(terminated, at_truncation, 8.0);
            assert_eq!(end, expected);
            assert_eq!(targets(&[1.0], &[0.25], end), [1.0 + 0.5 * end]);
            assert_eq!(
                targets(&[1.0, 0.0, -2.0], &[0.5, 4.0, -1.0], end),
                [0.5 + 0.125 * end, -1.0 + 0.25 * end, -2.0 + 0.5 * end]
            );
        }
        assert_eq!(advantages(&[1.0], &[0.25], 8.0, 0.5, 0.0), [4.75], "one step, whatever lambda");
    }

    // The numbers are halves and quarters: exact.
    #[allow(clippy::float_cmp)]
    #[test]
    fn hand_computed() {
        // gamma 0.5, lambda 0.5, terminated: delta = [1 + 1 - 1, 0 + 2 - 2, 2 - 4] = [1, 0, -2].
        let result = advantages(&[1.0, 0.0, 2.0], &[1.0, 2.0, 4.0], 0.0, 0.5, 0.5);
        assert_eq!(result, [1.0 - 0.125, -0.5, -2.0]);
        // Truncated with V(o_T) = 6: the last delta grows by 3.
        let result = advantages(&[1.0, 0.0, 2.0], &[1.0, 2.0, 4.0], 6.0, 0.5, 0.5);
        assert_eq!(result, [1.0 + 0.0625, 0.25, 1.0]);
    }

    #[allow(clippy::float_cmp)]
    #[test]
    fn standardised_values() {
        let mut values = [1.0, 3.0];
        standardise(&mut values);
        assert_eq!(values, [-1.0, 1.0]);
        let mut constant = [2.0, 2.0, 2.0];
        standardise(&mut constant);
        assert_eq!(constant, [0.0; 3]);
    }

    proptest! {
        /// The definition as a double sum (equation 16), and with lambda = 1 the discounted return minus the value.
        #[test]
        fn equals_the_definition(
            steps in proptest::collection::vec((-1.0..1.0f64, -1.0..1.0f64), 1..40),
            bootstrap in -1.0..1.0f64, gamma in 0.5..1.0f64, lambda in 0.0..1.0f64,
        ) {
            let (rewards, values): (Vec<f64>, Vec<f64>) = steps.into_iter().unzip();
            let value = |t: usize| if t == rewards.len() { bootstrap } else { values[t] };
            let result = advantages(&rewards, &values, bootstrap, gamma, lambda);
            for (t, found) in result.iter().enumerate() {
                let expected: f64 = (t..rewards.len())
                    .map(|s| (gamma * lambda).powi((s - t) as i32) * (rewards[s] + gamma * value(s + 1) - value(s)))
                    .sum();
                prop_assert!((found - expected).abs() < 1e-9);
            }
            let monte_carlo = advantages(&rewards, &values, bootstrap, gamma, 1.0);
            let discounted: f64 = rewards.iter().enumerate().map(|(t, reward)| gamma.powi(t as i32) * reward).sum();
            let expected = discounted + gamma.powi(rewards.len() as i32) * bootstrap - values[0];
            prop_assert!((monte_carlo[0] - expected).abs() < 1e-9);
        }
    }
}
