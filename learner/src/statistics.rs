//! Statistics of runs and episodes: pure functions.

use popgym_envs::rng::below;
use popgym_envs::{Purpose, stream};

/// Resamples of an interval.
const RESAMPLES: usize = 2000;

/// What is known of a quantity from several seeds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// How many values.
    pub n: usize,
    /// Their mean.
    pub mean: f64,
    /// Their sample standard deviation (n - 1); none of a single value.
    pub std: Option<f64>,
}

impl Sample {
    /// Of `values`; none if there are none.
    pub fn of(values: &[f64]) -> Option<Self> {
        Some(Self { n: values.len(), mean: mean(values)?, std: standard_deviation(values) })
    }
}

/// The arithmetic mean; none of nothing.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The sample standard deviation, with n - 1; none of fewer than two values.
pub fn standard_deviation(values: &[f64]) -> Option<f64> {
    let mean = mean(values).filter(|_| values.len() > 1)?;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    Some((squares / (values.len() - 1) as f64).sqrt())
}

/// The `p`-quantile, 0 to 1, by linear interpolation between the order statistics (Hyndman and Fan's type 7); none of
/// nothing.
pub fn quantile(values: &[f64], p: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let place = p.clamp(0.0, 1.0) * sorted.len().checked_sub(1)? as f64;
    let (low, high) = (sorted[place.floor() as usize], sorted[place.ceil() as usize]);
    Some(low + (high - low) * place.fract())
}

/// The 95% percentile bootstrap interval of the mean; the same values give the same interval. None of fewer than two
/// values: one says nothing of its own spread.
pub fn bootstrap_interval(values: &[f64]) -> Option<(f64, f64)> {
    if values.len() < 2 {
        return None;
    }
    let mut rng = stream(0, 0, 0, Purpose::Resample);
    let mut draw = || values[below(&mut rng, values.len() as u32) as usize];
    let means: Vec<f64> =
        (0..RESAMPLES).map(|_| (0..values.len()).map(|_| draw()).sum::<f64>() / values.len() as f64).collect();
    Some((quantile(&means, 0.025)?, quantile(&means, 0.975)?))
}

/// Spearman's rank correlation of pairs; equal values share their mean rank. None of fewer than three pairs (two always
/// agree or disagree), or where all values of one side are equal.
pub fn spearman(a: &[f64], b: &[f64]) -> Option<f64> {
    if a.len() != b.len() || a.len() < 3 {
        return None;
    }
    let (a, b) = (ranks(a), ranks(b));
    let middle = (a.len() + 1) as f64 / 2.0;
    let product = |x: &[f64], y: &[f64]| -> f64 { x.iter().zip(y).map(|(x, y)| (x - middle) * (y - middle)).sum() };
    let spread = (product(&a, &a) * product(&b, &b)).sqrt();
    (spread > 0.0).then(|| product(&a, &b) / spread)
}

/// The rank of each value, from 1 for the smallest.
fn ranks(values: &[f64]) -> Vec<f64> {
    let rank = |value: &f64| {
        let below = values.iter().filter(|other| *other < value).count();
        let not_above = values.iter().filter(|other| *other <= value).count();
        (below + not_above + 1) as f64 / 2.0
    };
    values.iter().map(rank).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(found: Option<f64>, expected: f64) {
        let found = found.unwrap();
        assert!((found - expected).abs() < 1e-12, "{found}, expected {expected}");
    }

    #[test]
    fn mean_and_standard_deviation() {
        // Deviations -2, -1, 3: squares 14, divided by 2.
        let sample = Sample::of(&[1.0, 2.0, 6.0]).unwrap();
        assert_eq!((sample.n, sample.mean), (3, 3.0));
        close(sample.std, 7.0_f64.sqrt());
        assert_eq!(Sample::of(&[4.0]), Some(Sample { n: 1, mean: 4.0, std: None }));
        assert_eq!(Sample::of(&[]), None);
    }

    #[test]
    fn quantiles_between_values() {
        let values = [4.0, 1.0, 3.0, 2.0];
        // Places 0, 0.75, 1.5, 2.25 and 3 of 1, 2, 3, 4.
        for (p, expected) in [(0.0, 1.0), (0.25, 1.75), (0.5, 2.5), (0.75, 3.25), (1.0, 4.0)] {
            close(quantile(&values, p), expected);
        }
        assert_eq!(quantile(&[7.0], 0.3), Some(7.0));
        assert_eq!(quantile(&[], 0.5), None);
    }

    #[test]
    fn bootstrap_of_two_values_is_their_range() {
        // The mean of a resample is 0, 1/2 or 1, with chances 1/4, 1/2, 1/4: the tails of 2.5% are within 0 and 1.
        assert_eq!(bootstrap_interval(&[0.0, 1.0]), Some((0.0, 1.0)));
        assert_eq!(bootstrap_interval(&[0.5, 0.5, 0.5]), Some((0.5, 0.5)));
        assert_eq!(bootstrap_interval(&[0.5]), None);
    }

    #[test]
    fn bootstrap_of_many_values_is_near_the_normal_interval() {
        let values: Vec<f64> = (0..100).map(f64::from).collect();
        let (low, high) = bootstrap_interval(&values).unwrap();
        // The population's standard deviation is 28.87: 1.96 standard errors are 5.66.
        assert!((low - (49.5 - 5.66)).abs() < 0.6 && (high - (49.5 + 5.66)).abs() < 0.6, "{low} {high}");
        assert_eq!(bootstrap_interval(&values), Some((low, high)));
    }

    #[test]
    fn rank_correlation() {
        close(spearman(&[1.0, 2.0, 3.0], &[10.0, 20.0, 25.0]), 1.0);
        close(spearman(&[1.0, 2.0, 3.0], &[3.0, 2.0, 1.0]), -1.0);
        // Ranks 1 2 3 4 and 2 1 4 3: sum of squared differences 4, 1 - 6 * 4 / (4 * 15).
        close(spearman(&[0.1, 0.2, 0.3, 0.4], &[2.0, 1.0, 9.0, 8.0]), 0.6);
        // Ranks 1 2.5 2.5 and 1 2 3: deviations -1 .5 .5 and -1 0 1; 1.5 / sqrt(1.5 * 2).
        close(spearman(&[0.0, 5.0, 5.0], &[1.0, 2.0, 3.0]), 1.5 / 3.0_f64.sqrt());
        assert_eq!(spearman(&[1.0, 1.0, 1.0], &[1.0, 2.0, 3.0]), None);
        assert_eq!(spearman(&[1.0, 2.0], &[1.0, 2.0]), None);
    }
}
