//! What every memory must be: its three forms agree, neighbours change nothing, gradients are right. Over the whole
//! registry.

mod common;

use std::collections::BTreeMap;

use common::*;
use popgym_envs::Space;
use popgym_models::memory::{Memory, Registry};
use popgym_models::{ModelError, Packing, State};
use proptest::prelude::*;
use tch::nn::VarStore;
use tch::{Device, Kind, Tensor};

const WIDTH: i64 = 128;
const RAGGED: [i64; 9] = [7, 1, 40, 23, 40, 2, 1, 16, 31];

/// Each sequence's outputs and last state, by one scan of all.
fn scan_all(memory: &dyn Memory, sequences: &[Tensor]) -> (Vec<Tensor>, Vec<State>) {
    let (packing, packed) = pack(sequences);
    let scan = tch::no_grad(|| memory.scan(&packed, &packing, &memory.initial_state(packing.sequences(), Device::Cpu)));
    assert!(scan.computed_steps >= packing.rows());
    let place = |sequence| packing.order().iter().position(|&other| other == sequence).unwrap() as i64;
    let states = (0..sequences.len()).map(|sequence| scan.state.select(&[place(sequence)])).collect();
    (unpack(&scan.output, &packing), states)
}

/// Of the largest output, or of 1 if that is more.
const ROUNDING: f64 = 1e-5;

/// Widths of the DNC's products, from and to: the input, the state before, the read vectors, the interface.
const DNC_PRODUCTS: [(i64, i64); 4] = [(WIDTH, 1024), (256, 1024), (64, 1024), (256, 135)];

/// The largest difference that a jump of the DNC may make; seen were up to 3e-4.
const JUMP: f64 = 1e-3;

/// The largest difference, of the largest |b| or of 1.
fn difference(a: &Tensor, b: &Tensor) -> f64 {
    assert_eq!(a.size(), b.size());
    largest(&(a - b)) / largest(b).max(1.0)
}

/// States are equal if what follows from them is. (Rounding may decide which of a DNC's unused cells is written; it makes no
/// difference to anything read later.)
fn assert_states_equal(memory: &dyn Memory, a: &State, b: &State, what: &str) {
    let x = random(6, WIDTH);
    let follow = |state: &State| {
        let state = State(state.0.iter().map(Tensor::copy).collect());
        by_steps(&x, state, |x, state| memory.step(x, state)).0
    };
    assert_close(&follow(a), &follow(b), ROUNDING, &format!("{what}: what follows"));
}

/// The DNC's output jumps where two usages cross ([`popgym_models::memory::Dnc`]): rounding decides which of the cells is
/// written. Only from such a step on may its outputs differ. (Unused cells are interchangeable and do not count.)
fn begins_at_a_crossing(memory: &dyn Memory, inputs: &Tensor, output: &Tensor, stepped: &Tensor) -> bool {
    /// A few times f32's rounding of a usage.
    const CLOSE: f64 = 5e-7;
    const USED: f64 = 1e-3;
    let differs = (output - stepped).abs().amax(&[1][..], false).gt(ROUNDING * largest(stepped).max(1.0));
    let first = differs.to_kind(Kind::Float).argmax(0, false).int64_value(&[]);
    let usages = |x: &Tensor, state: &State| {
        let (_, state) = memory.step(x, state);
        (state.0[7].copy(), state)
    };
    let initial = memory.initial_state(1, Device::Cpu);
    let usages = by_steps(&inputs.narrow(0, 0, first + 1), initial, usages).0.sort(1, false).0;
    let pairs = usages.size()[1] - 1;
    let (lower, gaps) = (usages.narrow(1, 0, pairs), usages.diff(1, 1, None::<Tensor>, None::<Tensor>));
    lower.gt(USED).logical_and(&gaps.lt(CLOSE)).any().int64_value(&[]) == 1
}

