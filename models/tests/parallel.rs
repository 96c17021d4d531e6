//! Memories whose scan is one formula for whole sequences: chunks, windows, and the states between them.

mod common;

use std::collections::BTreeMap;

use common::*;
use popgym_models::memory::{Memory, Registry, Scan, scan_by_steps};
use popgym_models::{Packing, State};
use tch::nn::VarStore;
use tch::{Device, Kind, Tensor};

const NAMES: [&str; 5] = ["fart", "fwp", "frame_stack", "tcn", "s4d"];
/// Around the edges of chunks of 64 steps.
const LENGTHS: [i64; 9] = [65, 1, 1023, 2, 64, 207, 63, 128, 129];
const SMALL: &str = "hidden_size = 12";

struct Built {
    memory: Box<dyn Memory>,
    store: VarStore,
}

impl Built {
    fn new(name: &str, width: i64, options: &str) -> Self {
        let store = VarStore::new(Device::Cpu);
        let options = options.parse().unwrap();
        let memory = Registry::standard().get(name).unwrap().build(&store.root(), width, &options).unwrap();
        Self { memory, store }
    }

    /// The same numbers in f64.
    fn wide(&self, name: &str, width: i64, options: &str) -> Self {
        let mut wide = Self::new(name, width, options);
        tch::no_grad(|| wide.store.copy(&self.store).unwrap());
        wide.store.double();
        wide
    }

    fn parameters(&self) -> BTreeMap<String, Tensor> {
        self.store.variables().into_iter().collect()
    }
}

fn to_double(state: &State) -> State {
    State(state.0.iter().map(|tensor| tensor.to_kind(Kind::Double)).collect())
}

/// A state that some steps led to.
fn some_state(memory: &dyn Memory, sequences: i64, width: i64) -> State {
    tch::no_grad(|| {
        let initial = memory.initial_state(sequences, Device::Cpu);
        (0..70).fold(initial, |state, _| memory.step(&random(sequences, width), &state).1)
    })
}

/// Gradients of sum(output weight), input first.
fn gradients(
    scan: &mut Scan,
    weight: &Tensor,
    input: &Tensor,
    parameters: &BTreeMap<String, Tensor>,
) -> BTreeMap<String, Tensor> {
    let input = if let Some(backward) = scan.backward.take() {
        backward(weight)
    } else {
        (&scan.output * weight).sum(None::<Kind>).backward();
        input.grad()
    };
    let mut gradients = take_gradients(parameters);
    gradients.insert("(input)".to_owned(), input);
    gradients
}

/// One sequence step by step, from its start.
fn steps(memory: &dyn Memory, sequence: &Tensor) -> (Tensor, State) {
    by_steps(sequence, memory.initial_state(1, Device::Cpu), |x, state| memory.step(x, state))
}

/// What they remember is a sum over the past: it does not hold in which order things came, which only the positional encoding in
/// the inputs can tell.
#[test]
fn sums_do_not_know_the_order() {
    for (name, knows_order) in [("fart", false), ("fwp", false), ("gru", true)] {
        let built = memory(name, 12, "");
        let sequence = random(60, 12);
        let last = |sequence: &Tensor| tch::no_grad(|| steps(&*built.0, sequence).1);
        let (forwards, backwards) = (last(&sequence), last(&sequence.flip([0])));
        for (a, b) in forwards.0.iter().zip(&backwards.0) {
            let difference = largest(&(a - b)) / largest(a);
            assert_eq!(difference > 1e-5, knows_order, "{name}: {difference:e}");
        }
    }
}

#[test]
fn scans_are_the_steps_done_in_f64() {
    for name in NAMES {
        let built = Built::new(name, 128, "");
        let wide = built.wide(name, 128, "");
        let (packing, x) = pack(&sequences(&LENGTHS, 128));
        let state = some_state(&*built.memory, packing.sequences(), 128);
        tch::no_grad(|| {
            let scan = built.memory.scan(&x, &packing, &state);
            let exact = scan_by_steps(&*wide.memory, &x.to_kind(Kind::Double), &packing, &to_double(&state));
            assert_close(&scan.output, &exact.output, 1e-5, name);
            assert!(scan.computed_steps >= packing.rows());
            for (state, exact) in scan.state.0.iter().zip(&exact.state.0) {
                assert_eq!(state.kind(), Kind::Float);
                assert_close(state, exact, 1e-5, name);
            }
        });
    }
}

