//! A policy for other programs: one time step as TorchScript, which Python's `torch.jit.load` and C++ run.
//!
//! ```text
//! forward(observation, previous_action, first, *state) -> (parameters, value, *state)
//!
//! observation      [rows, components]   the class of a discrete component, the value of a real one, in the space's order
//! previous_action  [rows, components]   what the environment received; not looked at where `first`
//! first            [rows]               not zero: the first step of an episode, whose state starts afresh
//! state            a list of tensors [rows, ...], as `Policy::initial_state` has them; zeros to begin with
//! parameters       [rows, parameters]   of the action distribution: logits, means, logarithms of standard deviations
//! value            [rows]
//! ```

use std::fmt::Write as _;
use std::io::{Cursor, Read as _, Write as _};

use tch::{CModule, Device, IValue, Kind, Tensor};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use crate::encoder::NumberEncoder;
use crate::memory::{Registry, State};
use crate::{ModelError, Policy, PolicySpec, WeightsError};

/// Why a policy cannot be exported.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The policy cannot be built.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The weights are not the policy's.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// libtorch refuses.
    #[error("TorchScript: {0}")]
    TorchScript(#[from] tch::TchError),
    /// What was traced is not the step: numbers of the example have become constants.
    #[error(
        "the TorchScript of memory `{0}` gives other results than its step; a step must be made of tensor operators alone, \
         with neither numbers nor the count of rows read into Rust"
    )]
    Untraceable(String),
    /// The module cannot be written or read again.
    #[error("TorchScript module: {0}")]
    Archive(#[from] std::io::Error),
}

impl From<zip::result::ZipError> for ExportError {
    fn from(error: zip::result::ZipError) -> Self {
        Self::Archive(error.into())
    }
}

/// The step of the policy of `spec` with the weights of a safetensors file, on the CPU, for any number of rows: the bytes
/// of a TorchScript file.
///
/// # Errors
/// What is wrong with the specification or the weights; a memory whose step is not made of libtorch's operators alone, so that
/// the file does not do what the step does.
pub fn torchscript(spec: &PolicySpec, memories: &Registry, weights: &[u8]) -> Result<Vec<u8>, ExportError> {
    let mut policy = Policy::new(spec, memories, Device::Cpu)?;
    policy.load(weights)?;
    for parameter in policy.parameters().values() {
        // Only constants can be traced.
        let _ = parameter.set_requires_grad(false);
    }
    let encoder = NumberEncoder::new(&spec.observation, &spec.action);
    let mut widths = Vec::new();
    let mut flat = |inputs: &[Tensor]| {
        let outputs = step(&policy, &encoder, inputs);
        widths = outputs.iter().map(Width::of).collect();
        let columns: Vec<Tensor> = outputs.iter().zip(&widths).map(|(x, width)| x.view([-1, width.columns])).collect();
        vec![Tensor::cat(&columns, 1)]
    };
    let inputs = example(&policy, &encoder, ROWS, 0.0);
    let module = tch::no_grad(|| CModule::create_by_tracing("Policy", FLAT, &inputs, &mut flat))?;
    let dir = tempfile::tempdir()?;
    let path = dir.path().join("policy.pt");
    module.save(&path)?;
    let bytes = with_forward(&std::fs::read(path)?, &forward_method(&widths))?;
    check(&bytes, &policy, &encoder).then_some(bytes).ok_or_else(|| ExportError::Untraceable(spec.memory.clone()))
}

/// Rows of the example that is traced. Not 1, which a broadcast could hide.
const ROWS: i64 = 2;

/// The traced method: all outputs as columns of one tensor.
const FLAT: &str = "flat";

/// Inputs that are all `number`, with the state before the first step.
fn example(policy: &Policy, encoder: &NumberEncoder, rows: i64, number: f64) -> Vec<Tensor> {
    let filled = |shape: &[i64]| Tensor::full(shape, number, (Kind::Float, Device::Cpu));
    let (observation, action) = encoder.components();
    let mut inputs = vec![filled(&[rows, observation as i64]), filled(&[rows, action as i64]), filled(&[rows])];
    inputs.extend(policy.initial_state(rows).0);
    inputs
}

