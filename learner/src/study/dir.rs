//! A study's directory.
//!
//! ```text
//! study.toml            the study file, written while study.lock is locked
//! trials/NAME/          the run directory of a trial
//! trials/NAME.toml      its configuration
//! trials/NAME.lock      locked by the process that runs it
//! trials/NAME.log       what it said
//! trials/NAME.failures  how it failed, if it did: a line of JSON each time
//! ```

use std::fs::{self, File, TryLockError};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use serde::{Deserialize, Serialize};

use super::plan::{self, Trial};
use crate::Extensions;
use crate::files::{self, AppendFile};
use crate::observer::Summary;
use crate::run_dir;

/// A trial that has failed as often is not tried again.
pub const ATTEMPTS: usize = 3;

/// The directory of a study.
#[derive(Clone, Debug)]
pub struct StudyDir {
    path: PathBuf,
}

/// How a trial stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Standing {
    /// Its run has ended as it should.
    Done,
    /// It has failed [`ATTEMPTS`] times.
    Failed,
    /// It was begun.
    Begun,
    /// Nothing of it is there.
    Fresh,
}

/// One failed attempt at a trial.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failure {
    /// How its process ended.
    pub status: String,
    /// The last that it said.
    pub error: String,
}

/// A directory that holds another study, and in what it differs.
#[derive(Debug, thiserror::Error)]
#[error("{0} holds another study: {1} (trials may only be added at its end)")]
pub struct AnotherStudy(String, String);

/// The right to run a trial; it ends with this value, and with the process.
#[derive(Debug)]
pub struct Claim {
    _lock: File,
}

impl StudyDir {
    /// Makes `path` the directory of the study `text` with these trials, or takes it up again. Trials that were appended to
    /// the study since are taken up, too.
    ///
    /// # Errors
    /// It holds another study ([`AnotherStudy`]), or cannot be read or written.
    pub fn open(path: &Path, text: &str, trials: &[Trial], extensions: &Extensions) -> anyhow::Result<Self> {
        let dir = Self { path: path.to_owned() };
        fs::create_dir_all(dir.trials()).with_context(|| format!("cannot create {}", dir.trials().display()))?;
        // Tasks of an array begin at the same time.
        let lock = path.join("study.lock");
        let locked = File::create(&lock).and_then(|file| file.lock().map(|()| file));
        let _locked = locked.with_context(|| format!("cannot lock {}", lock.display()))?;
        let file = path.join("study.toml");
        match fs::read_to_string(&file) {
            Ok(known) if known == text => return Ok(dir),
            Ok(known) => {
                let known = plan::parse(&known, extensions).with_context(|| file.display().to_string())?;
                if let Some(difference) = plan::difference(&known, trials) {
                    return Err(AnotherStudy(path.display().to_string(), difference).into());
                }
            }
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(error) => return Err(error).with_context(|| format!("cannot read {}", file.display())),
        }
        files::write(&file, text)?;
        Ok(dir)
    }

    /// The directory of a study that may not have begun; nothing is written.
    pub fn at(path: &Path) -> Self {
        Self { path: path.to_owned() }
    }

    fn trials(&self) -> PathBuf {
        self.path.join("trials")
    }

    /// The run directory of a trial.
    pub fn run(&self, trial: &Trial) -> PathBuf {
        self.trials().join(&trial.name)
    }

    fn beside(&self, trial: &Trial, extension: &str) -> PathBuf {
        self.trials().join(format!("{}.{extension}", trial.name))
    }

    /// The file of what a trial says.
    pub fn log(&self, trial: &Trial) -> PathBuf {
        self.beside(trial, "log")
    }

