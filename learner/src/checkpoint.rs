//! Checkpoints: all that a run needs to continue bit for bit.
//!
//! `checkpoints/epoch-000012/` holds `weights.safetensors`, `sampling.safetensors` (only where the open epoch is sampled
//! with other weights: lag 1), `optimizer.safetensors` and `manifest.json`, with the SHA-256 of each file. The directory
//! is written under a temporary name, synced and renamed, so that one that has its name is whole.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use bytes::Bytes;
use popgym_models::weights;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use sha2::{Digest, Sha256};
use tch::{Kind, Tensor};

use crate::adam::AdamState;
use crate::fail_point;
use crate::files;

const FORMAT: u32 = 1;
const MANIFEST: &str = "manifest.json";
const WEIGHTS: &str = "weights.safetensors";
const SAMPLING: &str = "sampling.safetensors";
const OPTIMIZER: &str = "optimizer.safetensors";
const TEMPORARY_SUFFIX: &str = ".tmp";
/// No run comes to as many epochs, steps, episodes or updates.
const MAX_COUNT: u64 = 1 << 53;

/// The numbers of a run after some epochs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Completed epochs: also the version of the weights.
    pub epoch: u64,
    /// Environment steps of all epochs.
    pub env_steps: u64,
    /// Episodes of all epochs.
    pub episodes: u64,
    /// Coefficient of the KL term in the next epoch.
    pub kl_coef: f64,
    /// Largest mean return of an epoch so far.
    pub mmer: Option<f64>,
    /// Mean return of the last epoch.
    pub mean_return: Option<f64>,
    /// Returns of the last episodes (100 at most), oldest first.
    pub recent_returns: Vec<f64>,
    /// Wall-clock seconds so far.
    pub wall_seconds: f64,
}

/// A run's state between two epochs.
pub struct Checkpoint {
    /// Where the run stands.
    pub progress: Progress,
    /// The newest weights, safetensors.
    pub weights: Bytes,
    /// The weights that sample the next epoch, safetensors.
    pub sampling: Bytes,
    /// The optimiser.
    pub optimizer: AdamState,
}

#[derive(Serialize, Deserialize)]
struct Manifest {
    format: u32,
    /// What this is ([`crate::manifest::describe`]).
    about: Value,
    progress: Progress,
    optimizer_steps: u64,
    /// File name to SHA-256, hexadecimal.
    files: BTreeMap<String, String>,
}

impl Manifest {
    fn parse(bytes: &[u8]) -> anyhow::Result<Self> {
        let manifest: Self = serde_json::from_slice(bytes).with_context(|| format!("{MANIFEST} is not a manifest"))?;
        ensure!(manifest.format == FORMAT, "{MANIFEST} has format {}, expected {FORMAT}", manifest.format);
        let Progress { epoch, env_steps, episodes, .. } = manifest.progress;
        let counts = [
            ("epoch", epoch),
            ("env_steps", env_steps),
            ("episodes", episodes),
            ("optimizer_steps", manifest.optimizer_steps),
        ];
        for (key, count) in counts {
            ensure!(count <= MAX_COUNT, "{MANIFEST}: {key} is {count}, allowed is at most {MAX_COUNT}");
        }
        for (key, number) in [("kl_coef", manifest.progress.kl_coef), ("wall_seconds", manifest.progress.wall_seconds)]
        {
            ensure!(number >= 0.0, "{MANIFEST}: {key} is {number}, allowed is 0 or more");
        }
        Ok(manifest)
    }
}

/// Where below `dir` the checkpoint of the first `epoch` epochs is.
pub(crate) fn path(dir: &Path, epoch: u64) -> PathBuf {
    dir.join(format!("epoch-{epoch:06}"))
}

impl Checkpoint {
    /// Writes the checkpoint below `dir` and returns its path. `about` is kept in the manifest.
    ///
    /// # Errors
    /// The file or directory that cannot be written. What was there before is untouched.
    pub fn save(&self, dir: &Path, about: &Value) -> anyhow::Result<PathBuf> {
        let path = path(dir, self.progress.epoch);
        let temporary = path.with_extension(TEMPORARY_SUFFIX.trim_start_matches('.'));
        remove_dir_if_there(&temporary)?;
        let written = self.write(&temporary, about).and_then(|()| {
            remove_dir_if_there(&path)?;
            fs::rename(&temporary, &path).with_context(|| format!("cannot rename {}", temporary.display()))
        });
        if written.is_err() {
            // A full disk needs the room.
            let _ = fs::remove_dir_all(&temporary);
        }
        written?;
        fail_point::reached("a checkpoint whose name is not yet synced");
        files::sync_dir(dir);
        Ok(path)
    }