/// Outputs, and what follows from the states, are the same, whether by scan or by steps: those that actors run (`act`), and
/// those of libtorch's operators (`step`). Where a memory may jump, at most one of the sequences does, and only there.
fn assert_forms_agree(name: &str, memory: &dyn Memory, lengths: &[i64]) {
    let sequences = sequences(lengths, WIDTH);
    let (outputs, states) = scan_all(memory, &sequences);
    let initial = || memory.initial_state(1, Device::Cpu);
    let step = |x: &Tensor, state: &State| memory.step(x, state);
    let mut may_jump = name == "dnc";
    let own_rounding = may_jump && !libtorch_keeps_rows_apart(&DNC_PRODUCTS);
    for ((sequence, output), state) in sequences.iter().zip(outputs).zip(states) {
        assert_eq!(output.size(), [sequence.size()[0], memory.output_width()], "{name}");
        let more = random(6, WIDTH);
        let inputs = Tensor::cat(&[sequence, &more], 0);
        let stepped = by_steps(&inputs, initial(), step).0;
        let by_act = by_steps(sequence, initial(), |x, state| memory.act(x, state));
        let followed = |(output, state)| Tensor::cat(&[output, by_steps(&more, state, step).0], 0);
        let (acted, scanned) = (followed(by_act), followed((output, state)));
        let what = format!("{name}, {} of {lengths:?}", sequence.size()[0]);
        let comparisons = [
            ("the scan differs from acting", &scanned, &acted, own_rounding),
            ("acting differs from steps", &acted, &stepped, true),
        ];
        for (differs, a, b, round_apart) in comparisons {
            let difference = difference(a, b);
            if difference > ROUNDING {
                may_jump &= round_apart && difference <= JUMP && begins_at_a_crossing(memory, &inputs, a, b);
                assert!(may_jump, "{what}: {differs} by {difference:e}");
                may_jump = false;
            }
        }
    }
}

/// So that a DNC that learns never jumps where the one that acted did not. Alone or among 20, of which ever fewer go on.
#[test]
fn the_dnc_acts_and_scans_with_the_same_bits() {
    tch::set_num_threads(1);
    if !libtorch_keeps_rows_apart(&DNC_PRODUCTS) {
        println!("skipped: this machine's libtorch does not keep the rows of its products apart");
        return;
    }
    let (memory, _) = memory("dnc", WIDTH, "");
    for round in 0..5 {
        tch::manual_seed(round);
        let sequences = sequences(&[RAGGED.as_slice(), &[207, 1, 2, 51, 51, 9, 40, 31, 90, 12, 66]].concat(), WIDTH);
        let (_, states) = scan_all(&*memory, &sequences);
        for (sequence, scanned) in sequences.iter().zip(states) {
            let alone = |x: &Tensor, state: &State| memory.act(x, state);
            let acted = by_steps(sequence, memory.initial_state(1, Device::Cpu), alone).1;
            for (field, (acted, scanned)) in acted.0.iter().zip(&scanned.0).enumerate() {
                assert_same_bits(acted, scanned, &format!("tensor {field} after {} steps", sequence.size()[0]));
            }
        }
    }
}

