//! Actor processes on this machine: started, watched, restarted, and gone when the learner is.

use std::io;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

use anyhow::Context as _;
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

/// Whether local actors fail again and again.
#[derive(Clone, Debug, Default)]
pub struct Hopeless(Arc<AtomicBool>);

impl Hopeless {
    /// Whether it has come to that.
    pub fn is_set(&self) -> bool {
        self.0.load(Ordering::Relaxed)
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
    /// Starts `n` processes of `program` with `args` (and `--with-parent`), and watches over them.
    ///
    /// # Errors
    /// If the program is missing or cannot be started.
    pub fn spawn(n: usize, program: PathBuf, args: Vec<String>) -> anyhow::Result<Self> {
        anyhow::ensure!(
            program.is_file(),
            "the actor's program is missing: {}; build it with `make build`",
            program.display()
        );
        let now = Instant::now();
        let mut actors = Vec::with_capacity(n);
        for _ in 0..n {
            match start(&program, &args) {
                Ok(child) => actors.push(Actor { child: Some(child), since: now, wait: FIRST_WAIT, failures: 0 }),
                Err(error) => {
                    stop_all(actors);
                    return Err(error).with_context(|| format!("cannot start {}", program.display()));
                }
            }
        }
        let hopeless = Hopeless::default();
        let (stop, stopped) = channel();
        let watcher = std::thread::Builder::new().name("local-actors".to_owned()).spawn({
            let hopeless = hopeless.clone();
            move || watch(actors, &program, &args, &stopped, &hopeless)
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

fn start(program: &Path, args: &[String]) -> io::Result<Child> {
    let mut command = Command::new(program);
    // The pipe is never written to: it ends when this process does, however that happens.
    command.args(args).arg("--with-parent").stdin(Stdio::piped()).stdout(Stdio::null());
    // Ctrl-C in a terminal goes to its whole process group. It is the learner that decides what it means.
    command.process_group(0);
    if std::env::var_os("RUST_LOG").is_none() {
        // They share the learner's terminal, and its log says who joined.
        command.env("RUST_LOG", "warn");
    }
    command.spawn()
}

fn watch(mut actors: Vec<Actor>, program: &Path, args: &[String], stopped: &Receiver<()>, hopeless: &Hopeless) {
    // The sender sends nothing; it is dropped.
    while matches!(stopped.recv_timeout(POLL_INTERVAL), Err(RecvTimeoutError::Timeout)) {
        for actor in &mut actors {
            actor.look_after(program, args);
            hopeless.0.fetch_or(actor.failures >= HOPELESS_FAILURES, Ordering::Relaxed);
        }
    }
    stop_all(actors);
}

impl Actor {
    fn look_after(&mut self, program: &Path, args: &[String]) {
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
                    let (wait, failures) =
                        if self.since.elapsed() > LONGEST_WAIT { (FIRST_WAIT, 0) } else { (self.wait, self.failures) };
                    // A signal is somebody's doing, not the actor's own failure.
                    self.failures = failures + u32::from(status.is_some_and(|status| status.code().is_some()));
                    warn!("a local actor has died ({}); another is started in {wait:?}", describe(status));
                    self.died(wait);
                }
            }
            None if self.since.elapsed() >= self.wait => match start(program, args) {
                Ok(child) => {
                    self.wait = (2 * self.wait).min(LONGEST_WAIT);
                    (self.child, self.since) = (Some(child), Instant::now());
                }
                Err(error) => {
                    warn!("cannot start {}: {error}", program.display());
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
    use super::*;

    /// A shell script as an actor: `body` gets `$1` = the file to write to.
    fn script(dir: &Path, body: &str) -> PathBuf {
        let path = dir.join("actor.sh");
        std::fs::write(&path, format!("#!/bin/sh\n{body}\n")).unwrap();
        std::fs::set_permissions(&path, std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
        path
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
        let program = script(dir.path(), "echo up >> $1; cat > /dev/null; echo down >> $1");
        let actors = LocalActors::spawn(3, program, vec![log.display().to_string()]).unwrap();
        wait_for("three actors", || lines(&log) == 3);
        actors.stop();
        assert_eq!(std::fs::read_to_string(&log).unwrap().matches("down").count(), 3);
    }

    #[test]
    fn a_dead_actor_is_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let log = dir.path().join("log");
        let program = script(dir.path(), "echo up >> $1; exit 1");
        let _actors = LocalActors::spawn(1, program, vec![log.display().to_string()]).unwrap();
        wait_for("a second life", || lines(&log) >= 2);
    }

    #[test]
    fn actors_that_fail_again_and_again_are_hopeless_and_killed_ones_are_not() {
        let dir = tempfile::tempdir().unwrap();
        let log = dir.path().join("log");
        let spawn =
            |body: &str| LocalActors::spawn(1, script(dir.path(), body), vec![log.display().to_string()]).unwrap();
        let killed = spawn("echo up >> $1; kill -9 $$");
        wait_for("a third life", || lines(&log) >= 3);
        assert!(!killed.hopeless().is_set());
        killed.stop();
        let failing = spawn("exit 1");
        wait_for("hopelessness", || failing.hopeless().is_set());
    }

    #[test]
    fn a_missing_program_says_how_to_build_it() {
        let error = LocalActors::spawn(1, PathBuf::from("no-such-program"), Vec::new()).unwrap_err().to_string();
        assert!(error.contains("make build"), "{error}");
    }
}
