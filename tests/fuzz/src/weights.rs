//! Weights as safetensors.

use std::collections::BTreeMap;

use bytes::Bytes;
use popgym_models::weights::{load_into, to_bytes};
use popgym_proto::WeightSet;
use tch::{Device, Kind, Tensor};

/// Tensors with the shapes of a policy's, but small: a weight, a bias, a lone number.
fn tensors() -> BTreeMap<String, Tensor> {
    let shapes: [(&str, &[i64]); 3] = [("actor.weight", &[2, 3]), ("actor.bias", &[2]), ("scale", &[])];
    let ones = |shape| Tensor::ones(shape, (Kind::Float, Device::Cpu));
    shapes.into_iter().map(|(name, shape)| (name.to_owned(), ones(shape))).collect()
}

/// A file that is accepted.
pub fn weights_example() -> Vec<u8> {
    to_bytes(&tensors())
}

/// Whether the file is loaded, as a policy loads its weights.
pub fn weights(data: &[u8]) -> bool {
    let loaded = tensors();
    let before = to_bytes(&loaded);
    if let Err(error) = load_into(&loaded, data) {
        assert!(!error.to_string().is_empty());
        assert_eq!(to_bytes(&loaded), before, "a refused file changed weights");
        return false;
    }
    for (name, tensor) in &loaded {
        assert!(bool::try_from(tensor.isfinite().all()).expect("a truth value"), "{name}");
    }
    assert!(WeightSet::new(0, Bytes::copy_from_slice(data)).is_ok(), "what can be loaded can travel");
    let (written, again) = (to_bytes(&loaded), tensors());
    assert_eq!(load_into(&again, &written), Ok(()));
    assert_eq!(to_bytes(&again), written);
    true
}