#[test]
fn step_act_and_scan_agree_at_the_benchmarks_lengths() {
    tch::manual_seed(1);
    for name in names() {
        let (memory, _) = memory(name, WIDTH, "");
        for lengths in [&[1][..], &[2], &[51], &[207], &[1023], &[51, 1, 207, 2, 51]] {
            assert_forms_agree(name, &*memory, lengths);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 6, ..ProptestConfig::default() })]

    /// Also with weights that are not the first ones. (Not much larger ones: the LMU's own rounding reaches 1e-5 at 1.5 times
    /// the first.)
    #[test]
    fn step_act_and_scan_agree(
        lengths in prop::collection::vec(1..90i64, 1..6), scale in 0.3..1.2f64, seed in 0..1_000_000i64,
    ) {
        tch::manual_seed(seed);
        for name in names() {
            let (memory, parameters) = memory(name, WIDTH, "");
            tch::no_grad(|| parameters.values().for_each(|parameter| {
                let noise = Tensor::randn_like(parameter) * 0.02;
                parameter.shallow_clone().copy_(&(parameter * scale + noise));
            }));
            assert_forms_agree(name, &*memory, &lengths);
        }
    }

    #[test]
    fn a_state_carried_across_cuts_continues(
        length in 3..160i64, cuts in prop::collection::vec(1..160i64, 1..4), seed in 0..1_000_000i64,
    ) {
        tch::manual_seed(seed);
        let mut cuts: Vec<i64> = cuts.into_iter().filter(|&cut| cut < length).chain([0, length]).collect();
        cuts.sort_unstable();
        cuts.dedup();
        for name in names() {
            let (memory, _) = memory(name, WIDTH, "");
            let x = random(length, WIDTH);
            let (whole, last) = scan_all(&*memory, &[x.shallow_clone()]);
            let (mut state, mut outputs) = (memory.initial_state(1, Device::Cpu), Vec::new());
            for span in cuts.windows(2) {
                let (start, steps) = (span[0], span[1] - span[0]);
                let scan =
                    tch::no_grad(|| memory.scan(&x.narrow(0, start, steps), &Packing::new(&[steps]), &state));
                outputs.push(scan.output);
                state = scan.state;
            }
            let what = format!("{name}, cut at {cuts:?}");
            assert_close(&Tensor::cat(&outputs, 0), &whole[0], ROUNDING, &what);
            assert_states_equal(&*memory, &state, &last[0], &what);
        }
    }

    /// What a layout pads with, if it pads, comes from other sequences or from nowhere: neither their number, lengths, order
    /// nor numbers may show, in outputs, states or gradients.
    #[test]
    fn what_else_is_in_the_batch_changes_nothing(
        length in 1..130i64,
        others in prop::collection::vec(1..200i64, 1..5),
        place in 0..5usize,
        scale in prop::sample::select(vec![0.0, 1.0, 1e6]),
        seed in 0..1_000_000i64,
    ) {
        tch::manual_seed(seed);
        for name in names() {
            let (memory, parameters) = memory(name, WIDTH, "");
            let (episode, weight) = (random(length, WIDTH), random(length, memory.output_width()));
            let mut batch: Vec<Tensor> = sequences(&others, WIDTH).into_iter().map(|x| x * scale).collect();
            let place = place.min(batch.len());
            batch.insert(place, episode.shallow_clone());
            let weights: Vec<Tensor> = batch.iter().enumerate().map(|(i, x)| {
                if i == place { weight.shallow_clone() } else { Tensor::zeros([x.size()[0], memory.output_width()], FLOAT) }
            }).collect();
            let what = format!("{name}, {length} at {place} among {others:?}");

            let alone = scan_all(&*memory, &[episode.shallow_clone()]);
            let (outputs, states) = scan_all(&*memory, &batch);
            assert_close(&outputs[place], &alone.0[0], ROUNDING, &what);
            assert_states_equal(&*memory, &states[place], &alone.1[0], &what);

            let gradient = |batch: &[Tensor], weights: &[Tensor], place: usize| {
                let (packing, x) = pack(batch);
                let grad_x = scan_gradient(&*memory, &x, &packing, &pack(weights).1);
                (unpack(&grad_x, &packing).swap_remove(place), take_gradients(&parameters))
            };
            let (grad_alone, gradients_alone) = gradient(&[episode], &[weight], 0);
            let (grad, gradients) = gradient(&batch, &weights, place);
            assert_gradient_close(&grad, &grad_alone, 2.0 * ROUNDING, &what);
            for (key, gradient) in &gradients {
                let what = format!("{what}: {key}");
                if largest(&gradients_alone[key]) > 0.0 {
                    assert_gradient_close(gradient, &gradients_alone[key], 2.0 * ROUNDING, &what);
                } else {
                    // What only acts on a state has no part in a single step.
                    assert!(length <= 2 && largest(gradient) <= 0.0, "{what}: no gradient");
                }
            }
        }
    }
}

