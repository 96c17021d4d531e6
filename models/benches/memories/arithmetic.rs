//! Means, intervals, medians, operations: all the arithmetic between what was measured and what is printed.

use serde::Serialize;

/// Repeated measurements.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Sample {
    /// Their mean.
    pub(crate) mean: f64,
    /// Half the width of the mean's 95% interval (Student).
    pub(crate) half_width: f64,
    /// In the order of measurement.
    pub(crate) values: Vec<f64>,
}

impl Sample {
    /// Of two values or more.
    pub(crate) fn new(values: Vec<f64>) -> Self {
        let n = values.len() as f64;
        let mean = mean(&values);
        let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / (n - 1.0);
        let half_width = student_97_5(values.len() as u32 - 1) * (variance / n).sqrt();
        Self { mean, half_width, values }
    }
}

/// The arithmetic mean.
pub(crate) fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// The middle value, or the mean of the two middle ones.
pub(crate) fn median(values: &[f64]) -> f64 {
    quantile(values, 0.5)
}

/// Lower and upper quartile: half of the values lie between them.
pub(crate) fn quartiles(values: &[f64]) -> [f64; 2] {
    [0.25, 0.75].map(|p| quantile(values, p))
}

/// By linear interpolation between the sorted values.
fn quantile(values: &[f64], p: f64) -> f64 {
    let mut values = values.to_vec();
    values.sort_by(f64::total_cmp);
    let place = p * (values.len() - 1) as f64;
    let (low, high) = (values[place.floor() as usize], values[place.ceil() as usize]);
    low + (high - low) * place.fract()
}

/// The 97.5% quantile of Student's distribution.
fn student_97_5(freedom: u32) -> f64 {
    let (mut low, mut high) = (0.0, 100.0);
    for _ in 0..60 {
        let t = f64::midpoint(low, high);
        if student_within(t, freedom) < 0.95 {
            low = t;
        } else {
            high = t;
        }
    }
    high
}

/// The probability that Student's t lies within `+-t` (Abramowitz and Stegun, 26.7.3 and 26.7.4).
fn student_within(t: f64, freedom: u32) -> f64 {
    let angle = (t / f64::from(freedom).sqrt()).atan();
    let (sin, cos) = angle.sin_cos();
    // 1 + 1/2 cos^2 + 1 3 / (2 4) cos^4 ... for even freedom, cos (1 + 2/3 cos^2 + 2 4 / (3 5) cos^4 ...) for odd.
    let odd = freedom % 2 == 1;
    let first = if odd { 2 } else { 1 };
    let mut term = if odd { cos } else { 1.0 };
    let mut sum = 0.0;
    for i in 0..freedom / 2 {
        sum += term;
        let factor = f64::from(first + 2 * i);
        term *= cos * cos * factor / (factor + 1.0);
    }
    if odd { (angle + sin * sum) / std::f64::consts::FRAC_PI_2 } else { sin * sum }
}

/// Floating-point operations of forward and backward for `rows` inputs that are each multiplied by `matrix_weights`
/// weights: a multiplication and an addition for each weight, once for the output, once for the gradient of the weight, once
/// for the gradient of the input.
pub(crate) fn pass_operations(matrix_weights: usize, rows: i64) -> f64 {
    3.0 * 2.0 * matrix_weights as f64 * rows as f64
}