    fn write(&self, temporary: &Path, about: &Value) -> anyhow::Result<()> {
        fs::create_dir_all(temporary).with_context(|| format!("cannot create {}", temporary.display()))?;
        for (name, bytes) in self.to_files(about)? {
            fail_point::reached(if name == MANIFEST {
                "a checkpoint without its manifest"
            } else {
                "a checkpoint without all its files"
            });
            write_synced(&temporary.join(name), &bytes)?;
        }
        files::sync_dir(temporary);
        fail_point::reached("a checkpoint under its temporary name");
        Ok(())
    }

    /// The checkpoint's files by name, the manifest last. `about` is kept in the manifest.
    ///
    /// # Errors
    /// None that a run can cause.
    pub fn to_files(&self, about: &Value) -> anyhow::Result<Vec<(&'static str, Bytes)>> {
        let moments = BTreeMap::from([
            ("first_moment".to_owned(), self.optimizer.first_moment.shallow_clone()),
            ("second_moment".to_owned(), self.optimizer.second_moment.shallow_clone()),
        ]);
        let mut files = vec![(WEIGHTS, self.weights.clone()), (OPTIMIZER, weights::to_bytes(&moments).into())];
        if self.sampling != self.weights {
            files.push((SAMPLING, self.sampling.clone()));
        }
        let manifest = Manifest {
            format: FORMAT,
            about: about.clone(),
            progress: self.progress.clone(),
            optimizer_steps: self.optimizer.steps,
            files: files.iter().map(|(name, bytes)| ((*name).to_owned(), hex_digest(bytes))).collect(),
        };
        files.push((MANIFEST, serde_json::to_vec_pretty(&manifest)?.into()));
        Ok(files)
    }

    /// Reads the checkpoint at `path`; its optimiser has `parameters` numbers.
    ///
    /// # Errors
    /// A file that is missing, cannot be read, or is not what the manifest says.
    pub fn load(path: &Path, parameters: i64) -> anyhow::Result<Self> {
        Self::from_files(parameters, |name| read(&path.join(name))).with_context(|| path.display().to_string())
    }

    /// A checkpoint of the files that `read` gives by name; its optimiser has `parameters` numbers.
    ///
    /// # Errors
    /// A file that `read` does not give, or that is not what the manifest says; numbers that no run comes to.
    pub fn from_files(parameters: i64, read: impl Fn(&str) -> anyhow::Result<Bytes>) -> anyhow::Result<Self> {
        let manifest = Manifest::parse(&read(MANIFEST)?)?;
        let mut files = BTreeMap::new();
        for (name, digest) in &manifest.files {
            // A path would lead out of the checkpoint.
            ensure!([WEIGHTS, SAMPLING, OPTIMIZER].contains(&name.as_str()), "{MANIFEST} names a file `{name}`");
            let bytes = read(name)?;
            ensure!(hex_digest(&bytes) == *digest, "{name} is damaged: its SHA-256 is not the manifest's");
            files.insert(name.as_str(), bytes);
        }
        let get = |name: &str| files.get(name).cloned().with_context(|| format!("{MANIFEST} lacks {name}"));
        let zeros = || Tensor::zeros([parameters], (Kind::Float, tch::Device::Cpu));
        let moments = BTreeMap::from([("first_moment".to_owned(), zeros()), ("second_moment".to_owned(), zeros())]);
        weights::load_into(&moments, &get(OPTIMIZER)?).context(OPTIMIZER)?;
        let moment = |name: &str| moments[name].shallow_clone();
        Ok(Self {
            progress: manifest.progress,
            weights: get(WEIGHTS)?,
            sampling: get(SAMPLING).or_else(|_| get(WEIGHTS))?,
            optimizer: AdamState {
                first_moment: moment("first_moment"),
                second_moment: moment("second_moment"),
                steps: manifest.optimizer_steps,
            },
        })
    }