/// The memory in f64, with the same weights.
fn wide_memory(name: &str, parameters: &BTreeMap<String, Tensor>) -> (Box<dyn Memory>, BTreeMap<String, Tensor>) {
    let mut store = VarStore::new(Device::Cpu);
    let entry = Registry::standard().get(name).unwrap().clone();
    let memory = entry.build(&store.root(), WIDTH, &toml::Table::new()).unwrap();
    store.double();
    let wide: BTreeMap<String, Tensor> = store.variables().into_iter().collect();
    tch::no_grad(|| wide.iter().for_each(|(name, wide)| wide.shallow_clone().copy_(&parameters[name])));
    (memory, wide)
}

/// In f64 the gradient is that of central differences; the one that trains, in f32, is the f64 one.
#[test]
fn gradients_agree_with_differences() {
    /// Kinks spoil long steps, rounding short ones: the best is taken.
    const STEPS: [f64; 3] = [1e-5, 1e-6, 1e-7];
    for (seed, name) in names().into_iter().enumerate() {
        tch::manual_seed(seed as i64);
        let (memory, parameters) = memory(name, WIDTH, "");
        let (packing, x) = pack(&sequences(&[9, 70, 4, 12], WIDTH));
        let weight = random(packing.rows(), memory.output_width());
        let grad_x = scan_gradient(&*memory, &x, &packing, &weight);
        let gradients = take_gradients(&parameters);

        let (wide_memory, wide_parameters) = wide_memory(name, &parameters);
        let wide = |x: &Tensor| x.to_kind(Kind::Double);
        let initial = || State(memory.initial_state(4, Device::Cpu).0.iter().map(wide).collect());
        let loss = |x: &Tensor| (wide_memory.scan(x, &packing, &initial()).output * &weight).sum(Kind::Double);
        let wide_x = wide(&x).set_requires_grad(true);
        loss(&wide_x).backward();
        let wide_gradients = take_gradients(&wide_parameters);
        assert_gradient_close(&grad_x, &wide_x.grad(), 1e-4, &format!("{name} input"));
        for (key, gradient) in &gradients {
            assert_gradient_close(gradient, &wide_gradients[key], 1e-4, &format!("{name} {key}"));
        }

        let value = |x: &Tensor| tch::no_grad(|| loss(x)).double_value(&[]);
        // Along the gradient itself the derivative is its length, which no cancellation makes small.
        let check = |gradient: &Tensor, along: &dyn Fn(&Tensor) -> f64, what: &str| {
            let length = gradient.norm().double_value(&[]);
            let numeric = STEPS.map(|step| along(&(gradient * (step / length))) / (2.0 * step));
            let close = numeric.iter().any(|numeric| (length - numeric).abs() <= 1e-5 * length);
            assert!(close, "{name} {what}: {length} or {numeric:?}");
        };
        let x = wide_x.detach();
        check(&wide_x.grad(), &|step| value(&(&x + step)) - value(&(&x - step)), "input");
        for (key, gradient) in &wide_gradients {
            let moved = |step: &Tensor| {
                let _ = tch::no_grad(|| wide_parameters[key].shallow_clone().g_add_(step));
                value(&x)
            };
            let difference = |step: &Tensor| {
                let difference = moved(step) - moved(&(step * -2.0));
                moved(step);
                difference
            };
            check(gradient, &difference, key);
        }
    }
}

#[test]
fn gradients_add_up_as_autograds_do() {
    for name in names() {
        let (memory, parameters) = memory(name, WIDTH, "");
        let (packing, x) = pack(&sequences(&[5, 9], WIDTH));
        let weight = random(packing.rows(), memory.output_width());
        let _ = scan_gradient(&*memory, &x, &packing, &weight);
        let once = take_gradients(&parameters);
        let _ = scan_gradient(&*memory, &x, &packing, &weight);
        let _ = scan_gradient(&*memory, &x, &packing, &weight);
        let twice = take_gradients(&parameters).into_iter().map(|(name, gradient)| (name, gradient / 2.0)).collect();
        assert_gradients_close(&twice, &once, 1e-5, name);
        // A frozen parameter gets none, and the others theirs.
        let frozen = parameters.keys().next().unwrap();
        let _ = parameters[frozen].set_requires_grad(false);
        let _ = scan_gradient(&*memory, &x, &packing, &weight);
        for (key, parameter) in &parameters {
            let expected = if key == frozen { 0.0 } else { largest(&once[key]) };
            assert!((largest(&parameter.grad()) - expected).abs() <= 1e-5 * expected, "{name} {key}");
        }
    }
}

