//! One `learner` or `actor` process.

use std::ffi::OsString;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};

use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

use crate::until;

/// Variables of whoever runs the tests that would change what the programs do.
const FOREIGN: [&str; 4] = ["GOMP_SPINCOUNT", "MKL_DYNAMIC", "OMP_WAIT_POLICY", "RUST_LOG"];

/// One of the workspace's binaries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Program {
    /// `learner`.
    Learner,
    /// `actor`.
    Actor,
}

impl Program {
    /// Its file name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Learner => "learner",
            Self::Actor => "actor",
        }
    }

    /// The binary of the profile that the tests were built in: beside the directory of the test's own executable.
    ///
    /// # Panics
    /// If it is not there.
    pub fn path(self) -> PathBuf {
        let test = std::env::current_exe().expect("a test has an executable");
        let path = test.ancestors().nth(2).unwrap_or(&test).join(self.name());
        assert!(path.is_file(), "{} is not there: `cargo build` first (in the tests' profile)", path.display());
        path
    }

    /// A command that starts it, with nothing to read.
    pub fn command(self) -> Command {
        let mut command = Command::new(self.path());
        let ours = std::env::vars_os().map(|(name, _)| name);
        let ours = ours.filter(|name| name.as_encoded_bytes().starts_with(b"POPGYM_"));
        for name in ours.chain(FOREIGN.map(OsString::from)) {
            command.env_remove(name);
        }
        command.stdin(Stdio::null());
        command
    }
}

/// How a process ended, and all that it wrote.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// Its status.
    pub status: ExitStatus,
    /// Its standard output.
    pub stdout: String,
    /// Its standard error.
    pub stderr: String,
}

/// A process that was started, and dies with this value.
#[derive(Debug)]
pub struct Process {
    name: String,
    child: Child,
    /// Its standard output and standard error, as files.
    logs: TempDir,
    /// Local actors seen so far: they are ended too.
    children: Vec<Life>,
}

impl Process {
    /// Starts `command`; `name` is for messages.
    ///
    /// # Panics
    /// If it cannot be started.
    pub fn start(name: &str, mut command: Command) -> Self {
        let logs = tempfile::tempdir().expect("a directory for logs");
        let file = |name: &str| File::create(logs.path().join(name)).expect("a log file");
        let child = command.stdout(file("stdout")).stderr(file("stderr")).spawn();
        let child = child.unwrap_or_else(|error| panic!("cannot start {name}: {error}"));
        Self { name: name.to_owned(), child, logs, children: Vec::new() }
    }

    /// Its process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// What it has written to standard output so far.
    pub fn stdout(&self) -> String {
        self.read("stdout")
    }

    /// What it has written to standard error so far.
    pub fn stderr(&self) -> String {
        self.read("stderr")
    }

    fn read(&self, name: &str) -> String {
        String::from_utf8_lossy(&fs::read(self.logs.path().join(name)).unwrap_or_default()).into_owned()
    }