    /// The newest checkpoint below `dir` that is whole and that the run's metrics reach (they end after `rows` epochs); one
    /// that is not is reported and the one before is taken. If the metrics reach none, the newest.
    ///
    /// # Errors
    /// There are checkpoints, and every one is damaged.
    pub fn latest(dir: &Path, parameters: i64, rows: u64) -> anyhow::Result<Option<Self>> {
        let paths = list(dir)?;
        let (mut beyond, mut last_error) = (None, None);
        for path in paths.into_iter().rev() {
            match Self::load(&path, parameters) {
                Ok(checkpoint) if checkpoint.progress.epoch > rows => {
                    beyond.get_or_insert(checkpoint);
                }
                Ok(checkpoint) => {
                    if beyond.is_some() {
                        tracing::warn!(
                            "newer checkpoints than {} are not used: metrics.csv ends before",
                            path.display()
                        );
                    }
                    return Ok(Some(checkpoint));
                }
                Err(error) => {
                    tracing::warn!("checkpoint not used: {error:#}");
                    last_error = Some(error);
                }
            }
        }
        match (beyond, last_error) {
            (None, Some(error)) => Err(error.context("no checkpoint can be used")),
            (beyond, _) => Ok(beyond),
        }
    }
}

/// The paths of the checkpoints below `dir`, oldest first.
///
/// # Errors
/// The directory is there but cannot be read.
pub fn list(dir: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let entries = match fs::read_dir(dir) {
        Ok(entries) => entries,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => bail!("cannot read {}: {error}", dir.display()),
    };
    let mut paths = Vec::new();
    for entry in entries {
        let path = entry.with_context(|| format!("cannot read {}", dir.display()))?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if name.strip_prefix("epoch-").is_some_and(|number| number.bytes().all(|byte| byte.is_ascii_digit())) {
            paths.push(path);
        }
    }
    paths.sort_by_key(|path| (path.as_os_str().len(), path.clone()));
    Ok(paths)
}

/// The best checkpoint below `dir`: the one whose epoch had the largest mean return, the newest of equals.
///
/// # Errors
/// The directory cannot be read.
pub fn best(dir: &Path) -> anyhow::Result<Option<PathBuf>> {
    let manifest = |path: &PathBuf| Manifest::parse(&read(&path.join(MANIFEST)).ok()?).ok();
    let score = |path: &PathBuf| manifest(path).and_then(|manifest| manifest.progress.mean_return);
    let scored = list(dir)?.into_iter().filter_map(|path| score(&path).map(|score| (score, path)));
    Ok(scored.max_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, path)| path))
}

/// Removes all checkpoints below `dir` but the newest `keep` and the best.
///
/// # Errors
/// One that cannot be removed.
pub fn prune(dir: &Path, keep: usize) -> anyhow::Result<()> {
    let paths = list(dir)?;
    let best = best(dir)?;
    let old = paths.len().saturating_sub(keep);
    for path in paths.into_iter().take(old).filter(|path| Some(path) != best.as_ref()) {
        fail_point::reached_with("a checkpoint half removed", || {
            let _ = fs::remove_file(path.join(WEIGHTS));
        });
        fs::remove_dir_all(&path).with_context(|| format!("cannot remove {}", path.display()))?;
    }
    Ok(())
}

fn read(path: &Path) -> anyhow::Result<Bytes> {
    fs::read(path).map(Bytes::from).with_context(|| format!("cannot read {}", path.display()))
}

fn write_synced(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let write = || {
        let mut file = File::create(path)?;
        file.write_all(bytes)?;
        file.sync_all()
    };
    write().with_context(|| format!("cannot write {}", path.display()))
}

fn remove_dir_if_there(path: &Path) -> anyhow::Result<()> {
    match fs::remove_dir_all(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(error).with_context(|| format!("cannot remove {}", path.display()))
        }
        _ => Ok(()),
    }
}

