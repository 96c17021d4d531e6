//! One memory alone, and how long it takes.

use std::time::Instant;

use popgym_models::memory::{Entry, Memory, State};
use popgym_models::{Packing, device};
use tch::nn::{Adam, Optimizer, OptimizerConfig, VarStore};
use tch::{Cuda, Device, Kind, Tensor};

use crate::options::Shape;

/// Width of the input vectors.
pub(crate) const INPUT: i64 = 128;

/// After so many steps a state starts anew: some states grow for ever.
const EPISODE: u32 = 1024;

/// A memory with its parameters and optimiser.
pub(crate) struct Subject {
    memory: Box<dyn Memory>,
    store: VarStore,
    optimizer: Optimizer,
    threads: u32,
}

/// What a memory is trained on.
pub(crate) struct Batch {
    input: Tensor,
    packing: Packing,
    state: State,
}

impl Subject {
    /// With fresh weights and the default options (256 wide); `threads` are for training.
    pub(crate) fn new(entry: &Entry, device: Device, threads: u32) -> Result<Self, String> {
        let store = VarStore::new(device);
        let memory = entry
            .build(&store.root(), INPUT, &toml::Table::new())
            .map_err(|error| format!("{}: {error}", entry.name))?;
        let optimizer = Adam::default().build(&store, 5e-5).map_err(|error| format!("{}: {error}", entry.name))?;
        Ok(Self { memory, store, optimizer, threads })
    }

    /// Width of an output vector.
    pub(crate) fn output_width(&self) -> i64 {
        self.memory.output_width()
    }

    /// Trainable parameters.
    pub(crate) fn parameters(&self) -> usize {
        self.store.trainable_variables().iter().map(Tensor::numel).sum()
    }

    /// Trainable parameters that stand in matrices: each is multiplied once for each row.
    pub(crate) fn matrix_weights(&self) -> usize {
        self.store.trainable_variables().iter().filter(|tensor| tensor.dim() >= 2).map(Tensor::numel).sum()
    }

    /// Floats of one row's state.
    pub(crate) fn state_floats(&self) -> usize {
        self.memory.initial_state(1, self.store.device()).0.iter().map(Tensor::numel).sum()
    }

    /// Sequences of random numbers.
    pub(crate) fn batch(&self, shape: Shape) -> Batch {
        let device = self.store.device();
        let packing = Packing::new(&vec![shape.steps; shape.sequences as usize]);
        let input = Tensor::randn([packing.rows(), INPUT], (Kind::Float, device));
        Batch { input, packing, state: self.memory.initial_state(shape.sequences, device) }
    }

    /// Forward, and the backward of the mean output to the parameters and the input.
    fn pass(&mut self, batch: &Batch) {
        self.optimizer.zero_grad();
        let input = batch.input.detach().set_requires_grad(true);
        let scan = self.memory.scan(&input, &batch.packing, &batch.state);
        match scan.backward {
            Some(backward) => {
                let part = 1.0 / scan.output.numel() as f64;
                let _ = backward(&scan.output.full_like(part));
            }
            None => scan.output.mean(Kind::Float).backward(),
        }
    }

    /// A pass, and the optimiser's step.
    pub(crate) fn train(&mut self, batch: &Batch) {
        device::set_threads(self.threads);
        self.pass(batch);
        self.optimizer.step();
    }

    /// Seconds that [`Subject::train`] takes.
    pub(crate) fn train_seconds(&mut self, batch: &Batch) -> f64 {
        let begun = self.now();
        self.train(batch);
        (self.now() - begun).as_secs_f64()
    }

    /// Seconds of each pass without the optimiser, over `seconds` and at least one.
    pub(crate) fn passes(&mut self, batch: &Batch, seconds: f64) -> Vec<f64> {
        device::set_threads(self.threads);
        let (begun, mut times) = (self.now(), Vec::new());
        while times.is_empty() || begun.elapsed().as_secs_f64() < seconds {
            let start = self.now();
            self.pass(batch);
            times.push((self.now() - start).as_secs_f64());
        }
        times
    }

    /// Seconds of one step (`act`) of `rows` rows on one thread: means over up to an episode, over `seconds` and at least one.
    pub(crate) fn steps(&self, rows: i64, seconds: f64) -> Vec<f64> {
        device::set_threads(1);
        let device = self.store.device();
        let input = Tensor::randn([rows, INPUT], (Kind::Float, device));
        let (begun, mut times) = (self.now(), Vec::new());
        while times.is_empty() || begun.elapsed().as_secs_f64() < seconds {
            let mut state = self.memory.initial_state(rows, device);
            let (start, mut count) = (self.now(), 0);
            // Many steps for each look at the clock.
            while count == 0 || count < EPISODE && (count % 16 > 0 || start.elapsed().as_secs_f64() < seconds) {
                (_, state) = self.memory.act(&input, &state);
                count += 1;
            }
            times.push((self.now() - start).as_secs_f64() / f64::from(count));
        }
        times
    }

    fn now(&self) -> Instant {
        now(self.store.device())
    }
}

/// The time when all that was asked of the device is done.
fn now(device: Device) -> Instant {
    if let Device::Cuda(index) = device {
        Cuda::synchronize(index as i64);
    }
    Instant::now()
}

/// The most operations a second that a product of square f32 matrices reaches here, over about `seconds`.
pub(crate) fn peak_operations(device: Device, threads: u32, seconds: f64) -> f64 {
    device::set_threads(threads);
    let side = if device.is_cuda() { 8192 } else { 1024 };
    let [a, b, product] = [(); 3].map(|()| Tensor::randn([side, side], (Kind::Float, device)));
    let (begun, mut least) = (now(device), f64::INFINITY);
    while least.is_infinite() || begun.elapsed().as_secs_f64() < seconds {
        let start = now(device);
        let _ = a.mm_out(&product, &b);
        least = least.min((now(device) - start).as_secs_f64());
    }
    2.0 * (side as f64).powi(3) / least
}
