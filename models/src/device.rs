//! CPU and CUDA. Building needs no CUDA: its half of libtorch is opened at run time, and only when asked for.

use tch::{Cuda, Device};

use crate::ModelError;

/// The device named `auto` (CUDA where it works, else CPU), `cpu` or `cuda`.
///
/// # Errors
/// An unknown name; `cuda` where the CUDA half of libtorch or a GPU is missing.
pub fn parse(name: &str) -> Result<Device, ModelError> {
    match name {
        "cpu" => Ok(Device::Cpu),
        "cuda" => cuda().map_err(ModelError::Device),
        "auto" => Ok(cuda().unwrap_or(Device::Cpu)),
        _ => Err(ModelError::Device(format!("unknown device `{name}`, allowed are auto, cpu, cuda"))),
    }
}

/// Sets the number of libtorch's threads for this process; a result depends on it (the order of sums).
pub fn set_threads(threads: u32) {
    tch::set_num_threads(threads as i32);
}

fn cuda() -> Result<Device, String> {
    open_cuda_library()?;
    if Cuda::is_available() { Ok(Device::Cuda(0)) } else { Err("libtorch finds no usable NVIDIA GPU".to_owned()) }
}

/// Opens libtorch_cuda.so with its symbols global, once; libtorch finds its CUDA half by them.
#[allow(unsafe_code)]
fn open_cuda_library() -> Result<(), String> {
    use libloading::os::unix::{Library, RTLD_GLOBAL, RTLD_NOW};
    static OPENED: std::sync::OnceLock<Result<(), String>> = std::sync::OnceLock::new();
    OPENED
        .get_or_init(|| {
            // SAFETY: the library's initialisers register kernels with libtorch and have no other effect; it is PyTorch's
            // own, of the version that this program is linked to, and it is never closed.
            let opened = unsafe { Library::open(Some("libtorch_cuda.so"), RTLD_NOW | RTLD_GLOBAL) };
            opened.map(std::mem::forget).map_err(|error| {
                format!("the CUDA half of libtorch cannot be opened ({error}); `make setup` fetches it on a machine with an NVIDIA driver, POPGYM_TORCH=cuda make setup on any")
            })
        })
        .clone()
}