fn hex_digest(bytes: &[u8]) -> String {
    format!("{:x}", Sha256::digest(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn checkpoint(epoch: u64, mean_return: f64) -> Checkpoint {
        let moment = |value: f64| Tensor::full([3], value, (Kind::Float, tch::Device::Cpu));
        Checkpoint {
            progress: Progress {
                epoch,
                env_steps: 10 * epoch,
                episodes: epoch,
                kl_coef: 0.2,
                mmer: Some(mean_return),
                mean_return: Some(mean_return),
                recent_returns: vec![0.1, -1.0 / 3.0],
                wall_seconds: 1.5,
            },
            weights: Bytes::from_static(b"newest"),
            sampling: Bytes::from_static(b"the ones before"),
            optimizer: AdamState { first_moment: moment(1.0 / 3.0), second_moment: moment(2e-9), steps: 7 },
        }
    }

    fn epochs(dir: &Path) -> Vec<u64> {
        list(dir).unwrap().iter().map(|path| Checkpoint::load(path, 3).unwrap().progress.epoch).collect()
    }

    #[test]
    fn what_is_saved_is_loaded() {
        let dir = tempfile::tempdir().unwrap();
        let saved = checkpoint(12, 0.25);
        let path = saved.save(dir.path(), &Value::Null).unwrap();
        let loaded = Checkpoint::load(&path, 3).unwrap();
        assert_eq!(loaded.progress, saved.progress);
        assert_eq!((loaded.weights, loaded.sampling), (saved.weights, saved.sampling));
        assert_eq!(loaded.optimizer.steps, 7);
        assert!(loaded.optimizer.first_moment.equal(&saved.optimizer.first_moment));
        assert!(loaded.optimizer.second_moment.equal(&saved.optimizer.second_moment));
        assert!(Checkpoint::load(&path, 4).is_err());
    }

    #[test]
    fn what_no_run_writes_is_refused() {
        let files = BTreeMap::from_iter(checkpoint(12, 0.25).to_files(&Value::Null).unwrap());
        let manifest = String::from_utf8(files[MANIFEST].to_vec()).unwrap();
        let read = |manifest: &str| {
            Checkpoint::from_files(3, |name| {
                let changed = (name == MANIFEST).then(|| Bytes::from(manifest.to_owned()));
                changed.or_else(|| files.get(name).cloned()).with_context(|| format!("{name} was read"))
            })
        };
        assert!(read(&manifest).is_ok());
        for (from, to, expected) in [
            ("sampling.safetensors", "../sampling", "manifest.json names a file `../sampling`"),
            (": 120,", ": 9007199254740993,", "env_steps is 9007199254740993, allowed is at most 9007199254740992"),
            (": 7,", ": 18446744073709551615,", "optimizer_steps is 18446744073709551615"),
            (": 0.2,", ": -0.2,", "kl_coef is -0.2, allowed is 0 or more"),
            (": 1.5", ": 1e999", "manifest.json is not a manifest: number out of range"),
            ("\"format\": 1", "\"format\": 2", "manifest.json has format 2, expected 1"),
        ] {
            let changed = manifest.replace(from, to);
            assert_ne!(changed, manifest, "{from}");
            let error = format!("{:#}", read(&changed).err().expect(to));
            assert!(error.contains(expected), "{error}");
        }
    }

    #[test]
    fn the_newest_that_can_be_used() {
        let dir = tempfile::tempdir().unwrap();
        assert!(Checkpoint::latest(dir.path(), 3, 9).unwrap().is_none());
        for epoch in [2, 4, 6] {
            checkpoint(epoch, 0.0).save(dir.path(), &Value::Null).unwrap();
        }
        let latest = |rows| Checkpoint::latest(dir.path(), 3, rows).map(|found| found.unwrap().progress.epoch);
        assert_eq!(latest(9).unwrap(), 6);
        assert_eq!(latest(5).unwrap(), 4);
        assert_eq!(latest(1).unwrap(), 6);
        for (epoch, usable) in [(6, Some(4)), (4, Some(2)), (2, None)] {
            fs::write(dir.path().join(format!("epoch-{epoch:06}")).join(WEIGHTS), "damaged").unwrap();
            assert_eq!(latest(9).ok(), usable);
        }
    }

    #[test]
    fn the_last_few_and_the_best_are_kept() {
        let dir = tempfile::tempdir().unwrap();
        for (epoch, mean_return) in [(1, 0.1), (2, 0.9), (3, 0.3), (4, 0.2), (5, 0.4)] {
            checkpoint(epoch, mean_return).save(dir.path(), &Value::Null).unwrap();
        }
        prune(dir.path(), 2).unwrap();
        assert_eq!(epochs(dir.path()), [2, 4, 5]);
    }
}
