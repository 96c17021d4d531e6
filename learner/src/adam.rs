//! Adam (Kingma and Ba, 2015, algorithm 1) over tensors, with a state that can be saved.
//!
//! The moments of all parameters are two flat vectors, in the order of the parameters' names: few large operations, and
//! the norm of the gradient is the norm of one vector.

use std::collections::BTreeMap;

use tch::{Kind, Tensor};

/// The optimiser's settings.
#[derive(Clone, Copy, Debug)]
pub struct AdamOptions {
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
    /// Added to the root of the second moment.
    pub epsilon: f64,
    /// The gradient is scaled down to this norm; 0: never.
    pub max_grad_norm: f64,
}

/// The optimiser and its moments.
#[derive(Debug)]
pub struct Adam {
    options: AdamOptions,
    names: Vec<String>,
    parameters: Vec<Tensor>,
    state: AdamState,
}

/// What a checkpoint holds of the optimiser.
#[derive(Debug)]
pub struct AdamState {
    /// First moment of all parameters, flat.
    pub first_moment: Tensor,
    /// Second moment of all parameters, flat.
    pub second_moment: Tensor,
    /// Updates made.
    pub steps: u64,
}

impl Adam {
    /// An optimiser of `parameters`, moments zero.
    pub fn new(parameters: &BTreeMap<String, Tensor>, options: AdamOptions) -> Self {
        let names = parameters.keys().cloned().collect();
        let parameters: Vec<Tensor> = parameters.values().map(Tensor::shallow_clone).collect();
        let length: i64 = parameters.iter().map(|parameter| parameter.numel() as i64).sum();
        let zeros = || Tensor::zeros([length], (Kind::Float, parameters[0].device()));
        let state = AdamState { first_moment: zeros(), second_moment: zeros(), steps: 0 };
        Self { options, names, parameters, state }
    }

    /// The state, to be saved.
    pub fn state(&self) -> &AdamState {
        &self.state
    }

    /// Takes a saved state.
    ///
    /// # Errors
    /// Moments of another length.
    pub fn restore(&mut self, saved: &AdamState) -> Result<(), String> {
        let expected = self.state.first_moment.size();
        for moment in [&saved.first_moment, &saved.second_moment] {
            if moment.size() != expected {
                return Err(format!("the optimiser's moments have shape {:?}, expected {expected:?}", moment.size()));
            }
        }
        self.state.first_moment.copy_(&saved.first_moment);
        self.state.second_moment.copy_(&saved.second_moment);
        self.state.steps = saved.steps;
        Ok(())
    }

    /// Sets all gradients to zero.
    pub fn zero_grad(&mut self) {
        for parameter in &mut self.parameters {
            parameter.zero_grad();
        }
    }

    /// One update by the parameters' gradients. Returns the gradient's norm before it was scaled down, a scalar on the
    /// parameters' device.
    ///
    /// # Errors
    /// The first gradient or updated parameter with a number that is not finite. In the first case nothing has been changed.
    pub fn step(&mut self, learning_rate: f64) -> Result<Tensor, String> {
        tch::no_grad(|| {
            let gradients: Vec<Tensor> = self.parameters.iter().map(gradient).collect();
            let flat: Vec<Tensor> = gradients.iter().map(|gradient| gradient.view(-1)).collect();
            let mut flat = Tensor::cat(&flat, 0);
            let norm = flat.norm();
            if !is_finite(&norm) {
                return Err(format!("the gradient of `{}`", self.not_finite(&gradients)));
            }
            if self.options.max_grad_norm > 0.0 {
                let scale = (norm.reciprocal() * self.options.max_grad_norm).clamp_max(1.0);
                let _ = flat.g_mul_(&scale);
            }
            let update = self.update(&flat, learning_rate);
            self.apply(&update);
            // A sum is finite only if all its terms are, and these are far from overflowing it.
            if !is_finite(&update.norm()) {
                return Err(format!("`{}`", self.not_finite(&self.parameters)));
            }
            Ok(norm)
        })
    }

    /// The name of the first of these tensors, one for each parameter, that is not finite; the largest if it is only their
    /// common norm that overflows.
    fn not_finite(&self, tensors: &[Tensor]) -> &str {
        let named = || self.names.iter().zip(tensors);
        let infinite = named().find(|(_, tensor)| !is_finite(&tensor.norm()));
        let largest = || named().max_by(|a, b| norm(a.1).total_cmp(&norm(b.1)));
        infinite.or_else(largest).map_or("", |(name, _)| name)
    }

    /// What is to be added to the parameters, flat.
    fn update(&mut self, gradient: &Tensor, learning_rate: f64) -> Tensor {
        let AdamOptions { beta1, beta2, epsilon, .. } = self.options;
        let state = &mut self.state;
        state.steps += 1;
        let _ = state.first_moment.lerp_(gradient, 1.0 - beta1);
        let _ = state.second_moment.lerp_(&gradient.square(), 1.0 - beta2);
        let correction1 = 1.0 - beta1.powf(state.steps as f64);
        let correction2 = 1.0 - beta2.powf(state.steps as f64);
        let mut denominator = (&state.second_moment / correction2).sqrt_();
        let _ = denominator.g_add_scalar_(epsilon);
        (&state.first_moment / denominator) * (-learning_rate / correction1)
    }

    fn apply(&mut self, update: &Tensor) {
        let mut start = 0;
        for parameter in &mut self.parameters {
            let length = parameter.numel() as i64;
            let _ = parameter.g_add_(&update.narrow(0, start, length).view_as(parameter));
            start += length;
        }
    }
}

