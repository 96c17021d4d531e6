//! The exported step does what the policy does: run by libtorch here, and by Python where its torch is there (the
//! variable POPGYM_PYTHON names the interpreter, otherwise python3 is tried).

mod common;

use std::io::Write as _;
use std::process::{Command, Stdio};

use common::*;
use popgym_envs::Space;
use popgym_envs::space::Slab;
use popgym_models::export::ExportError;
use popgym_models::memory::{Memory, MemoryKind, Registry};
use popgym_models::{Policy, State, export, policy};
use serde_json::{Value, json};
use tch::nn::Path;
use tch::{CModule, Device, IValue, Kind, Tensor};

const STEPS: usize = 4;

/// What a player sees in some steps: for each step a row of numbers of observation and previous action, and first flags.
struct Played {
    inputs: Vec<[Tensor; 3]>,
    /// Parameters, value and state of each step, by [`Policy::step`].
    expected: Vec<Vec<Tensor>>,
}

fn observation_space() -> Space {
    Space::Tuple(vec![
        Space::Discrete(3),
        Space::uniform_box(2, -5.0, 5.0),
        Space::MultiDiscrete(vec![4, 4, 2]),
        Space::uniform_box(1, 0.0, 1.0),
    ])
}

fn action_space() -> Space {
    // Zero is not allowed in the second part: its null action is the lower bound.
    Space::Tuple(vec![Space::Discrete(3), Space::uniform_box(1, 0.5, 2.0)])
}

/// Numbers in the space's order from the slab's two lists: observation (3 | 2 | 4 4 2 | 1) or action (3 | 1).
fn numbers(slab: &Slab, rows: usize, order: &[(bool, usize)]) -> Tensor {
    let row = |row| {
        let value = slab.row(row);
        order.iter().map(move |&(real, i)| if real { value.real[i] } else { f32::from(value.discrete[i]) })
    };
    Tensor::from_slice(&(0..rows).flat_map(row).collect::<Vec<f32>>()).view([rows as i64, -1])
}

fn play(policy: &Policy, rows: usize) -> Played {
    let (mut observation, mut action) = (Slab::new(&observation_space(), rows), Slab::new(&action_space(), rows));
    let mut played = Played { inputs: Vec::new(), expected: Vec::new() };
    let mut state = policy.initial_state(rows as i64);
    for t in 0..STEPS {
        // Row 1 begins its second episode in the third step.
        let first: Vec<bool> = (0..rows).map(|row| t == 0 || (t == 2 && row == 1)).collect();
        let mut features = vec![0.0; rows * policy.encoder().width()];
        for (row, features) in features.chunks_exact_mut(policy.encoder().width()).enumerate() {
            let i = t * rows + row;
            let out = observation.row_mut(row);
            out.discrete.copy_from_slice(&[(i % 3) as u8, (i % 4) as u8, (i / 3 % 4) as u8, (i % 2) as u8]);
            out.real.copy_from_slice(&[i as f32 * 0.1 - 1.0, 1.0 - i as f32 * 0.07, 0.5]);
            let out = action.row_mut(row);
            out.discrete[0] = (i % 3) as u8;
            out.real[0] = 0.5 + 0.01 * i as f32;
            policy.encoder().encode(observation.row(row), action.row(row), first[row], features);
        }
        state.reset_rows(&first.iter().zip(0..).filter_map(|(&first, row)| first.then_some(row)).collect::<Vec<i64>>());
        let features = Tensor::from_slice(&features).view([rows as i64, -1]);
        let (parameters, value, next) = policy.step(&features, &state);
        let order = [(false, 0), (true, 0), (true, 1), (false, 1), (false, 2), (false, 3), (true, 2)];
        let first: Vec<f32> = first.into_iter().map(f32::from).collect();
        played.inputs.push([
            numbers(&observation, rows, &order),
            numbers(&action, rows, &[(false, 0), (true, 0)]),
            Tensor::from_slice(&first),
        ]);
        played.expected.push([parameters, value].into_iter().chain(next.0.iter().map(Tensor::copy)).collect());
        state = next;
    }
    played
}

fn assert_played(played: &Played, outputs: &[Vec<Tensor>], what: &str) {
    assert_eq!(outputs.len(), STEPS);
    for (t, (found, expected)) in outputs.iter().zip(&played.expected).enumerate() {
        assert_eq!(found.len(), expected.len(), "{what}");
        // What the next steps say depends on the states: they are compared by that.
        for (found, expected) in found.iter().zip(expected).take(2) {
            assert_close(found, expected, 1e-5, &format!("{what}, step {t}"));
        }
        assert!(found.iter().zip(expected).all(|(found, expected)| found.size() == expected.size()), "{what}");
    }
}

/// The steps in this process.
fn by_libtorch(module: &CModule, played: &Played, start: State, what: &str) -> Vec<Vec<Tensor>> {
    let mut state = start.0;
    let step = |inputs: &[Tensor; 3]| {
        let inputs = inputs.iter().chain(&state).map(|x| IValue::Tensor(x.shallow_clone()));
        let outputs = module.forward_is(&inputs.collect::<Vec<_>>());
        let IValue::Tuple(outputs) = outputs.unwrap_or_else(|error| panic!("{what}: {error}")) else {
            panic!("{what}")
        };
        let outputs: Vec<Tensor> = outputs.into_iter().map(|x| Tensor::try_from(x).unwrap()).collect();
        state = outputs[2..].iter().map(Tensor::shallow_clone).collect();
        outputs
    };
    played.inputs.iter().map(step).collect()
}