#[test]
fn gradients_are_those_of_the_steps() {
    for name in NAMES {
        let wide = Built::new(name, 10, SMALL).wide(name, 10, SMALL);
        let parameters = wide.parameters();
        let (packing, x) = pack(&sequences(&[65, 1, 140, 64, 2, 63], 10));
        let x = x.to_kind(Kind::Double);
        let weight = Tensor::randn([packing.rows(), 12], (Kind::Double, Device::Cpu));
        let state = to_double(&wide.memory.initial_state(packing.sequences(), Device::Cpu));
        let state = State(state.0.iter().map(Tensor::rand_like).collect());
        let run = |steps: bool| {
            let x = x.detach().set_requires_grad(true);
            let mut scan = if steps {
                scan_by_steps(&*wide.memory, &x, &packing, &state)
            } else {
                wide.memory.scan(&x, &packing, &state)
            };
            (gradients(&mut scan, &weight, &x, &parameters), scan)
        };
        let ((found, scan), (expected, steps)) = (run(false), run(true));
        assert_gradients_close(&found, &expected, 1e-9, name);
        assert_close(&scan.output, &steps.output, 1e-10, name);
        for (found, expected) in scan.state.0.iter().zip(&steps.state.0) {
            assert_close(found, expected, 1e-10, name);
        }
    }
}

/// Gradients in f32 of what the learner runs.
#[test]
fn gradients_in_f32_are_near_those_in_f64() {
    for name in NAMES {
        let built = Built::new(name, 10, SMALL);
        let wide = built.wide(name, 10, SMALL);
        let (packing, x) = pack(&sequences(&[300, 7, 64], 10));
        let weight = random(packing.rows(), 12);
        let run = |built: &Built, kind: Kind| {
            let x = x.to_kind(kind).detach().set_requires_grad(true);
            let state = built.memory.initial_state(packing.sequences(), Device::Cpu);
            let state = State(state.0.iter().map(|tensor| tensor.to_kind(kind)).collect());
            let mut scan = built.memory.scan(&x, &packing, &state);
            gradients(&mut scan, &weight.to_kind(kind), &x, &built.parameters())
        };
        assert_gradients_close(&run(&built, Kind::Float), &run(&wide, Kind::Double), 1e-4, name);
    }
}

#[test]
fn a_state_carried_over_any_cut_equals_no_cut() {
    for name in NAMES {
        let built = Built::new(name, 128, "");
        let x = random(300, 128);
        let whole = |x: &Tensor, state: &State| built.memory.scan(x, &Packing::new(&[x.size()[0]]), state);
        tch::no_grad(|| {
            let initial = built.memory.initial_state(1, Device::Cpu);
            let expected = whole(&x, &initial);
            for cut in [1, 2, 3, 63, 64, 65, 128, 299] {
                let first = whole(&x.narrow(0, 0, cut), &initial);
                let rest = whole(&x.narrow(0, cut, 300 - cut), &first.state);
                assert_close(&Tensor::cat(&[first.output, rest.output], 0), &expected.output, 1e-5, name);
                for (found, expected) in rest.state.0.iter().zip(&expected.state.0) {
                    assert_close(found, expected, 1e-5, name);
                }
            }
        });
    }
}

#[test]
fn a_rows_action_does_not_depend_on_how_many_rows_act() {
    tch::set_num_threads(1);
    for name in NAMES {
        let built = Built::new(name, 128, "");
        let (x, state) = (random(256, 128), some_state(&*built.memory, 256, 128));
        let (all, next) = built.memory.act(&x, &state);
        let (step, next_step) = tch::no_grad(|| built.memory.step(&x, &state));
        assert_close(&all, &step, 1e-5, name);
        for (next, step) in next.0.iter().zip(&next_step.0) {
            assert_close(next, step, 1e-5, name);
        }
        for rows in [16, 17, 31, 64, 100] {
            let chosen: Vec<i64> = (0..rows).map(|i| (i * 37) % 256).collect();
            let (some, some_next) =
                built.memory.act(&x.index_select(0, &Tensor::from_slice(&chosen)), &state.select(&chosen));
            assert_same_bits(&some, &all.index_select(0, &Tensor::from_slice(&chosen)), name);
            for (some, all) in some_next.0.iter().zip(&next.select(&chosen).0) {
                assert_same_bits(some, all, name);
            }
        }
    }
}

