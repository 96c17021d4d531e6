//! The peak memory of a training step on the CPU: that of a process of its own.

use std::process::Command;

use popgym_models::memory::Registry;
use tch::Device;

use crate::measure::Subject;
use crate::options::Shape;

/// The argument that makes this program such a process.
pub(crate) const ARGUMENT: &str = "--peak-of";

/// The bytes that a training step needs beyond the parameters and Adam's moments: input, gradients, and all that is kept for
/// the backward.
///
/// # Errors
/// That the process failed, for example for want of memory, or that the system does not tell.
pub(crate) fn of(memory: &str, shape: Shape, threads: u32) -> Result<u64, String> {
    let program = std::env::current_exe().map_err(|error| error.to_string())?;
    let arguments = [ARGUMENT.to_owned(), memory.to_owned(), shape.to_string(), threads.to_string()];
    let output = Command::new(program).args(arguments).output().map_err(|error| error.to_string())?;
    let text = String::from_utf8_lossy(&output.stdout);
    let bytes = text.trim().parse().ok().filter(|_| output.status.success());
    bytes.ok_or_else(|| format!("{}; {}", output.status, String::from_utf8_lossy(&output.stderr).trim()))
}

/// What the process does: prints the bytes.
pub(crate) fn child(arguments: &[String]) -> Result<(), String> {
    let [memory, shape, threads] = arguments else { return Err(format!("{ARGUMENT} is this program's own")) };
    let threads = threads.parse().map_err(|error| format!("{threads}: {error}"))?;
    let registry = Registry::standard();
    let entry = registry.get(memory).map_err(|error| error.to_string())?;
    let mut subject = Subject::new(entry, Device::Cpu, threads)?;
    // The libraries' own memory, and Adam's moments.
    let small = subject.batch(Shape { sequences: 2, steps: 3 });
    (0..2).for_each(|_| subject.train(&small));
    let before = status("VmRSS")?;
    let batch = subject.batch(shape.parse()?);
    (0..2).for_each(|_| subject.train(&batch));
    println!("{}", status("VmHWM")?.saturating_sub(before));
    Ok(())
}

/// A line of the system's account of this process, in bytes.
fn status(key: &str) -> Result<u64, String> {
    let text = std::fs::read_to_string("/proc/self/status").map_err(|error| format!("/proc/self/status: {error}"))?;
    let line = text.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(':')?.trim().strip_suffix(" kB"));
    let kibibytes: u64 = line.and_then(|number| number.parse().ok()).ok_or("no such line in /proc/self/status")?;
    Ok(kibibytes * 1024)
}
