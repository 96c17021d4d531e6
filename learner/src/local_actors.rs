//! Actor processes on this machine: started, watched, restarted, and gone when the learner is.

use std::ffi::OsString;
use std::io;
use std::os::unix::process::{CommandExt as _, ExitStatusExt as _};
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use signal_hook::consts::{SIGHUP, SIGINT, SIGKILL, SIGTERM};
use tracing::warn;

/// How often the processes are looked at.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

/// An actor that has died is started again after this long; twice as long each time, up to the longest, until one has
/// lived longer than that.
const FIRST_WAIT: Duration = Duration::from_millis(500);
const LONGEST_WAIT: Duration = Duration::from_secs(10);

/// Actors end by themselves when their standard input ends; those that have not after this long are killed.
const STOP_DEADLINE: Duration = Duration::from_secs(5);

/// Set when a local actor has failed this often in a row, each time soon after its start: it will never work.
const HOPELESS_FAILURES: u32 = 4;

/// Signals by which somebody else ends an actor; by any other it has failed.
const OTHERS: [i32; 4] = [SIGHUP, SIGINT, SIGKILL, SIGTERM];

/// Whether local actors fail again and again.
#[derive(Clone, Debug, Default)]
pub struct Hopeless(Arc<AtomicBool>);

impl Hopeless {
    /// Whether it has come to that.
    pub fn is_set(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// In the place of a program's name: the program that is running.
pub const THIS_PROGRAM: &str = "@self";

/// How an actor is started.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ActorCommand {
    program: PathBuf,
    args: Vec<OsString>,
}

impl ActorCommand {
    /// What `words` say: a program (a path, a name to be found on PATH, or [`THIS_PROGRAM`]) and its first arguments. No
    /// words: the `actor` beside the running program.
    ///
    /// # Errors
    /// There is no such program.
    pub fn find(words: &[String]) -> anyhow::Result<Self> {
        let this = std::env::current_exe().context("cannot tell where this program is")?;
        let Some((program, args)) = words.split_first() else {
            let program = this.with_file_name("actor");
            anyhow::ensure!(
                program.is_file(),
                "{} is not there; `make build` builds it, `--actor-command` names another, `--actors 0` waits for actors elsewhere",
                program.display()
            );
            return Ok(Self { program, args: Vec::new() });
        };
        let program = match program.as_str() {
            THIS_PROGRAM => this,
            name => which::which(name).with_context(|| format!("service.actor_command is {words:?}: `{name}`"))?,
        };
        Ok(Self { program, args: args.iter().map(OsString::from).collect() })
    }

    /// The same with further arguments.
    #[must_use]
    pub fn with(mut self, args: impl IntoIterator<Item = impl Into<OsString>>) -> Self {
        self.args.extend(args.into_iter().map(Into::into));
        self
    }

    fn start(&self) -> io::Result<Child> {
        let mut command = Command::new(&self.program);
        // The pipe is never written to: it ends when this process does, however that happens.
        command.args(&self.args).arg("--with-parent").stdin(Stdio::piped()).stdout(Stdio::null());
        // Ctrl-C in a terminal goes to its whole process group. It is the learner that decides what it means.
        command.process_group(0);
        // What is meant for actors of another learner.
        for (name, _) in std::env::vars_os().filter(|(name, _)| name.as_encoded_bytes().starts_with(b"POPGYM_")) {
            command.env_remove(name);
        }
        if std::env::var_os("RUST_LOG").is_none() {
            // They share the learner's terminal, and its log says who joined.
            command.env("RUST_LOG", "warn");
        }
        command.spawn()
    }
}

/// A number of actor processes. Dropping it stops them all.
#[derive(Debug)]
pub struct LocalActors {
    /// Dropped to stop.
    stop: Option<Sender<()>>,
    watcher: Option<std::thread::JoinHandle<()>>,
    hopeless: Hopeless,
}

impl LocalActors {
    /// Starts `n` processes by `command` (and `--with-parent`), and watches over them.
    ///
    /// # Errors
    /// If the program cannot be started.
    pub fn spawn(n: usize, command: ActorCommand) -> anyhow::Result<Self> {
        let now = Instant::now();
        let mut actors = Vec::with_capacity(n);
        for _ in 0..n {
            match command.start() {
                Ok(child) => actors.push(Actor { child: Some(child), since: now, wait: FIRST_WAIT, failures: 0 }),
                Err(error) => {
                    stop_all(actors);
                    return Err(error).with_context(|| format!("cannot start {}", command.program.display()));
                }
            }
        }
        let hopeless = Hopeless::default();
        let (stop, stopped) = channel();
        let watcher = std::thread::Builder::new().name("local-actors".to_owned()).spawn({
            let hopeless = hopeless.clone();
            move || watch(actors, &command, &stopped, &hopeless)
        })?;
        Ok(Self { stop: Some(stop), watcher: Some(watcher), hopeless })
    }

    /// Tells when they fail again and again.
    pub fn hopeless(&self) -> Hopeless {
        self.hopeless.clone()
    }

    /// Stops all and waits until they are gone, a few seconds at most.
    pub fn stop(self) {
        drop(self);
    }
}

impl Drop for LocalActors {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(watcher) = self.watcher.take() {
            // A panic there has been reported by the panic hook.
            let _ = watcher.join();
        }
    }
}

struct Actor {
    /// `None`: it has died, and waits to be started again.
    child: Option<Child>,
    /// When it was started, or died.
    since: Instant,
    /// How long to wait after its death.
    wait: Duration,
    /// How often it failed in a row, soon after its start.
    failures: u32,
}