#[test]
fn options_change_sizes_and_bad_ones_are_told() {
    let cases = [
        ("frame_stack", "stack_size = 7\nhidden_size = 20", vec![vec![3, 6, 10]]),
        ("tcn", "window = 2\nhidden_size = 5", vec![vec![3, 1, 10]]),
        ("fart", "key_size = 3\nhidden_size = 7", vec![vec![3, 3, 3], vec![3, 3]]),
        ("fwp", "key_size = 1\nhidden_size = 7", vec![vec![3, 1, 1]]),
        ("s4d", "state_size = 2\nhidden_size = 7", vec![vec![3, 7, 1]; 2]),
        ("s4d", "state_size = 20\nhidden_size = 1", vec![vec![3, 1, 10]; 2]),
    ];
    for (name, options, state) in cases {
        let built = Built::new(name, 10, options);
        let shapes: Vec<Vec<i64>> = built.memory.initial_state(3, Device::Cpu).0.iter().map(Tensor::size).collect();
        assert_eq!(shapes, state, "{name}");
        let x = random(66, 10);
        let (expected, last) = steps(&*built.memory, &x);
        let initial = built.memory.initial_state(1, Device::Cpu);
        let scan = built.memory.scan(&x, &Packing::new(&[66]), &initial);
        assert_close(&scan.output.detach(), &expected, 1e-5, name);
        assert_close(&scan.state.0[0].detach(), &last.0[0], 1e-5, name);
        assert_close(&built.memory.act(&x.narrow(0, 0, 1), &initial).0, &expected.narrow(0, 0, 1), 1e-5, name);
    }
    let wrong = [
        ("frame_stack", "stack_size", 1),
        ("frame_stack", "stack_size", 1025),
        ("tcn", "window", 1),
        ("tcn", "window", -4),
        ("fart", "key_size", 0),
        ("fwp", "key_size", 65_537),
        ("s4d", "state_size", 15),
        ("s4d", "state_size", 0),
        ("s4d", "state_size", 1026),
    ];
    for (name, key, value) in wrong {
        let (store, options) = (VarStore::new(Device::Cpu), format!("{key} = {value}").parse().unwrap());
        let error =
            Registry::standard().get(name).unwrap().build(&store.root(), 4, &options).err().unwrap().to_string();
        assert!(error.contains(&format!("`{key}` is {value}, allowed is ")), "{error}");
    }
}

/// The frame stack from its equations, on the first steps, where frames are missing.
#[test]
fn missing_frames_are_zeros_before_their_projection() {
    let built = Built::new("frame_stack", 128, "");
    let parameters = built.parameters();
    let linear = |x: &Tensor, layer: &str| {
        x.matmul(&parameters[&format!("{layer}.weight")].tr()) + &parameters[&format!("{layer}.bias")]
    };
    let relu = |x: Tensor| x.maximum(&(&x * 0.01));
    tch::no_grad(|| {
        let x = random(6, 128);
        let scan = built.memory.scan(&x, &Packing::new(&[6]), &built.memory.initial_state(1, Device::Cpu));
        for t in 0..6 {
            let frame = |i: i64| if i < 0 { Tensor::zeros([1, 128], FLOAT) } else { x.narrow(0, i, 1) };
            let frames: Vec<Tensor> = (t - 3..=t).map(|i| linear(&frame(i), "frame")).collect();
            let expected = relu(linear(&relu(linear(&Tensor::cat(&frames, 1), "first")), "second"));
            assert_close(&scan.output.narrow(0, t, 1), &expected, 1e-5, "frame_stack");
        }
    });
}

