//! The benchmark's arithmetic.

#[path = "../benches/memories/arithmetic.rs"]
mod arithmetic;

use arithmetic::{Sample, mean, median, pass_operations, quartiles};

/// Tables of Student's distribution: the two-sided 95% quantile by degrees of freedom.
const STUDENT: [(usize, f64); 9] =
    [(1, 12.706), (2, 4.303), (3, 3.182), (4, 2.776), (9, 2.262), (10, 2.228), (29, 2.045), (30, 2.042), (120, 1.980)];

#[test]
fn intervals_are_students() {
    for (freedom, quantile) in STUDENT {
        // Deviations +1 and -1 (and 0, for an odd number) from 7: the standard error is known.
        let n = freedom + 1;
        let values: Vec<f64> = (0..n).map(|i| if i == n / 2 * 2 { 7.0 } else { 6.0 + (i % 2 * 2) as f64 }).collect();
        let error = ((n / 2 * 2) as f64 / freedom as f64 / n as f64).sqrt();
        let sample = Sample::new(values.clone());
        assert_eq!(sample.values, values);
        assert!((sample.mean - 7.0).abs() < 1e-12);
        assert!((sample.half_width / error - quantile).abs() < 6e-4, "{freedom}: {}", sample.half_width / error);
    }
}

#[test]
fn medians_and_means() {
    assert!((median(&[3.0, 1.0, 20.0]) - 3.0).abs() < 1e-12);
    assert!((median(&[3.0, 1.0, 20.0, 5.0]) - 4.0).abs() < 1e-12);
    let [low, high] = quartiles(&[20.0, 1.0, 3.0, 5.0, 9.0]);
    assert!((low - 3.0).abs() < 1e-12 && (high - 9.0).abs() < 1e-12);
    let [low, high] = quartiles(&[1.0, 3.0]);
    assert!((low - 1.5).abs() < 1e-12 && (high - 2.5).abs() < 1e-12);
    assert!((mean(&[3.0, 1.0, 20.0]) - 8.0).abs() < 1e-12);
}

#[test]
fn operations_of_a_linear_layer() {
    // 5 rows through 3 x 2 weights: Y = X W (5 x 3 x 2 products), dW = X^T dY and dX = dY W^T (as many each); each product is
    // two operations.
    assert!((pass_operations(6, 5) - 2.0 * 3.0 * (5 * 3 * 2) as f64).abs() < 1e-12);
}