/// One GRU step out of elementary operators, written from the reference, section 4.3.
fn gru_step(parameters: &BTreeMap<String, Tensor>, prefix: &str, x: &Tensor, h: &Tensor) -> Tensor {
    let get = |name: &str| &parameters[&format!("{prefix}{name}")];
    let gate = |kind: &str, i: i64, x: &Tensor| {
        let hidden = h.size()[1];
        let weight = get(&format!("weight_{kind}")).narrow(0, i * hidden, hidden);
        x.matmul(&weight.tr()) + get(&format!("bias_{kind}")).narrow(0, i * hidden, hidden)
    };
    let r = (gate("input", 0, x) + gate("state", 0, h)).sigmoid();
    let q = (gate("input", 1, x) + gate("state", 1, h)).sigmoid();
    let n = (gate("input", 2, x) + r * gate("state", 2, h)).tanh();
    (1.0 - &q) * n + q * h
}

#[test]
fn the_gru_has_the_gradients_of_its_equations() {
    let sequences = sequences(&RAGGED, WIDTH);
    for hidden in [256, 19, 1] {
        let (memory, parameters) = memory("gru", WIDTH, &format!("hidden_size = {hidden}"));
        let (packing, x) = pack(&sequences);
        let weight = random(packing.rows(), hidden);
        let grad_x = scan_gradient(&*memory, &x, &packing, &weight);
        let gradients = take_gradients(&parameters);

        let x = x.detach().set_requires_grad(true);
        let mut loss = Tensor::zeros([], FLOAT);
        for (sequence, weight) in unpack(&x, &packing).iter().zip(unpack(&weight, &packing)) {
            let mut h = Tensor::zeros([1, hidden], FLOAT);
            for t in 0..sequence.size()[0] {
                h = gru_step(&parameters, "", &sequence.narrow(0, t, 1), &h);
                loss += (&h * weight.narrow(0, t, 1)).sum(Kind::Float);
            }
        }
        loss.backward();
        assert_close(&grad_x, &x.grad(), 1e-5, "input");
        assert_gradients_close(&gradients, &take_gradients(&parameters), 1e-5, "gru");
    }
}

#[test]
fn truncation_cuts_gradients_and_nothing_else() {
    for name in names() {
        let policy = policy(name, Space::Discrete(5), Space::Discrete(3));
        let lengths = [9, 20, 3, 14];
        let packing = Packing::new(&lengths);
        let x = random(packing.rows(), policy.encoder().width() as i64);
        let weight = random(packing.rows(), 3);
        let run = |bptt| {
            let out = policy.scan(&x, &packing, bptt);
            let (params, values) = (out.params.detach(), out.values.detach());
            let loss = (&out.params * &weight).sum(Kind::Float) + out.values.square().sum(Kind::Float);
            out.backward(&loss);
            (params, values, take_gradients(policy.parameters()))
        };
        let whole = run(0);
        for bptt in [1, 2, 7, 19, 20, 21, 1000] {
            let cut = run(bptt);
            assert_close(&cut.0, &whole.0, 1e-5, name);
            assert_close(&cut.1, &whole.1, 1e-5, name);
            if bptt >= 20 {
                assert_gradients_close(&cut.2, &whole.2, 1e-5, name);
            }
        }
    }
}

