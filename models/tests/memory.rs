//! What every memory must be: step equals scan, neighbours change nothing, gradients are right. Over the whole registry.

mod common;

use common::*;
use popgym_envs::Space;
use popgym_models::memory::Registry;
use popgym_models::{ModelError, Packing, State};
use tch::{Device, Kind, Tensor};

const WIDTH: i64 = 128;
const RAGGED: [i64; 9] = [7, 1, 40, 23, 40, 2, 1, 16, 31];

fn scan_all(memory: &dyn popgym_models::memory::Memory, sequences: &[Tensor]) -> (Vec<Tensor>, Vec<State>) {
    let (packing, packed) = pack(sequences);
    let scan = tch::no_grad(|| memory.scan(&packed, &packing, &memory.initial_state(packing.sequences(), Device::Cpu)));
    assert!(scan.computed_steps >= packing.rows());
    let place = |sequence| packing.order().iter().position(|&other| other == sequence).unwrap() as i64;
    let states = (0..sequences.len()).map(|sequence| scan.state.select(&[place(sequence)])).collect();
    (unpack(&scan.output, &packing), states)
}

#[test]
fn steps_repeated_equal_one_scan() {
    for name in names() {
        let (memory, _) = memory(name, WIDTH, "");
        let sequences = sequences(&RAGGED, WIDTH);
        let (outputs, states) = scan_all(&*memory, &sequences);
        for ((sequence, output), state) in sequences.iter().zip(&outputs).zip(&states) {
            let (expected, last) = by_steps(&*memory, sequence);
            assert_eq!(output.size(), [sequence.size()[0], memory.output_width()]);
            assert_close(output, &expected, 1e-5, name);
            assert_eq!(state.0.len(), last.0.len());
            for (state, last) in state.0.iter().zip(&last.0) {
                assert_close(state, last, 1e-5, name);
            }
        }
    }
}

#[test]
fn a_state_carried_into_a_scan_continues_it() {
    for name in names() {
        let (memory, _) = memory(name, WIDTH, "");
        let x = random(30, WIDTH);
        let whole = scan_all(&*memory, &[x.shallow_clone()]).0;
        tch::no_grad(|| {
            let first = memory.scan(&x.narrow(0, 0, 11), &Packing::new(&[11]), &memory.initial_state(1, Device::Cpu));
            let rest = memory.scan(&x.narrow(0, 11, 19), &Packing::new(&[19]), &first.state);
            assert_close(&Tensor::cat(&[first.output, rest.output], 0), &whole[0], 1e-5, name);
        });
    }
}

#[test]
fn what_else_is_in_the_batch_changes_nothing() {
    for name in names() {
        let (memory, _) = memory(name, WIDTH, "");
        let episode = random(17, WIDTH);
        let alone = scan_all(&*memory, &[episode.shallow_clone()]);
        for others in [[40, 33, 17], [1, 3, 16], [40, 1, 17]] {
            // Wild numbers next to it must not leak either.
            let mut batch: Vec<Tensor> = sequences(&others, WIDTH).into_iter().map(|x| x * 1e6).collect();
            batch.insert(1, episode.shallow_clone());
            let (outputs, states) = scan_all(&*memory, &batch);
            assert_close(&outputs[1], &alone.0[0], 1e-5, name);
            for (state, expected) in states[1].0.iter().zip(&alone.1[0].0) {
                assert_close(state, expected, 1e-5, name);
            }
        }
    }
}

#[test]
fn gradients_agree_with_differences() {
    const STEP: f64 = 1e-2;
    for name in names() {
        let (memory, parameters) = memory(name, WIDTH, "");
        let (packing, x) = pack(&sequences(&[9, 4, 12], WIDTH));
        let weight = random(packing.rows(), memory.output_width());
        let loss = |x: &Tensor| {
            let scan = tch::no_grad(|| memory.scan(x, &packing, &memory.initial_state(3, Device::Cpu)));
            (scan.output * &weight).sum(Kind::Double).double_value(&[])
        };
        let grad_x = scan_gradient(&*memory, &x, &packing, &weight);
        let gradients = take_gradients(&parameters);
        let check = |analytic: f64, numeric: f64, what: &str| {
            assert!((analytic - numeric).abs() <= 0.02 * analytic.abs(), "{name} {what}: {analytic} or {numeric}");
        };
        // Along the gradient itself the derivative is its length, which no cancellation makes small.
        let length = grad_x.norm().double_value(&[]);
        let direction = &grad_x * (STEP / length);
        check(length, (loss(&(&x + &direction)) - loss(&(&x - &direction))) / (2.0 * STEP), "input");
        for (key, gradient) in &gradients {
            let length = gradient.norm().double_value(&[]);
            let direction = gradient * (STEP / length);
            let moved = |sign: f64| {
                let _ = tch::no_grad(|| parameters[key].shallow_clone().g_add_(&(&direction * sign)));
                loss(&x)
            };
            let difference = moved(1.0) - moved(-2.0);
            moved(1.0);
            check(length, difference / (2.0 * STEP), key);
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
fn gru_step(parameters: &std::collections::BTreeMap<String, Tensor>, prefix: &str, x: &Tensor, h: &Tensor) -> Tensor {
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
        ("elman", 98_816, 256),
        ("lstm", 395_264, 512),
        ("gru", 296_448, 256),
        ("indrnn", 99_840, 512),
    ];
    for (name, weights, state) in table {
        let (memory, parameters) = memory(name, WIDTH, "");
        assert_eq!(parameters.values().map(Tensor::numel).sum::<usize>(), weights, "{name}");
        let floats: usize = memory.initial_state(3, Device::Cpu).0.iter().map(Tensor::numel).sum();
        assert_eq!(floats, 3 * state, "{name}");
        assert_eq!(memory.output_width(), 256, "{name}");
    }
}

#[test]
fn a_wrong_name_or_option_is_told_by_name() {
    let registry = Registry::standard();
    let Err(ModelError::UnknownMemory { name, nearest }) = registry.get("grru") else { panic!() };
    assert_eq!((name.as_str(), nearest.as_str()), ("grru", "gru"));
    let Err(ModelError::UnknownMemory { nearest, .. }) = registry.get("MLP1") else { panic!() };
    assert!(!nearest.is_empty());
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