/// The interpreter, if it can import torch.
fn python() -> Option<String> {
    let python = std::env::var("POPGYM_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let imports = Command::new(&python).args(["-c", "import torch"]).stderr(Stdio::null()).status();
    imports.is_ok_and(|status| status.success()).then_some(python)
}

fn to_json(x: &Tensor) -> Value {
    match x.size()[..] {
        [] => json!(x.double_value(&[])),
        [rows, ..] => (0..rows).map(|row| to_json(&x.get(row))).collect(),
    }
}

fn from_json(value: &Value, like: &Tensor) -> Tensor {
    fn walk(value: &Value, numbers: &mut Vec<f32>) {
        match value {
            Value::Array(list) => list.iter().for_each(|value| walk(value, numbers)),
            _ => numbers.push(value.as_f64().expect("a number") as f32),
        }
    }
    let mut numbers = Vec::new();
    walk(value, &mut numbers);
    Tensor::from_slice(&numbers).view(&like.size()[..])
}

/// The steps in a process of Python's.
fn by_python(python: &str, path: &std::path::Path, played: &Played, start: &State) -> Vec<Vec<Tensor>> {
    let steps: Vec<Value> =
        played.inputs.iter().map(|inputs| inputs.iter().chain(&start.0).map(to_json).collect()).collect();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/export.py");
    let mut command = Command::new(python);
    let mut child =
        command.arg(script).arg(path).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("Python runs");
    child.stdin.take().unwrap().write_all(Value::from(steps).to_string().as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "Python failed");
    let outputs: Vec<Vec<Value>> = serde_json::from_slice(&output.stdout).unwrap();
    let step = |(outputs, expected): (&Vec<Value>, &Vec<Tensor>)| {
        outputs.iter().zip(expected).map(|(value, like)| from_json(value, like)).collect()
    };
    outputs.iter().zip(&played.expected).map(step).collect()
}

#[test]
fn an_exported_step_is_the_policys() {
    let python = python();
    if python.is_none() {
        println!("skipped: the same in Python (no interpreter with torch; POPGYM_PYTHON names one)");
    }
    let dir = tempfile::tempdir().unwrap();
    for name in names() {
        let spec = spec(name, observation_space(), action_space());
        let policy = Policy::new(&spec, &Registry::standard(), Device::Cpu).unwrap();
        let path = dir.path().join(format!("{name}.pt"));
        let bytes = export::torchscript(&spec, &Registry::standard(), &policy.to_bytes()).unwrap();
        std::fs::write(&path, bytes).unwrap();
        let module = CModule::load(&path).unwrap();
        for rows in [1, 3, 64] {
            let what = format!("{name}, {rows} rows");
            let played = play(&policy, rows);
            let start = || policy.initial_state(rows as i64);
            assert_played(&played, &by_libtorch(&module, &played, start(), &what), &what);
            if let Some(python) = &python {
                assert_played(&played, &by_python(python, &path, &played, &start()), &format!("{what}, Python"));
            }
        }
    }
}

#[test]
fn weights_of_another_policy_are_refused() {
    let spec = |memory| spec(memory, observation_space(), action_space());
    let policy = Policy::new(&spec("mlp"), &Registry::standard(), Device::Cpu).unwrap();
    let error = export::torchscript(&spec("gru"), &Registry::standard(), &policy.to_bytes()).unwrap_err();
    assert!(error.to_string().contains("memory.weight_input"), "{error}");
}

/// Reads numbers into Rust, which a trace takes for constants.
#[derive(Debug)]
struct Reader;

impl MemoryKind for Reader {
    const NAME: &'static str = "reader";
    const PAPER_NAME: &'static str = "Reader";
    const PAPER: &'static str = "none";
    type Options = toml::Table;

    fn new(_: &Path<'_>, _: i64, _: &toml::Table) -> Result<Self, String> {
        Ok(Self)
    }
}

impl Memory for Reader {
    fn output_width(&self) -> i64 {
        policy::WIDTH
    }

    fn initial_state(&self, rows: i64, device: Device) -> State {
        State(vec![Tensor::zeros([rows, 1], (Kind::Float, device))])
    }

    fn step(&self, input: &Tensor, state: &State) -> (Tensor, State) {
        let seen = input.mean(Kind::Float).double_value(&[]);
        (input + seen, State(vec![&state.0[0] + 1.0]))
    }
}

#[test]
fn a_step_that_cannot_be_traced_is_not_exported() {
    let mut memories = Registry::standard();
    memories.register::<Reader>();
    let spec = spec("reader", observation_space(), action_space());
    let policy = Policy::new(&spec, &memories, Device::Cpu).unwrap();
    let error = export::torchscript(&spec, &memories, &policy.to_bytes()).unwrap_err();
    assert!(matches!(&error, ExportError::Untraceable(name) if name == "reader"), "{error}");
}
