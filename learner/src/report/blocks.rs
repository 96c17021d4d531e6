//! `mmer_65k`: the best block of at least 65,536 environment steps, the paper's batch.
//!
//! A maximum over many small epochs is biased upward: the more epochs and the fewer episodes in each, the luckier the
//! luckiest. So consecutive epochs are joined until they are as large as an epoch of the paper.

use crate::observer::EpochMetrics;

/// Environment steps of a block, at least.
pub const BLOCK_STEPS: u64 = 65_536;

/// A block of fewer episodes counts as an epoch of so few would: with the mean of the last 100 episodes.
const WINDOW: u64 = 100;

/// The maximum over complete blocks, if there is one.
pub fn mmer_65k(rows: &[EpochMetrics]) -> Option<f64> {
    block_values(rows).into_iter().filter(|value| value.is_finite()).reduce(f64::max)
}

/// The value of each complete block: the mean return of its episodes, or, of fewer than [`WINDOW`], the `mean_return` of
/// its last epoch.
pub fn block_values(rows: &[EpochMetrics]) -> Vec<f64> {
    let mut values = Vec::new();
    // Cumulative steps and episodes before the block, and before the epoch.
    let (mut start, mut before) = ((0, 0), 0);
    let mut sum = 0.0;
    for row in rows {
        sum += row.epoch_return * row.episodes.saturating_sub(before) as f64;
        before = row.episodes;
        let (steps, episodes) = (row.env_steps.saturating_sub(start.0), row.episodes.saturating_sub(start.1));
        if steps >= BLOCK_STEPS {
            values.push(if episodes < WINDOW { row.mean_return } else { sum / episodes as f64 });
            (start, sum) = ((row.env_steps, row.episodes), 0.0);
        }
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observer::samples;

    /// Epochs of (steps, episodes, `epoch_return`, `mean_return`).
    fn rows(epochs: &[(u64, u64, f64, f64)]) -> Vec<EpochMetrics> {
        let (mut env_steps, mut episodes) = (0, 0);
        epochs
            .iter()
            .enumerate()
            .map(|(epoch, (more_steps, more_episodes, epoch_return, mean_return))| {
                env_steps += more_steps;
                episodes += more_episodes;
                let row = samples::report(epoch as u64).metrics;
                EpochMetrics { env_steps, episodes, epoch_return: *epoch_return, mean_return: *mean_return, ..row }
            })
            .collect()
    }

    #[test]
    fn epochs_are_joined_and_weighted_by_episodes() {
        // 65,535 steps are no block, 65,536 are: (100 * 0.5 + 300 * 0.25) / 400. The rest begins a block anew.
        let rows = rows(&[
            (65_535, 100, 0.5, 9.0),
            (1, 300, 0.25, 9.0),
            (40_000, 100, 0.0, 9.0),
            (40_000, 100, 1.0, 9.0),
            (60_000, 500, 7.0, 9.0),
        ]);
        assert_eq!(block_values(&rows), [0.3125, 0.5]);
        assert_eq!(mmer_65k(&rows), Some(0.5));
    }

    #[test]
    fn few_episodes_count_by_the_window() {
        // 99 episodes in the block: the last epoch's mean over 100. The next block has 100.
        let rows = rows(&[(40_000, 50, 0.5, 0.1), (40_000, 49, 0.9, 0.2), (70_000, 100, 0.15, 0.7)]);
        assert_eq!(block_values(&rows), [0.2, 0.15]);
    }

    #[test]
    fn an_epoch_of_the_paper_is_a_block() {
        assert_eq!(block_values(&rows(&[(65_600, 400, 0.25, 0.25), (65_700, 400, 0.5, 0.5)])), [0.25, 0.5]);
    }

    #[test]
    fn a_short_run_has_none() {
        assert_eq!(mmer_65k(&rows(&[(60_000, 400, 0.9, 0.9)])), None);
        assert_eq!(mmer_65k(&[]), None);
    }
}