/// What comes after a cut has no gradient with respect to what was before it; without the cut it has.
#[test]
fn no_gradient_crosses_a_cut() {
    for name in names() {
        let policy = policy(name, Space::Discrete(5), Space::Discrete(3));
        let packing = Packing::new(&[9, 20, 3, 14]);
        let times: Vec<f32> = packing.steps().zip(0..).flat_map(|(now, t)| vec![t as f32; now.len()]).collect();
        let times = Tensor::from_slice(&times);
        let gradient = |bptt, from: i64| {
            let x = random(packing.rows(), policy.encoder().width() as i64).set_requires_grad(true);
            let out = policy.scan(&x, &packing, bptt);
            let late = times.ge(from).to_kind(Kind::Float);
            let loss = (out.values.square() * &late).sum(Kind::Float);
            out.backward(&loss);
            let early: Tensor = x.grad().abs().sum_dim_intlist(1, false, Kind::Float) * (1.0 - late);
            early.max().double_value(&[])
        };
        for bptt in [1, 2, 7, 19] {
            let crossed = gradient(bptt, bptt);
            assert!(crossed.abs() < 1e-30, "{name}, cut every {bptt} steps: {crossed:e}");
        }
        let remembers = !["mlp", "pos_mlp"].contains(&name);
        assert_eq!(gradient(0, 7) > 0.0, remembers, "{name}, not cut");
    }
}

#[test]
fn truncated_gradients_are_those_of_a_detached_state() {
    let policy = policy("gru", Space::Discrete(5), Space::Discrete(3));
    let sequences = sequences(&[9, 20, 3, 14], policy.encoder().width() as i64);
    let (packing, x) = pack(&sequences);
    let weight = random(packing.rows(), 3);
    let parameters = policy.parameters();
    let linear = |x: &Tensor, layer: &str| {
        let get = |part: &str| &parameters[&format!("{layer}.{part}")];
        x.matmul(&get("weight").tr()) + get("bias")
    };
    let relu = |x: &Tensor| x.maximum(&(x * 0.01));
    let head = |m: &Tensor, head: &str| {
        let first = relu(&linear(m, &format!("{head}.first")));
        linear(&relu(&linear(&first, &format!("{head}.second"))), &format!("{head}.output"))
    };
    for bptt in [1, 4, 20] {
        let out = policy.scan(&x, &packing, bptt);
        let (params, values) = (out.params.detach(), out.values.detach());
        let loss = (&out.params * &weight).sum(Kind::Float) + out.values.square().sum(Kind::Float);
        out.backward(&loss);
        let gradients = take_gradients(parameters);

        let mut loss = Tensor::zeros([], FLOAT);
        let packed = [&weight, &params, &values.unsqueeze(1)].map(|packed| unpack(packed, &packing));
        let [weights, params, values] = &packed;
        for (i, x) in sequences.iter().enumerate() {
            let u = linear(x, "projection");
            let centred = &u - u.mean_dim(1, true, Kind::Float);
            let u = &centred / (centred.square().mean_dim(1, true, Kind::Float) + 1e-5).sqrt();
            let z = relu(&linear(&u, "preprocessor"));
            let mut h = Tensor::zeros([1, 256], FLOAT);
            for t in 0..x.size()[0] {
                if t % bptt == 0 {
                    h = h.detach();
                }
                h = gru_step(parameters, "memory.", &z.narrow(0, t, 1), &h);
                let (actor, critic) = (head(&h, "actor"), head(&h, "critic"));
                assert_close(&actor, &params[i].narrow(0, t, 1), 1e-5, "params");
                assert_close(&critic, &values[i].narrow(0, t, 1), 1e-5, "value");
                loss = loss + (actor * weights[i].narrow(0, t, 1)).sum(Kind::Float) + critic.square().sum(Kind::Float);
            }
        }
        loss.backward();
        assert_gradients_close(&gradients, &take_gradients(parameters), 1e-4, &format!("bptt {bptt}"));
    }
}

#[test]
fn a_state_is_reset_and_selected_by_rows() {
    for name in names() {
        let (memory, _) = memory(name, WIDTH, "");
        let (_, mut state) = memory.step(&random(5, WIDTH), &memory.initial_state(5, Device::Cpu));
        let before: Vec<Tensor> = state.0.iter().map(Tensor::copy).collect();
        state.reset_rows(&[]);
        state.reset_rows(&[1, 4]);
        let initial = memory.initial_state(5, Device::Cpu);
        for ((state, before), initial) in state.select(&[4, 0, 1, 3]).0.iter().zip(&before).zip(&initial.0) {
            for (i, (expected, row)) in [(initial, 4), (before, 0), (initial, 1), (before, 3)].iter().enumerate() {
                assert_same_bits(&state.get(i as i64), &expected.get(*row), name);
            }
        }
    }
}

