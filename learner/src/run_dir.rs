//! A run's directory: where its files are, and that only one learner works in it.

use std::ffi::OsStr;
use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::checkpoint;
use crate::config::Config;
use crate::files;
use crate::observer::{MetricsCsv, Summary, SummaryJson};

const CHECKPOINTS: &str = "checkpoints";

/// A run directory that this process holds the lock of.
pub struct RunDir {
    path: PathBuf,
    run: String,
    _lock: File,
}

/// `run.json`: what identifies the run to its actors.
#[derive(Serialize, Deserialize)]
struct Identity {
    run: String,
}

impl RunDir {
    /// Makes `path` the directory of a new run: writes its configuration and identity.
    ///
    /// # Errors
    /// `path` holds a run or other files, or cannot be written, or another learner is working in it.
    pub fn create(path: &Path, config: &Config) -> anyhow::Result<Self> {
        fs::create_dir_all(path).with_context(|| format!("cannot create the run directory {}", path.display()))?;
        let lock = lock(path)?;
        let mut entries = fs::read_dir(path).with_context(|| format!("cannot read {}", path.display()))?.flatten();
        // What a learner leaves that was killed before it had written a configuration is no obstacle.
        let ours =
            |name: &OsStr| name == "lock" || name == "run.json" || name.to_string_lossy().starts_with(".partial-");
        if let Some(entry) = entries.find(|entry| !ours(&entry.file_name())) {
            bail!("{} is not empty (it holds {}); choose a new directory", path.display(), entry.file_name().display());
        }
        let run = fresh_run_id(path);
        files::write(&path.join("run.json"), &serde_json::to_string_pretty(&Identity { run: run.clone() })?)?;
        // Last: a directory with a configuration is a run.
        files::write(&path.join("config.toml"), &config.to_toml()?)?;
        Ok(Self { path: path.to_owned(), run, _lock: lock })
    }

    /// Opens the directory of an existing run.
    ///
    /// # Errors
    /// `path` holds no run, or another learner is working in it.
    pub fn open(path: &Path) -> anyhow::Result<Self> {
        if !Self::holds_run(path) {
            bail!("{} holds no run (there is no config.toml in it)", path.display());
        }
        let lock = lock(path)?;
        let file = path.join("run.json");
        let text = fs::read_to_string(&file).with_context(|| format!("cannot read {}", file.display()))?;
        let identity: Identity =
            serde_json::from_str(&text).with_context(|| format!("{} is damaged", file.display()))?;
        Ok(Self { path: path.to_owned(), run: identity.run, _lock: lock })
    }

    /// Whether `path` is the directory of a run.
    pub fn holds_run(path: &Path) -> bool {
        Self::config_path(path).exists()
    }

    /// The resolved configuration of the run in `path`.
    pub fn config_path(path: &Path) -> PathBuf {
        path.join("config.toml")
    }

    /// A directory below `runs/` that is not there yet.
    pub fn fresh(config: &Config) -> PathBuf {
        let env = config.env.trim_start_matches("popgym-").trim_end_matches("-v0");
        let stem = format!("{env}-{}-{}-seed{}", config.memory_name(), config.preset, config.seed);
        let path = |number: u32| Path::new("runs").join(format!("{stem}-{number:03}"));
        path((1..u32::MAX).find(|&number| !path(number).exists()).unwrap_or(u32::MAX))
    }

    /// The directory.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The run's id, by which its actors know it.
    pub fn run(&self) -> &str {
        &self.run
    }

    /// Where its checkpoints are.
    pub fn checkpoints(&self) -> PathBuf {
        self.path.join(CHECKPOINTS)
    }
}

/// The summary of the run in `path`, if the run has nothing left to do: it has come to the end that `config` says, its metrics
/// too, and its last weights were saved (or all checkpoints were removed since).
pub(crate) fn finished(path: &Path, config: &Config) -> Option<Summary> {
    let summary: Summary = serde_json::from_slice(&fs::read(path.join(SummaryJson::FILE)).ok()?).ok()?;
    let ended = summary.is_complete() && config.reached(summary.env_steps, summary.mmer).is_some();
    let last = MetricsCsv::read(path).ok()?.pop()?;
    let dir = path.join(CHECKPOINTS);
    let checkpoints = checkpoint::list(&dir).ok()?;
    let saved = checkpoints.is_empty() || checkpoints.contains(&checkpoint::path(&dir, summary.epochs));
    (ended && last.env_steps == summary.env_steps && saved).then_some(summary)
}

/// An id that no other run has: of this time, this process and this directory.
fn fresh_run_id(path: &Path) -> String {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
    let text = format!("{} {} {}", now.as_nanos(), std::process::id(), path.display());
    format!("{:x}", Sha256::digest(text))[..16].to_owned()
}

/// Whether a learner is working in the run directory `path`.
pub(crate) fn is_locked(path: &Path) -> bool {
    // For writing: NFS grants exclusive locks on nothing less.
    File::options()
        .write(true)
        .open(path.join("lock"))
        .is_ok_and(|file| matches!(file.try_lock(), Err(TryLockError::WouldBlock)))
}

fn lock(path: &Path) -> anyhow::Result<File> {
    let file = path.join("lock");
    let lock = File::create(&file).with_context(|| format!("cannot write {}", file.display()))?;
    match lock.try_lock() {
        Ok(()) => Ok(lock),
        Err(TryLockError::WouldBlock) => bail!("another learner is working in {}", path.display()),
        Err(TryLockError::Error(error)) => Err(error).with_context(|| format!("cannot lock {}", file.display())),
    }
}