/// What a linear attention has summed up after 1,023 equal steps is 1,023 times one step's, and FART's mean does not move.
#[test]
fn sums_of_many_equal_steps_are_exact() {
    for name in ["fart", "fwp"] {
        let built = Built::new(name, 16, "");
        let x = random(1, 16);
        let steps = x.expand([1023, 16], false).contiguous();
        tch::no_grad(|| {
            let initial = built.memory.initial_state(1, Device::Cpu);
            let once = built.memory.step(&x, &initial).1;
            let scan = built.memory.scan(&steps, &Packing::new(&[1023]), &initial);
            for (sum, once) in scan.state.0.iter().zip(&once.0) {
                assert_close(sum, &(once * 1023.0), 1e-5, name);
            }
            if name == "fart" {
                // Up to the 1e-5 in the denominator.
                assert_close(&scan.output.narrow(0, 1022, 1), &scan.output.narrow(0, 100, 1), 1e-5, name);
            }
        });
    }
}

/// Wild inputs make wild sums where nothing normalises them, but no others' and no NaN.
#[test]
fn sums_stay_finite_after_wild_inputs() {
    for name in ["fart", "fwp"] {
        let built = Built::new(name, 128, "");
        let tame = random(1023, 128);
        let (packing, x) = pack(&[tame.shallow_clone(), random(1023, 128) * 1e6, random(500, 128) * 1e12]);
        tch::no_grad(|| {
            let scan = built.memory.scan(&x, &packing, &built.memory.initial_state(3, Device::Cpu));
            assert!(largest(&scan.output).is_finite());
            assert_close(&unpack(&scan.output, &packing)[0], &steps(&*built.memory, &tame).0, 1e-5, name);
        });
    }
}

/// An impulse at the start leaves v_t = K[t] = 2 Re sum_n C_n Bbar_n exp(t z_n), and D at the first step: computed here
/// number by number.
#[test]
fn s4ds_impulse_response_is_its_kernel() {
    const STEPS: i64 = 200;
    let built =
        Built::new("s4d", 4, "hidden_size = 4\nstate_size = 6").wide("s4d", 4, "hidden_size = 4\nstate_size = 6");
    let parameters = built.parameters();
    let double = (Kind::Double, Device::Cpu);
    let set = |name: &str, value: &Tensor| tch::no_grad(|| parameters[name].shallow_clone().copy_(value));
    let random_input = Tensor::randn([4, 3, 2], double);
    set("state_input", &random_input);
    set("input.weight", &Tensor::eye(4, double));
    set("input.bias", &Tensor::zeros([4], double));
    // y = GELU(v) * sigmoid(0)
    set("output.weight", &Tensor::cat(&[Tensor::eye(4, double), Tensor::zeros([4, 4], double)], 0));
    set("output.bias", &Tensor::zeros([8], double));
    let input = Tensor::zeros([STEPS, 4], double);
    let _ = input.narrow(0, 0, 1).fill_(1.0);
    let initial = to_double(&built.memory.initial_state(1, Device::Cpu));
    let scan = tch::no_grad(|| built.memory.scan(&input, &Packing::new(&[STEPS]), &initial));
    let at = |name: &str, index: &[i64]| parameters[name].double_value(index);
    for channel in 0..4 {
        for t in 0..STEPS {
            let mut v = if t == 0 { at("skip", &[channel]) } else { 0.0 };
            for n in 0..3 {
                let step = at("log_step", &[channel]).exp();
                let (a_re, a_im) = (-at("log_decay", &[channel, n]).exp(), at("frequency", &[channel, n]));
                let times = |a: (f64, f64), b: (f64, f64)| (a.0 * b.0 - a.1 * b.1, a.0 * b.1 + a.1 * b.0);
                let exp = |t: f64| ((a_re * t).exp() * (a_im * t).cos(), (a_re * t).exp() * (a_im * t).sin());
                let square = a_re * a_re + a_im * a_im;
                let grown = times((exp(step).0 - 1.0, exp(step).1), (a_re / square, -a_im / square));
                let pair = |name: &str| (at(name, &[channel, n, 0]), at(name, &[channel, n, 1]));
                let driven = times(times(pair("state_input"), grown), exp(step * t as f64));
                v += 2.0 * times(pair("state_output"), driven).0;
            }
            let expected = Tensor::from(v).gelu("none").double_value(&[]) / 2.0;
            let found = scan.output.double_value(&[t, channel]);
            assert!((found - expected).abs() < 1e-10, "channel {channel}, step {t}: {found}, not {expected}");
        }
    }
}