fn norm(tensor: &Tensor) -> f64 {
    tensor.norm().double_value(&[])
}

fn is_finite(scalar: &Tensor) -> bool {
    scalar.double_value(&[]).is_finite()
}

/// The gradient, or zeros for a parameter that the loss does not reach.
fn gradient(parameter: &Tensor) -> Tensor {
    let gradient = parameter.grad();
    if gradient.defined() { gradient } else { parameter.zeros_like() }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use tch::{Device, Kind, Tensor};

    use super::{Adam, AdamOptions};

    const OPTIONS: AdamOptions = AdamOptions { beta1: 0.9, beta2: 0.999, epsilon: 1e-8, max_grad_norm: 0.0 };

    fn minimise(adam: &mut Adam, x: &Tensor, target: &Tensor, updates: usize) {
        for _ in 0..updates {
            adam.zero_grad();
            (x - target).square().sum(Kind::Float).backward();
            let _norm = adam.step(0.1).unwrap();
        }
    }

    /// The algorithm box in plain f64, written apart from the tensors.
    fn reference(mut x: Vec<f64>, target: &[f64], updates: i32) -> Vec<f64> {
        let (mut m, mut v) = (vec![0.0; x.len()], vec![0.0; x.len()]);
        for t in 1..=updates {
            for i in 0..x.len() {
                let g = 2.0 * (x[i] - target[i]);
                m[i] = 0.9 * m[i] + 0.1 * g;
                v[i] = 0.999 * v[i] + 0.001 * g * g;
                x[i] -= 0.1 * (m[i] / (1.0 - 0.9f64.powi(t))) / ((v[i] / (1.0 - 0.999f64.powi(t))).sqrt() + 1e-8);
            }
        }
        x
    }

    #[test]
    fn follows_the_algorithm_box() {
        let start = [1.0f32, -2.0, 0.5];
        let target = [0.0f32, 1.0, 0.25];
        let x = Tensor::from_slice(&start).set_requires_grad(true);
        let mut adam = Adam::new(&BTreeMap::from([("x".to_owned(), x.shallow_clone())]), OPTIONS);
        minimise(&mut adam, &x, &Tensor::from_slice(&target), 50);
        let expected = reference(start.map(f64::from).to_vec(), &target.map(f64::from), 50);
        for (found, expected) in Vec::<f32>::try_from(&x).unwrap().into_iter().zip(expected) {
            assert!((f64::from(found) - expected).abs() < 1e-5, "{found} {expected}");
        }
    }

    #[test]
    fn clips_to_the_norm_and_reports_the_norm_before() {
        let x = Tensor::from_slice(&[3.0f32, 4.0]).set_requires_grad(true);
        let options = AdamOptions { beta1: 0.0, max_grad_norm: 1.0, ..OPTIONS };
        let mut adam = Adam::new(&BTreeMap::from([("x".to_owned(), x.shallow_clone())]), options);
        (&x * Tensor::from_slice(&[3.0f32, 4.0])).sum(Kind::Float).backward();
        let norm = adam.step(0.1).unwrap().double_value(&[]);
        assert!((norm - 5.0).abs() < 1e-5);
        let clipped = Vec::<f32>::try_from(&adam.state().first_moment).unwrap();
        assert!((clipped[0] - 0.6).abs() < 1e-6 && (clipped[1] - 0.8).abs() < 1e-6, "{clipped:?}");
    }

    #[test]
    fn what_is_not_finite_is_named() {
        let fresh = || Tensor::from_slice(&[1.0f32, 2.0]).set_requires_grad(true);
        let (x, y) = (fresh(), fresh());
        let parameters = BTreeMap::from([("x".to_owned(), x.shallow_clone()), ("y".to_owned(), y.shallow_clone())]);
        let mut adam = Adam::new(&parameters, OPTIONS);
        let mut step = |factor: f64, learning_rate| {
            adam.zero_grad();
            (x.square().sum(Kind::Float) + (&y * factor).sum(Kind::Float)).backward();
            adam.step(learning_rate).map(|_| ())
        };
        for factor in [f64::NAN, f64::INFINITY] {
            assert_eq!(step(factor, 0.1), Err("the gradient of `y`".to_owned()));
        }
        // Finite numbers whose squares are not: the moments would be lost.
        assert_eq!(step(1e30, 0.1), Err("the gradient of `y`".to_owned()));
        assert_eq!(Vec::<f32>::try_from(&x).unwrap(), [1.0, 2.0], "nothing has been changed");
        assert_eq!(step(1.0, 0.1), Ok(()));
        assert_eq!(step(1.0, 1e39), Err("`x`".to_owned()));
    }

    #[test]
    fn a_restored_state_continues_bit_for_bit() {
        let target = Tensor::from_slice(&[0.3f32, -0.7]);
        let fresh = || Tensor::zeros([2], (Kind::Float, Device::Cpu)).set_requires_grad(true);
        let named = |x: &Tensor| BTreeMap::from([("x".to_owned(), x.shallow_clone())]);
        let x = fresh();
        let mut whole = Adam::new(&named(&x), OPTIONS);
        minimise(&mut whole, &x, &target, 5);
        let y = x.detach().copy().set_requires_grad(true);
        let mut resumed = Adam::new(&named(&y), OPTIONS);
        resumed.restore(whole.state()).unwrap();
        minimise(&mut whole, &x, &target, 5);
        minimise(&mut resumed, &y, &target, 5);
        assert_eq!(Vec::<f32>::try_from(&x).unwrap(), Vec::<f32>::try_from(&y).unwrap());
    }
}
