//! A temporary directory with a tiny configuration, and the runs in it.

use std::fs;
use std::path::PathBuf;

use serde_json::Value;
use tempfile::TempDir;

use crate::Account;
use crate::process::{Process, Program};
use crate::terminal::Terminal;

/// A configuration whose epochs take some hundredths of a second: 8 of them.
const TINY: &str = "
steps = 4096
threads = 1
checkpoint_epochs = 2
device = \"cpu\"
[service]
actors = 1
slots = 16
[memory]
hidden_size = 16
[ppo]
batch_steps = 512
minibatch_steps = 256
passes = 1
";

/// Where the programs of a test run: a directory of their own, removed at the end.
#[derive(Debug)]
pub struct Scene {
    dir: TempDir,
}

impl Default for Scene {
    fn default() -> Self {
        Self::new()
    }
}

impl Scene {
    /// A new directory with `tiny.toml`.
    ///
    /// # Panics
    /// If it cannot be made.
    pub fn new() -> Self {
        let scene = Self { dir: tempfile::tempdir().expect("a temporary directory") };
        scene.write("tiny.toml", TINY);
        scene
    }

    /// The path of `name` in it.
    pub fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// Writes a file, in new directories if need be.
    ///
    /// # Panics
    /// If it cannot be written.
    pub fn write(&self, name: &str, text: &str) {
        let path = self.path(name);
        fs::create_dir_all(path.parent().expect("a file has a directory")).expect("a directory in the scene");
        fs::write(path, text).expect("a file in the scene");
    }

    /// Reads a file.
    ///
    /// # Panics
    /// If it cannot be read.
    #[track_caller]
    pub fn read(&self, name: &str) -> String {
        fs::read_to_string(self.path(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    /// Reads a JSON file.
    ///
    /// # Panics
    /// If it cannot be read, or is not JSON.
    #[track_caller]
    pub fn json(&self, name: &str) -> Value {
        serde_json::from_str(&self.read(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    /// Starts a program in this directory.
    pub fn start(&self, program: Program, args: &[&str]) -> Process {
        let mut command = program.command();
        command.args(args).current_dir(self.dir.path());
        Process::start(&format!("{} {}", program.name(), args.join(" ")), command)
    }

    /// Starts `learner` on a terminal of its own.
    pub fn on_terminal(&self, size: (u16, u16), args: &[&str]) -> Terminal {
        let mut command = Program::Learner.command();
        command.args(args).current_dir(self.dir.path());
        Terminal::start(&format!("learner {}", args.join(" ")), command, size)
    }

    /// Starts `learner`.
    pub fn learner(&self, args: &[&str]) -> Process {
        self.start(Program::Learner, args)
    }

    /// Starts `learner train` with the tiny configuration and these flags, into the directory `run`.
    pub fn train(&self, run: &str, flags: &[&str]) -> Process {
        self.learner(&[&["train", "--config", "tiny.toml", "--out", run], flags].concat())
    }

    /// Starts `learner resume` of the directory `run`.
    pub fn resume(&self, run: &str, flags: &[&str]) -> Process {
        self.learner(&[&["resume", run], flags].concat())
    }

    /// Starts an actor for the learner at `url`.
    pub fn actor(&self, url: &str, flags: &[&str]) -> Process {
        self.start(Program::Actor, &[&["--learner", url, "--slots", "16"], flags].concat())
    }

    /// Trains to the end and returns `metrics.csv`.
    ///
    /// # Panics
    /// If that does not succeed.
    #[track_caller]
    pub fn curve(&self, run: &str, flags: &[&str]) -> String {
        self.train(run, flags).expect(0);
        self.metrics(run)
    }

    /// `metrics.csv` of a run.
    ///
    /// # Panics
    /// If there is none.
    #[track_caller]
    pub fn metrics(&self, run: &str) -> String {
        self.read(&format!("{run}/metrics.csv"))
    }

    /// `metrics.csv` of a run whose account is in order.
    ///
    /// # Panics
    /// If it is not, or something is missing.
    #[track_caller]
    pub fn accounted(&self, run: &str) -> String {
        Account::check(self, run);
        self.metrics(run)
    }

    /// The largest difference in a run between the log-probabilities of its actors and those of its learner, of the same
    /// version of the weights.
    ///
    /// # Panics
    /// If the run has no such column.
    #[track_caller]
    pub fn log_prob_difference(&self, run: &str) -> f64 {
        let timing = self.read(&format!("{run}/timing.csv"));
        let mut lines = timing.lines().map(|line| line.split(',').collect::<Vec<_>>());
        let head = lines.next().expect("a head");
        let column = head.iter().position(|name| *name == "log_prob_difference").expect("the column");
        let differences = lines.map(|line| line[column].parse().expect("a number"));
        differences.fold(0.0, f64::max)
    }

    /// Rows of a run's `metrics.csv` so far.
    pub fn rows(&self, run: &str) -> usize {
        let text = fs::read_to_string(self.path(run).join("metrics.csv")).unwrap_or_default();
        text.matches('\n').count().saturating_sub(1)
    }

    /// The names of a run's checkpoints, oldest first.
    pub fn checkpoints(&self, run: &str) -> Vec<String> {
        let entries = fs::read_dir(self.path(run).join("checkpoints")).into_iter().flatten().flatten();
        let mut names: Vec<String> = entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    /// Waits until a run that goes on has as many rows.
    ///
    /// # Panics
    /// If it ends before that, or past the deadline.
    #[track_caller]
    pub fn reached(&self, learner: &mut Process, run: &str, rows: usize) {
        learner.until(&format!("{rows} epochs of {run}"), |_| (self.rows(run) >= rows).then_some(()));
    }
}