/// Upstream's actors keep the discretisation of their first weights.
#[test]
fn s4d_acts_with_its_present_parameters() {
    let (old, new) = (Built::new("s4d", 6, "hidden_size = 8"), Built::new("s4d", 6, "hidden_size = 8"));
    let x = random(3, 6);
    let state = some_state(&*old.memory, 3, 6);
    let before = old.memory.act(&x, &state).0;
    tch::no_grad(|| {
        old.parameters()["log_step"].shallow_clone().copy_(&new.parameters()["log_step"]);
    });
    assert!(largest(&(old.memory.act(&x, &state).0 - before)) > 1e-4);
    let fresh = old.wide("s4d", 6, "hidden_size = 8");
    let expected = fresh.memory.step(&x.to_kind(Kind::Double), &to_double(&state)).0.detach();
    assert_close(&old.memory.act(&x, &state).0, &expected, 1e-5, "act");
    assert_close(&old.memory.step(&x, &state).0.detach(), &expected, 1e-5, "step");
    let scan = old.memory.scan(&x, &Packing::new(&[1, 1, 1]), &state);
    assert_close(&scan.output.detach(), &expected, 1e-5, "scan");
}

/// Its loop over time in f32, gradients included, against the steps in f64: channels that do and do not fill a vector.
#[test]
fn s4ds_loop_is_the_steps_for_any_size() {
    for (hidden, state_size) in [(1, 2), (19, 16), (33, 20), (64, 2), (97, 16)] {
        let options = format!("hidden_size = {hidden}\nstate_size = {state_size}");
        let built = Built::new("s4d", 10, &options);
        let wide = built.wide("s4d", 10, &options);
        let (packing, x) = pack(&sequences(&[65, 1, 140, 32, 2, 33, 31, 64], 10));
        let state = some_state(&*built.memory, packing.sequences(), 10);
        let weight = random(packing.rows(), hidden);
        let x = x.set_requires_grad(true);
        let mut scan = built.memory.scan(&x, &packing, &state);
        assert!(scan.backward.is_some() && !scan.output.requires_grad());
        let found = gradients(&mut scan, &weight, &x, &built.parameters());
        let x = x.to_kind(Kind::Double).detach().set_requires_grad(true);
        let mut exact = scan_by_steps(&*wide.memory, &x, &packing, &to_double(&state));
        let expected = gradients(&mut exact, &weight.to_kind(Kind::Double), &x, &wide.parameters());
        assert_gradients_close(&found, &expected, 1e-4, &options);
        assert_close(&scan.output, &exact.output, 1e-5, &options);
        for (found, expected) in scan.state.0.iter().zip(&exact.state.0) {
            assert_close(found, expected, 1e-5, &options);
        }
    }
}

#[test]
fn s4ds_frozen_parameters_get_no_gradient() {
    let built = Built::new("s4d", 10, SMALL);
    let parameters = built.parameters();
    let (packing, x) = pack(&sequences(&[40, 3], 10));
    let weight = random(packing.rows(), 12);
    let run = || {
        let grad_input = scan_gradient(&*built.memory, &x, &packing, &weight);
        (grad_input, parameters.iter().filter(|(_, x)| x.grad().defined()).map(|(name, _)| name.as_str()).collect())
    };
    let mut learned: Vec<&str> = parameters.keys().map(String::as_str).collect();
    let order = ["log_step", "state_input", "frequency", "skip", "log_decay", "state_output"];
    let order = order.iter().chain(&["output.weight", "input.bias", "input.weight", "output.bias"]);
    let (expected, all): (Tensor, Vec<&str>) = run();
    assert_eq!(all, learned);
    for frozen in order {
        for parameter in parameters.values() {
            parameter.shallow_clone().zero_grad();
        }
        let _ = parameters[*frozen].set_requires_grad(false);
        let before = parameters[*frozen].grad().copy();
        learned.retain(|name| name != frozen);
        let grad_input = run().0;
        assert_same_bits(&grad_input, &expected, frozen);
        assert_same_bits(&parameters[*frozen].grad(), &before, frozen);
        for name in &learned {
            assert!(largest(&parameters[*name].grad()) > 0.0, "{name} without {frozen}");
        }
    }
    assert!(learned.is_empty());
}