    /// Writes the configuration of a trial, and says where.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write_config(&self, trial: &Trial) -> anyhow::Result<PathBuf> {
        let path = self.beside(trial, "toml");
        files::write(&path, &trial.config.to_toml()?)?;
        Ok(path)
    }

    /// How a trial stands. What cannot be read does not count.
    pub fn standing(&self, trial: &Trial) -> Standing {
        let run = self.run(trial);
        if self.summary(trial).is_some() {
            Standing::Done
        } else if self.failures(trial).len() >= ATTEMPTS {
            Standing::Failed
        } else if run.exists() {
            Standing::Begun
        } else {
            Standing::Fresh
        }
    }

    /// What a trial's run came to, if it has ended as it should.
    pub fn summary(&self, trial: &Trial) -> Option<Summary> {
        run_dir::finished(&self.run(trial), &trial.config)
    }

    /// How a trial has failed so far. A torn last line does not count.
    pub fn failures(&self, trial: &Trial) -> Vec<Failure> {
        let bytes = fs::read(self.beside(trial, "failures")).unwrap_or_default();
        String::from_utf8_lossy(&bytes).lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
    }

    /// Notes a failed attempt.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn note_failure(&self, trial: &Trial, failure: &Failure) -> anyhow::Result<()> {
        let path = self.beside(trial, "failures");
        let mut file = if path.exists() { AppendFile::open(&path)? } else { AppendFile::create(&path)? };
        // After a line that was torn by a crash.
        file.append(format!("\n{}\n", serde_json::to_string(failure)?).as_bytes())?;
        file.sync()
    }

    /// Forgets the failures of a trial, so that it is tried again.
    ///
    /// # Errors
    /// The file cannot be removed.
    pub fn forget_failures(&self, trial: &Trial) -> anyhow::Result<()> {
        let path = self.beside(trial, "failures");
        match fs::remove_file(&path) {
            Err(error) if error.kind() != ErrorKind::NotFound => {
                Err(error).with_context(|| format!("cannot remove {}", path.display()))
            }
            _ => Ok(()),
        }
    }

    /// Takes the right to run a trial; none if another process has it. A crash leaves a lock file, but no lock.
    ///
    /// # Errors
    /// The lock file cannot be used.
    pub fn claim(&self, trial: &Trial) -> anyhow::Result<Option<Claim>> {
        let path = self.beside(trial, "lock");
        let lock = File::create(&path).with_context(|| format!("cannot write {}", path.display()))?;
        match lock.try_lock() {
            Ok(()) => Ok(Some(Claim { _lock: lock })),
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(error)) => Err(error).with_context(|| format!("cannot lock {}", path.display())),
        }
    }

    /// Whether a learner works in the trial's run directory: one that has outlived the process that had started it saves
    /// what it has, and ends.
    pub fn is_occupied(&self, trial: &Trial) -> bool {
        run_dir::is_locked(&self.run(trial))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observer::{MetricsCsv, Observer as _, samples};

    const STUDY: &str = "[[product]]\nenvs = ['RepeatFirstEasy']\nmemories = ['mlp', 'gru']\nseeds = [0]\n";

    fn study() -> (tempfile::TempDir, StudyDir, Vec<Trial>) {
        let temporary = tempfile::tempdir().unwrap();
        let extensions = Extensions::default();
        let trials = plan::parse(STUDY, &extensions).unwrap();
        let dir = StudyDir::open(temporary.path(), STUDY, &trials, &extensions).unwrap();
        (temporary, dir, trials)
    }

    #[test]
    fn a_trial_stands_as_its_directory_says() {
        let (_temporary, dir, trials) = study();
        let trial = &trials[0];
        assert_eq!(dir.standing(trial), Standing::Fresh);
        fs::create_dir_all(dir.run(trial).join("checkpoints/epoch-000003")).unwrap();
        assert_eq!(dir.standing(trial), Standing::Begun);
        let mut summary = crate::observer::Summary {
            env: trial.config.env.clone(),
            memory: "mlp".to_owned(),
            preset: "quick".to_owned(),
            seed: 0,
            lag: 0,
            epochs: 3,
            env_steps: 999_999,
            episodes: 5,
            mmer: Some(0.5),
            final_mean_return: Some(0.5),
            wall_seconds: 1.0,
            stopped_by: "steps".to_owned(),
        };
        let mut report = samples::report(0);
        report.metrics.env_steps = 1_000_000;
        MetricsCsv::open(&dir.run(trial), 0).unwrap().epoch(&report).unwrap();
        let mut standing = |change: &dyn Fn(&mut Summary)| {
            change(&mut summary);
            fs::write(dir.run(trial).join("summary.json"), serde_json::to_string(&summary).unwrap()).unwrap();
            dir.standing(trial)
        };
        assert_eq!(standing(&|_| {}), Standing::Begun, "a step too few");
        assert_eq!(standing(&|summary| summary.env_steps += 1), Standing::Done);
        assert_eq!(standing(&|summary| summary.stopped_by = "interrupt".to_owned()), Standing::Begun);
        assert_eq!(
            standing(&|summary| (summary.stopped_by, summary.epochs) = ("steps".to_owned(), 4)),
            Standing::Begun
        );
        fs::remove_dir(dir.run(trial).join("checkpoints/epoch-000003")).unwrap();
        assert_eq!(standing(&|_| {}), Standing::Done, "what is done needs no checkpoints");
        assert_eq!(standing(&|summary| summary.env_steps += 1), Standing::Begun, "the metrics are of another end");
        fs::write(dir.run(trial).join("summary.json"), "{").unwrap();
        assert_eq!(dir.standing(trial), Standing::Begun);
        assert_eq!(dir.standing(&trials[1]), Standing::Fresh);
    }

    #[test]
    fn failures_are_counted_whatever_was_torn() {
        let (temporary, dir, trials) = study();
        let failure =
            |n: u32| Failure { status: format!("exit status: {n}"), error: "error: \"no\"\nspace".to_owned() };
        dir.note_failure(&trials[0], &failure(1)).unwrap();
        let path = temporary.path().join("trials").join(format!("{}.failures", trials[0].name));
        // In the middle of a character, too.
        let torn = [&fs::read(&path).unwrap(), &b"{\"status\": \"\xe2\x80"[..]].concat();
        fs::write(&path, torn).unwrap();
        dir.note_failure(&trials[0], &failure(2)).unwrap();
        assert_eq!(dir.failures(&trials[0]), [failure(1), failure(2)]);
        assert_eq!(dir.standing(&trials[0]), Standing::Fresh);
        dir.note_failure(&trials[0], &failure(3)).unwrap();
        assert_eq!(dir.standing(&trials[0]), Standing::Failed);
        dir.forget_failures(&trials[0]).unwrap();
        dir.forget_failures(&trials[0]).unwrap();
        assert_eq!(dir.standing(&trials[0]), Standing::Fresh);
    }

    #[test]
    fn a_trial_has_one_claim() {
        let (_temporary, dir, trials) = study();
        let claim = dir.claim(&trials[0]).unwrap().expect("nobody has it");
        assert!(dir.claim(&trials[0]).unwrap().is_none());
        let other = dir.claim(&trials[1]).unwrap();
        assert!(other.is_some());
        drop(claim);
        assert!(dir.claim(&trials[0]).unwrap().is_some(), "a lock file that was left behind is no claim");
    }

    #[test]
    fn another_study_is_refused() {
        let (temporary, _, _) = study();
        let extensions = Extensions::default();
        let open = |text: &str| {
            let trials = plan::parse(text, &extensions).unwrap();
            StudyDir::open(temporary.path(), text, &trials, &extensions).map_err(|error| format!("{error:#}"))
        };
        let error = open(&STUDY.replace("gru", "lstm")).unwrap_err();
        assert!(error.contains("another study") && error.contains("gru") && error.contains("lstm"), "{error}");
        open(&(STUDY.to_owned() + &STUDY.replace("gru", "lstm"))).unwrap();
        assert!(open(STUDY).unwrap_err().contains("3 trials there and 2 here"), "what was added stays");
    }
}
