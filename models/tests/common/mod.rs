//! What the tests of memories and policies share.
#![allow(dead_code, unreachable_pub)]

use std::collections::BTreeMap;

use popgym_envs::Space;
use popgym_models::memory::{Memory, Registry};
use popgym_models::{Packing, Policy, PolicyOptions, PolicySpec, State};
use tch::nn::VarStore;
use tch::{Device, Kind, Tensor};

pub const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);

pub const UNBOUNDED: PolicyOptions = PolicyOptions { log_std_min: f64::NEG_INFINITY, log_std_max: f64::INFINITY };

pub fn names() -> Vec<&'static str> {
    Registry::standard().entries().iter().map(|entry| entry.name).collect()
}

pub fn spec(memory: &str, observation: Space, action: Space) -> PolicySpec {
    let (memory, memory_options) = (memory.to_owned(), toml::Table::new());
    PolicySpec { observation, action, memory, memory_options, options: UNBOUNDED, max_steps: 1024 }
}

pub fn policy(memory: &str, observation: Space, action: Space) -> Policy {
    Policy::new(&spec(memory, observation, action), &Registry::standard(), Device::Cpu).unwrap()
}

/// A memory alone, with its weights by name.
pub fn memory(name: &str, input_width: i64, options: &str) -> (Box<dyn Memory>, BTreeMap<String, Tensor>) {
    let store = VarStore::new(Device::Cpu);
    let entry = Registry::standard().get(name).unwrap().clone();
    let memory = entry.build(&store.root(), input_width, &options.parse().unwrap()).unwrap();
    (memory, store.variables().into_iter().collect())
}

pub fn random(rows: i64, width: i64) -> Tensor {
    Tensor::randn([rows, width], FLOAT)
}

pub fn largest(x: &Tensor) -> f64 {
    if x.numel() == 0 { 0.0 } else { x.abs().max().double_value(&[]) }
}

/// `|a - b| <= relative max(1, |b|)`, with the largest |b|.
pub fn assert_close(a: &Tensor, b: &Tensor, relative: f64, what: &str) {
    assert_eq!(a.size(), b.size(), "{what}");
    let (difference, scale) = (largest(&(a - b)), largest(b).max(1.0));
    assert!(difference <= relative * scale, "{what}: they differ by {difference:e} at a scale of {scale}");
}

pub fn assert_same_bits(a: &Tensor, b: &Tensor, what: &str) {
    assert!(a.size() == b.size() && a.equal(b), "{what}: they differ by {:e}", largest(&(a - b)));
}

/// One tensor of packed rows for each sequence, in the caller's order.
pub fn unpack(packed: &Tensor, packing: &Packing) -> Vec<Tensor> {
    let mut rows = vec![Vec::new(); packing.sequences() as usize];
    let mut row = 0;
    for &alive in packing.batch_sizes() {
        for &sequence in &packing.order()[..alive as usize] {
            rows[sequence].push(row);
            row += 1;
        }
    }
    rows.iter().map(|rows| packed.index_select(0, &Tensor::from_slice(rows))).collect()
}

/// Packs sequences, one tensor each.
pub fn pack(sequences: &[Tensor]) -> (Packing, Tensor) {
    let lengths: Vec<i64> = sequences.iter().map(|sequence| sequence.size()[0]).collect();
    let packing = Packing::new(&lengths);
    let starts: Vec<i64> = lengths
        .iter()
        .scan(0, |sum, length| {
            *sum += length;
            Some(*sum - length)
        })
        .collect();
    let packed = Tensor::cat(sequences, 0).index_select(0, &packing.gather_index(&starts, Device::Cpu));
    (packing, packed)
}

/// Sequences of the given lengths.
pub fn sequences(lengths: &[i64], width: i64) -> Vec<Tensor> {
    lengths.iter().map(|&length| random(length, width)).collect()
}

/// One sequence step by step, as a batch of one row.
pub fn by_steps(
    sequence: &Tensor,
    mut state: State,
    step: impl Fn(&Tensor, &State) -> (Tensor, State),
) -> (Tensor, State) {
    tch::no_grad(|| {
        let mut outputs = Vec::new();
        for t in 0..sequence.size()[0] {
            let (output, next) = step(&sequence.narrow(0, t, 1), &state);
            outputs.push(output);
            state = next;
        }
        (Tensor::cat(&outputs, 0), state)
    })
}

/// d sum(output * weight) / d input, with the parameters' gradients added to.
pub fn scan_gradient(memory: &dyn Memory, input: &Tensor, packing: &Packing, weight: &Tensor) -> Tensor {
    let input = input.detach().set_requires_grad(true);
    let scan = memory.scan(&input, packing, &memory.initial_state(packing.sequences(), Device::Cpu));
    if let Some(backward) = scan.backward {
        assert!(!scan.output.requires_grad(), "an output with a backward of its own is detached");
        backward(weight)
    } else {
        (scan.output * weight).sum(Kind::Float).backward();
        input.grad()
    }
}

/// The gradients by name, and forgets them.
pub fn take_gradients(parameters: &BTreeMap<String, Tensor>) -> BTreeMap<String, Tensor> {
    let take = |(name, parameter): (&String, &Tensor)| {
        let gradient = parameter.grad();
        assert!(gradient.defined(), "{name} has no gradient");
        let gradient = gradient.copy();
        parameter.shallow_clone().zero_grad();
        (name.clone(), gradient)
    };
    parameters.iter().map(take).collect()
}

pub fn assert_gradients_close(a: &BTreeMap<String, Tensor>, b: &BTreeMap<String, Tensor>, relative: f64, what: &str) {
    assert!(a.keys().eq(b.keys()));
    for (name, gradient) in a {
        assert_gradient_close(gradient, &b[name], relative, &format!("{what}: {name}"));
    }
}

/// `|a - b| <= relative |b|`, with the largest |b|, which may not be zero.
pub fn assert_gradient_close(a: &Tensor, b: &Tensor, relative: f64, what: &str) {
    assert_eq!(a.size(), b.size(), "{what}");
    let (difference, scale) = (largest(&(a - b)), largest(b));
    assert!(scale > 0.0, "{what}: the gradient is zero");
    assert!(difference <= relative * scale, "{what}: gradients differ by {difference:e} at a scale of {scale}");
}

/// Whether this machine's libtorch gives a row of a product `[rows, from] x [from, to]` the same bits however many others
/// there are, from 16 on; for these widths.
pub fn libtorch_keeps_rows_apart(widths: &[(i64, i64)]) -> bool {
    widths.iter().all(|&(from, to)| {
        let (x, weight) = (random(256, from), random(to, from));
        let whole = x.mm(&weight.tr());
        [16, 17, 20, 31, 64, 100].iter().all(|&rows| {
            [0, 256 - rows]
                .iter()
                .all(|&start| whole.narrow(0, start, rows).equal(&x.narrow(0, start, rows).mm(&weight.tr())))
        })
    })
}
