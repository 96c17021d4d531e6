//! Weights as safetensors: every name, shape and type checked, nothing executed.

use std::collections::{BTreeMap, BTreeSet};

use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use tch::{Device, Kind, Tensor};

/// Why weights cannot be loaded.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum WeightsError {
    /// Not safetensors.
    #[error("not a safetensors file: {0}")]
    Format(String),
    /// Names that are missing or not expected.
    #[error("tensors missing: [{missing}]; not expected: [{unexpected}]")]
    Names {
        /// Expected names that are not there.
        missing: String,
        /// Names that are there and should not be.
        unexpected: String,
    },
    /// A tensor of another shape or type.
    #[error("tensor `{name}` is {found}, expected {expected}")]
    Tensor {
        /// Its name.
        name: String,
        /// What was found.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// A tensor with infinite or undefined numbers.
    #[error("tensor `{name}` holds numbers that are not finite")]
    NotFinite {
        /// Its name.
        name: String,
    },
}

/// Writes f32 tensors as safetensors, in the order of their names.
pub fn to_bytes(tensors: &BTreeMap<String, Tensor>) -> Vec<u8> {
    let data: Vec<(&String, Vec<usize>, Vec<u8>)> = tensors
        .iter()
        .map(|(name, tensor)| {
            let shape = tensor.size().iter().map(|&size| size as usize).collect();
            let values = Vec::<f32>::try_from(tensor.to_device(Device::Cpu).to_kind(Kind::Float).contiguous().view(-1))
                .expect("a contiguous f32 tensor on the CPU is a vector");
            (name, shape, values.iter().flat_map(|value| value.to_le_bytes()).collect())
        })
        .collect();
    let views = data.iter().map(|(name, shape, bytes)| {
        let view = TensorView::new(Dtype::F32, shape.clone(), bytes).expect("the bytes are the shape's size");
        (name.as_str(), view)
    });
    safetensors::serialize(views, None).expect("f32 tensors with distinct names can always be written")
}

/// Copies the tensors of a safetensors file into `tensors`, which must have the same names and shapes. On an error
/// nothing has been changed.
///
/// # Errors
/// What differs.
pub fn load_into(tensors: &BTreeMap<String, Tensor>, bytes: &[u8]) -> Result<(), WeightsError> {
    let file = SafeTensors::deserialize(bytes).map_err(|error| WeightsError::Format(error.to_string()))?;
    let found: BTreeSet<&str> = file.names().into_iter().collect();
    let expected: BTreeSet<&str> = tensors.keys().map(String::as_str).collect();
    if found != expected {
        let list = |a: &BTreeSet<&str>, b: &BTreeSet<&str>| a.difference(b).copied().collect::<Vec<_>>().join(", ");
        return Err(WeightsError::Names { missing: list(&expected, &found), unexpected: list(&found, &expected) });
    }
    let mut loaded = Vec::with_capacity(tensors.len());
    for (name, target) in tensors {
        let view = file.tensor(name).map_err(|error| WeightsError::Format(error.to_string()))?;
        loaded.push((target, read(name, &view, &target.size())?));
    }
    tch::no_grad(|| {
        for (target, source) in loaded {
            target.shallow_clone().copy_(&source);
        }
    });
    Ok(())
}

fn read(name: &str, view: &TensorView<'_>, size: &[i64]) -> Result<Tensor, WeightsError> {
    let shape: Vec<i64> = view.shape().iter().map(|&size| size as i64).collect();
    if view.dtype() != Dtype::F32 || shape != size {
        return Err(WeightsError::Tensor {
            name: name.to_owned(),
            found: format!("{:?} {shape:?}", view.dtype()),
            expected: format!("F32 {size:?}"),
        });
    }
    let values: Vec<f32> =
        view.data().chunks_exact(4).map(|bytes| f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])).collect();
    if !values.iter().all(|value| value.is_finite()) {
        return Err(WeightsError::NotFinite { name: name.to_owned() });
    }
    Ok(Tensor::from_slice(&values).view(size))
}
