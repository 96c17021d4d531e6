//! Checkpoints: a manifest and the files that it names.
//!
//! An input is the manifest, a zero byte, and the optimiser's file; the two files of weights, which a checkpoint carries but
//! does not read, are always the same. Since nobody guesses a SHA-256, `@NAME` in the manifest stands for that of NAME.

use anyhow::Context as _;
use bytes::Bytes;
use popgym_learner::checkpoint::Checkpoint;
use serde_json::Value;
use sha2::{Digest as _, Sha256};

/// Numbers of the optimiser's moments.
const PARAMETERS: i64 = 3;

const MANIFEST: &str = "manifest.json";
const OPTIMIZER: &str = "optimizer.safetensors";

/// The files, by name, that hold what they always hold.
const OTHERS: [(&str, &[u8]); 2] = [("weights.safetensors", b"the newest"), ("sampling.safetensors", b"those before")];

/// The input of a checkpoint: as [`checkpoint()`] reads it.
///
/// # Panics
/// If it cannot be written.
pub fn checkpoint_input(checkpoint: &Checkpoint) -> Vec<u8> {
    let files = checkpoint.to_files(&Value::Null).expect("a checkpoint can be written");
    let get = |name: &str| files.iter().find(|file| file.0 == name).expect("every checkpoint has it").1.clone();
    let manifest =
        files.iter().fold(String::from_utf8_lossy(&get(MANIFEST)).into_owned(), |manifest, (name, bytes)| {
            manifest.replace(&digest(bytes), &format!("@{name}"))
        });
    [manifest.as_bytes(), b"\0", &get(OPTIMIZER)].concat()
}

/// Whether the files are a checkpoint.
pub fn checkpoint(data: &[u8]) -> bool {
    let (manifest, optimizer) =
        data.iter().position(|&byte| byte == 0).map_or((data, &[][..]), |end| (&data[..end], &data[end + 1..]));
    let mut files: Vec<(&str, Bytes)> = OTHERS.map(|(name, bytes)| (name, Bytes::from_static(bytes))).into();
    files.push((OPTIMIZER, Bytes::copy_from_slice(optimizer)));
    // A manifest that is not text is left as it is.
    let manifest = std::str::from_utf8(manifest).map_or_else(
        |_| Bytes::copy_from_slice(manifest),
        |text| {
            files
                .iter()
                .fold(text.to_owned(), |text, (name, bytes)| text.replace(&format!("@{name}"), &digest(bytes)))
                .into()
        },
    );
    files.push((MANIFEST, manifest));
    let Ok(read) = from_files(&files).map_err(|error| format!("{error:#}")) else { return false };
    assert_legal(&read);
    let again = from_files(&read.to_files(&Value::Null).expect("what was read can be written"));
    let again = again.expect("what was written can be read");
    assert_eq!(again.progress, read.progress);
    assert_eq!((&again.weights, &again.sampling), (&read.weights, &read.sampling));
    assert_eq!(again.optimizer.steps, read.optimizer.steps);
    assert!(again.optimizer.first_moment.equal(&read.optimizer.first_moment));
    assert!(again.optimizer.second_moment.equal(&read.optimizer.second_moment));
    true
}

fn from_files(files: &[(&str, Bytes)]) -> anyhow::Result<Checkpoint> {
    Checkpoint::from_files(PARAMETERS, |name| {
        let file = files.iter().find(|(known, _)| *known == name);
        Ok(file.with_context(|| format!("there is no {name}"))?.1.clone())
    })
}

/// A run can go on from here: no count is near its end, and every number is one.
fn assert_legal(checkpoint: &Checkpoint) {
    let progress = &checkpoint.progress;
    for count in [progress.epoch, progress.env_steps, progress.episodes, checkpoint.optimizer.steps] {
        assert!(count < u64::MAX / 2);
    }
    assert!(progress.kl_coef.is_finite() && progress.kl_coef >= 0.0 && progress.wall_seconds.is_finite());
    let returns = progress.recent_returns.iter().chain(&progress.mmer).chain(&progress.mean_return);
    assert!(returns.into_iter().all(|x| x.is_finite()));
    for moment in [&checkpoint.optimizer.first_moment, &checkpoint.optimizer.second_moment] {
        assert_eq!(moment.size(), [PARAMETERS]);
        assert!(bool::try_from(moment.isfinite().all()).expect("a truth value"));
    }
}

fn digest(bytes: &[u8]) -> String {
    format!("{:x}", Sha256::digest(bytes))
}