fn watch(mut actors: Vec<Actor>, command: &ActorCommand, stopped: &Receiver<()>, hopeless: &Hopeless) {
    // The sender sends nothing; it is dropped.
    while matches!(stopped.recv_timeout(POLL_INTERVAL), Err(RecvTimeoutError::Timeout)) {
        for actor in &mut actors {
            actor.look_after(command);
            hopeless.0.fetch_or(actor.failures >= HOPELESS_FAILURES, Ordering::Relaxed);
        }
    }
    stop_all(actors);
}

impl Actor {
    fn look_after(&mut self, command: &ActorCommand) {
        match &mut self.child {
            Some(child) => {
                // An error means that there is no such process to wait for.
                let status = match child.try_wait() {
                    Ok(None) => return,
                    Ok(Some(status)) => Some(status),
                    Err(_) => None,
                };
                if status.is_some_and(|status| status.success()) {
                    // Told by the learner that the run is complete: the end is near.
                    self.died(LONGEST_WAIT);
                } else {
                    let killed =
                        status.and_then(|status| status.signal()).is_some_and(|signal| OTHERS.contains(&signal));
                    let (wait, failures) = match self.since.elapsed() > LONGEST_WAIT {
                        true => (FIRST_WAIT, 0),
                        false if killed => (FIRST_WAIT, self.failures),
                        false => (self.wait, self.failures),
                    };
                    self.failures = failures + u32::from(!killed);
                    warn!("a local actor has died ({}); another is started in {wait:?}", describe(status));
                    self.died(wait);
                }
            }
            None if self.since.elapsed() >= self.wait => match command.start() {
                Ok(child) => {
                    self.wait = (2 * self.wait).min(LONGEST_WAIT);
                    (self.child, self.since) = (Some(child), Instant::now());
                }
                Err(error) => {
                    warn!("cannot start {}: {error}", command.program.display());
                    self.died(LONGEST_WAIT);
                }
            },
            None => {}
        }
    }

    fn died(&mut self, wait: Duration) {
        (self.child, self.since, self.wait) = (None, Instant::now(), wait);
    }
}

fn describe(status: Option<ExitStatus>) -> String {
    status.map_or_else(|| "status unknown".to_owned(), |status| status.to_string())
}

/// Ends all, and reaps all.
fn stop_all(actors: Vec<Actor>) {
    let mut children: Vec<Child> = actors.into_iter().filter_map(|actor| actor.child).collect();
    for child in &mut children {
        drop(child.stdin.take());
    }
    let deadline = Instant::now() + STOP_DEADLINE;
    for mut child in children {
        while matches!(child.try_wait(), Ok(None)) {
            if Instant::now() >= deadline {
                // Fails only for a process that has ended, which is what is wanted.
                let _ = child.kill();
                let _ = child.wait();
                break;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    /// A shell script as an actor: `body` gets `$1` = the file `log`.
    fn script(dir: &Path, body: &str) -> ActorCommand {
        let path = dir.join("actor.sh");
        std::fs::write(&path, format!("#!/bin/sh\n{body}\n")).unwrap();
        std::fs::set_permissions(&path, std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
        let words = [path.display().to_string(), dir.join("log").display().to_string()];
        ActorCommand::find(&words).unwrap()
    }

    fn wait_for(what: &str, mut done: impl FnMut() -> bool) {
        let deadline = Instant::now() + Duration::from_secs(20);
        while !done() {
            assert!(Instant::now() < deadline, "{what}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    fn lines(path: &Path) -> usize {
        std::fs::read_to_string(path).map_or(0, |text| text.lines().count())
    }

    #[test]
    fn actors_end_with_their_standard_input() {
        let dir = tempfile::tempdir().unwrap();
        let log = dir.path().join("log");
        let command = script(dir.path(), "echo up >> $1; cat > /dev/null; echo down >> $1");
        let actors = LocalActors::spawn(3, command).unwrap();
        wait_for("three actors", || lines(&log) == 3);
        actors.stop();
        assert_eq!(std::fs::read_to_string(&log).unwrap().matches("down").count(), 3);
    }

    #[test]
    fn a_dead_actor_is_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let log = dir.path().join("log");
        let _actors = LocalActors::spawn(1, script(dir.path(), "echo up >> $1; exit 1")).unwrap();
        wait_for("a second life", || lines(&log) >= 2);
    }

    #[test]
    fn actors_that_fail_again_and_again_are_hopeless_and_killed_ones_are_not() {
        let dir = tempfile::tempdir().unwrap();
        let log = dir.path().join("log");
        let spawn = |body: &str| LocalActors::spawn(1, script(dir.path(), body)).unwrap();
        let killed = spawn("echo up >> $1; kill -9 $$");
        wait_for("a third life", || lines(&log) >= 3);
        assert!(!killed.hopeless().is_set());
        killed.stop();
        let failing = spawn("exit 1");
        wait_for("hopelessness", || failing.hopeless().is_set());
    }

    #[test]
    fn a_command_is_found_or_named() {
        let find = |words: &[&str]| ActorCommand::find(&words.iter().map(ToString::to_string).collect::<Vec<_>>());
        let this = std::env::current_exe().unwrap();
        assert_eq!(find(&["@self", "actor"]).unwrap(), ActorCommand { program: this, args: vec!["actor".into()] });
        assert!(find(&["sh"]).unwrap().program.ends_with("sh"));
        assert!(find(&[]).unwrap_err().to_string().contains("make build"), "tests have no actor beside them");
        for missing in ["no-such-program", "./no-such-program", "/"] {
            assert!(format!("{:#}", find(&[missing]).unwrap_err()).contains(&format!("`{missing}`")));
        }
    }
}