/// Whether the file does what [`step`] does, over a few steps with other numbers and more rows than were traced.
fn check(file: &[u8], policy: &Policy, encoder: &NumberEncoder) -> bool {
    let Ok(module) = CModule::load_data(&mut Cursor::new(file)) else { return false };
    let mut ours = example(policy, encoder, ROWS + 1, 1.0);
    let mut theirs: Vec<Tensor> = ours.iter().map(Tensor::copy).collect();
    (0..3).all(|_| {
        let inputs: Vec<IValue> = theirs.iter().map(|tensor| IValue::Tensor(tensor.shallow_clone())).collect();
        let Ok(IValue::Tuple(outputs)) = module.forward_is(&inputs) else { return false };
        let found: Vec<Tensor> = outputs.into_iter().filter_map(|output| output.try_into().ok()).collect();
        let expected = tch::no_grad(|| step(policy, encoder, &ours));
        let close = |(a, b): (&Tensor, &Tensor)| a.size() == b.size() && a.allclose(b, 1e-4, 1e-4, true);
        let fit = found.len() == expected.len() && found[..2].iter().zip(&expected).all(close);
        for (inputs, outputs) in [(&mut ours, expected), (&mut theirs, found)] {
            inputs[2] = inputs[2].zeros_like();
            inputs.splice(3.., outputs.into_iter().skip(2));
        }
        fit
    })
}

/// One time step from and to the tensors of the file's description.
fn step(policy: &Policy, encoder: &NumberEncoder, inputs: &[Tensor]) -> Vec<Tensor> {
    let ([observation, previous_action, first], state) = inputs.split_first_chunk().expect("three and the state");
    let first = first.to_kind(Kind::Bool);
    let [observation, previous_action] = [observation, previous_action].map(|x| x.to_kind(Kind::Float));
    let features = encoder.features(&observation, &previous_action, &first);
    let state = State(state.iter().map(|tensor| afresh(tensor, &first)).collect());
    let (parameters, value, next) = policy.step_of_operators(&features, &state);
    [parameters, value].into_iter().chain(next.0).collect()
}

/// `state`, zero where `first`.
fn afresh(state: &Tensor, first: &Tensor) -> Tensor {
    let mut shape = vec![1; state.dim()];
    shape[0] = -1;
    // Not a product: nothing of an episode that went astray stays.
    state.masked_fill(&first.view(&shape[..]), 0.0)
}

/// An output's columns in the flat tensor, and its shape but for the rows.
struct Width {
    columns: i64,
    shape: Vec<i64>,
}

impl Width {
    fn of(tensor: &Tensor) -> Self {
        let shape = tensor.size()[1..].to_vec();
        Self { columns: shape.iter().product(), shape }
    }
}

/// TorchScript's source of a method `forward` that hands out the columns of `flat` by name. Tracing gives a method one output
/// only.
fn forward_method(outputs: &[Width]) -> String {
    let state: Vec<String> = (0..outputs.len() - 2).map(|i| format!("state_{i}")).collect();
    let names = ["observation", "previous_action", "first"].into_iter().chain(state.iter().map(String::as_str));
    let arguments: Vec<String> = names.clone().map(|name| format!("    {name}: Tensor")).collect();
    let types = vec!["Tensor"; outputs.len()].join(", ");
    let mut text = format!("  def forward(self: __torch__.Policy,\n{}) -> Tuple[{types}]:\n", arguments.join(",\n"));
    let _ = writeln!(text, "    flat = (self).{FLAT}({}, )", names.collect::<Vec<_>>().join(", "));
    let mut start = 0;
    for (i, Width { columns, shape }) in outputs.iter().enumerate() {
        let end = start + columns;
        let shape: Vec<i64> = [-1].into_iter().chain(shape.iter().copied()).collect();
        let _ = writeln!(text, "    output_{i} = torch.reshape(torch.slice(flat, 1, {start}, {end}), {shape:?})");
        start = end;
    }
    let outputs: Vec<String> = (0..outputs.len()).map(|i| format!("output_{i}")).collect();
    let _ = writeln!(text, "    return ({})", outputs.join(", "));
    text
}

/// The TorchScript file with one more method in its class.
fn with_forward(module: &[u8], forward: &str) -> Result<Vec<u8>, ExportError> {
    const SOURCE: &str = "/code/__torch__.py";
    let mut archive = ZipArchive::new(Cursor::new(module))?;
    let mut out = ZipWriter::new(Cursor::new(Vec::new()));
    // As libtorch has its tensors; readers may map them.
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    for i in 0..archive.len() {
        let mut file = archive.by_index(i)?;
        let name = file.name()?.into_owned();
        // Positions in a source that is no longer the same.
        if name.ends_with(".debug_pkl") {
            continue;
        }
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        if name.ends_with(SOURCE) {
            bytes.extend_from_slice(forward.as_bytes());
        }
        out.start_file(name, options)?;
        out.write_all(&bytes)?;
    }
    Ok(out.finish()?.into_inner())
}