#[test]
fn sizes_are_the_references() {
    // Reference 4.2: weights, and floats of state, for input 128 and hidden 256.
    let table = [
        ("mlp", 98_816, 0),
        ("pos_mlp", 98_816, 0),
        ("elman", 98_816, 256),
        ("lstm", 395_264, 512),
        ("gru", 296_448, 256),
        ("indrnn", 99_840, 512),
        ("dnc", 577_671, 1_200),
        ("fart", 12_527, 240),
        ("fwp", 13_360, 256),
        ("frame_stack", 139_840, 384),
        ("tcn", 131_328, 384),
        ("lmu", 164_480, 512),
        ("s4d", 177_408, 4_096),
    ];
    assert_eq!(table.map(|(name, ..)| name)[..], names());
    for (name, weights, state) in table {
        let (memory, parameters) = memory(name, WIDTH, "");
        assert_eq!(parameters.values().map(Tensor::numel).sum::<usize>(), weights, "{name}");
        let floats: usize = memory.initial_state(3, Device::Cpu).0.iter().map(Tensor::numel).sum();
        assert_eq!(floats, 3 * state, "{name}");
        assert_eq!(memory.output_width(), 256, "{name}");
    }
}

#[test]
fn no_rows_are_a_batch_too() {
    for name in names() {
        let (memory, _) = memory(name, WIDTH, "");
        let before = memory.initial_state(0, Device::Cpu);
        let (output, after) = memory.act(&Tensor::zeros([0, WIDTH], (Kind::Float, Device::Cpu)), &before);
        assert_eq!(output.size(), [0, memory.output_width()], "{name}");
        let shapes = |state: &State| state.0.iter().map(Tensor::size).collect::<Vec<_>>();
        assert_eq!(shapes(&after), shapes(&before), "{name}");
    }
}

#[test]
fn a_wrong_name_or_option_is_told_by_name() {
    let registry = Registry::standard();
    let Err(ModelError::UnknownMemory { name, nearest }) = registry.get("grru") else { panic!() };
    assert_eq!((name.as_str(), nearest.as_str()), ("grru", "gru"));
    for (typed, meant) in [("MLP1", "mlp"), ("GRU", "gru"), ("LSTM", "lstm"), ("PosMLP", "pos_mlp")] {
        let Err(ModelError::UnknownMemory { nearest, .. }) = registry.get(typed) else { panic!() };
        assert_eq!(nearest, meant);
    }
    let store = tch::nn::VarStore::new(Device::Cpu);
    for name in names() {
        let entry = registry.get(name).unwrap();
        let problem = |error: ModelError| {
            let ModelError::MemoryOptions { memory, problem } = error else { panic!("{error}") };
            assert_eq!(memory, name);
            problem
        };
        let unknown = problem(entry.resolve(&"hiden_size = 3".parse().unwrap()).unwrap_err());
        assert!(unknown.contains("hiden_size"), "{unknown}");
        let defaults = entry.resolve(&toml::Table::new()).unwrap();
        assert_eq!(entry.resolve(&defaults).unwrap(), defaults);
        for key in defaults.keys() {
            let mut options = defaults.clone();
            options.insert(key.clone(), toml::Value::Array(Vec::new()));
            let wrong = problem(entry.resolve(&options).unwrap_err());
            assert!(wrong.contains(key.as_str()), "{wrong}");
        }
        for size in [0, -1, 65_537] {
            let mut options = defaults.clone();
            if options.contains_key("hidden_size") {
                options.insert("hidden_size".to_owned(), size.into());
                let wrong = problem(entry.build(&store.root(), 4, &options).err().expect("no such size"));
                assert!(wrong.contains("hidden_size") && wrong.contains(&size.to_string()), "{wrong}");
            }
        }
    }
}