    /// Whether it has not ended.
    pub fn is_running(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// Waits until `poll` has a value, while the process runs.
    ///
    /// # Panics
    /// If the process ends before that, or past the deadline.
    #[track_caller]
    pub fn until<T>(&mut self, what: &str, mut poll: impl FnMut(&mut Self) -> Option<T>) -> T {
        until(what, || {
            // Asked first: what a process does last still counts.
            let running = self.is_running();
            let value = poll(self);
            assert!(running || value.is_some(), "{} has ended before {what}", self.name);
            value
        })
    }

    /// Waits for a line of its standard error that contains `text`.
    ///
    /// # Panics
    /// If the process ends before that, or past the deadline.
    #[track_caller]
    pub fn logged(&mut self, text: &str) -> String {
        self.until(&format!("a line with `{text}`"), |process| {
            let log = process.stderr();
            // A line that is being written has no end yet.
            let mut lines = log.split_inclusive('\n').filter(|line| line.ends_with('\n'));
            lines.find(|line| line.contains(text)).map(|line| line.trim_end().to_owned())
        })
    }

    /// The URL in a learner's invitation to actors.
    ///
    /// # Panics
    /// If there is none within the deadline.
    #[track_caller]
    pub fn url(&mut self) -> String {
        let line = self.logged("waiting for actors: actor --learner http");
        line.split_whitespace().last().expect("the address").to_owned()
    }

    /// Waits for its end.
    ///
    /// # Panics
    /// Past the deadline, or if it has panicked.
    #[track_caller]
    pub fn wait(&mut self) -> Outcome {
        let what = format!("the end of {}", self.name);
        let status = until(&what, || self.child.try_wait().expect("a child can be waited for"));
        let (stdout, stderr) = (self.stdout(), self.stderr());
        assert!(!stderr.contains("panicked at"), "{} has panicked, {status}", self.name);
        Outcome { status, stdout, stderr }
    }

    /// Waits for its end with this exit code.
    ///
    /// # Panics
    /// If it ends otherwise, or past the deadline.
    #[track_caller]
    pub fn expect(mut self, code: i32) -> Outcome {
        let outcome = self.wait();
        assert_eq!(outcome.status.code(), Some(code), "{}: {}, expected {code}", self.name, outcome.status);
        outcome
    }

    /// Sends a signal.
    ///
    /// # Panics
    /// If the process has ended.
    #[track_caller]
    pub fn signal(&mut self, signal: Signal) {
        assert!(self.is_running(), "{} has ended before {signal:?}", self.name);
        kill_process(Pid::from_child(&self.child), signal).expect("a running child can be signalled");
    }

    /// Kills it (SIGKILL), in the middle of whatever it does.
    ///
    /// # Panics
    /// If it has ended before.
    #[track_caller]
    pub fn kill(&mut self) {
        self.signal(Signal::KILL);
        let status = self.wait().status;
        assert_eq!(status.signal(), Some(Signal::KILL.as_raw()), "{} has ended before the signal: {status}", self.name);
    }

    /// The local actors of a learner that are running now.
    pub fn actors(&mut self) -> Vec<Life> {
        let now = Life::children_of(self.id(), Program::Actor.name());
        self.children.extend(&now);
        now
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.actors();
        // Fails only for a process that has ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
        self.children.iter().filter(|child| child.is_running()).for_each(|child| child.signal(Signal::KILL));
        if std::thread::panicking() {
            eprintln!("--- {} wrote to standard output:\n{}", self.name, self.stdout());
            eprintln!("--- and to standard error:\n{}---", self.stderr());
        }
    }
}

/// A process that is not the test's own child: its number, and when it began, so that a later process of the same
/// number is another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Life {
    id: i32,
    began: u64,
}

/// What `/proc/ID/stat` says.
struct Stat {
    name: String,
    state: char,
    parent: u32,
    began: u64,
}

impl Stat {
    fn of(proc: &Path) -> Option<Self> {
        let text = fs::read_to_string(proc.join("stat")).ok()?;
        let (name, rest) = (text.split_once('(')?.1).rsplit_once(')')?;
        let fields: Vec<&str> = rest.split_whitespace().collect();
        Some(Self {
            name: name.to_owned(),
            state: fields.first()?.chars().next()?,
            parent: fields.get(1)?.parse().ok()?,
            began: fields.get(19)?.parse().ok()?,
        })
    }
}

impl Life {
    fn children_of(parent: u32, name: &str) -> Vec<Self> {
        let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
        let life = |proc: &Path| {
            let id = proc.file_name()?.to_str()?.parse().ok()?;
            let stat = Stat::of(proc)?;
            (stat.parent == parent && stat.name == name && stat.state != 'Z').then_some(Self { id, began: stat.began })
        };
        entries.filter_map(|entry| life(&entry.path())).collect()
    }

    /// Whether it has not ended.
    pub fn is_running(&self) -> bool {
        Stat::of(&PathBuf::from(format!("/proc/{}", self.id)))
            .is_some_and(|stat| stat.began == self.began && stat.state != 'Z')
    }

    /// Sends it a signal, if it has not ended.
    pub fn signal(&self, signal: Signal) {
        if let Some(pid) = Pid::from_raw(self.id).filter(|_| self.is_running()) {
            // Fails only for a process that has just ended.
            let _ = kill_process(pid, signal);
        }
    }

    /// Waits for the end of all these.
    ///
    /// # Panics
    /// Past the deadline.
    #[track_caller]
    pub fn expect_gone(lives: &[Self]) {
        let mut what = "the end of".to_owned();
        for life in lives {
            write!(what, " {}", life.id).expect("memory");
        }
        until(&what, || lives.iter().all(|life| !life.is_running()).then_some(()));
    }
}
