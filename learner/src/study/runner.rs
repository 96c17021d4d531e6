//! Trials as child processes of this program, some at a time.

use std::collections::VecDeque;
use std::fs::{self, File};
use std::net::{SocketAddr, TcpListener};
use std::os::unix::process::CommandExt as _;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Duration;

use anyhow::Context as _;
use tracing::{info, warn};

use super::dir::{ATTEMPTS, Claim, Failure, Standing, StudyDir};
use super::plan::Trial;
use super::view::View;
use crate::interrupt::Interrupt;

/// How often children are looked at.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

/// What became of the trials.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Trials that are done, those of earlier sessions included.
    pub done: usize,
    /// Trials that have failed for good.
    pub failed: usize,
    /// Trials that another process is running.
    pub elsewhere: usize,
    /// Trials that are left, because the user has stopped the study.
    pub left: usize,
}

/// Runs trials of a study.
pub struct Runner<'a> {
    dir: &'a StudyDir,
    interrupt: &'a Interrupt,
    /// Where the first of the trials that run serves its metrics.
    metrics: Option<SocketAddr>,
    view: View<'a>,
    queue: VecDeque<&'a Trial>,
    running: Vec<Running<'a>>,
    tally: Tally,
}

/// A trial that this process has claimed.
struct Running<'a> {
    trial: &'a Trial,
    /// Its place among those that run, from 0.
    place: usize,
    /// None: the learner of an earlier session has still to end.
    child: Option<Child>,
    /// Length of the trial's log when the child was started.
    said_before: u64,
    _claim: Claim,
}

impl<'a> Runner<'a> {
    /// A runner of `trials`. Those that run at a time serve their metrics at the address `metrics` and the ports after it.
    pub fn new(
        dir: &'a StudyDir,
        trials: impl IntoIterator<Item = &'a Trial>,
        interrupt: &'a Interrupt,
        metrics: Option<SocketAddr>,
    ) -> Self {
        let (mut queue, mut tally) = (VecDeque::new(), Tally::default());
        for trial in trials {
            match dir.standing(trial) {
                Standing::Done => tally.done += 1,
                Standing::Failed => tally.failed += 1,
                Standing::Begun | Standing::Fresh => queue.push_back(trial),
            }
        }
        let view = View::new(dir, queue.iter().copied());
        Self { dir, interrupt, metrics, view, queue, running: Vec::new(), tally }
    }

    /// Runs the trials that are not done, `jobs` at a time, until none is left or the user stops; then waits until those
    /// that run have saved what they have.
    ///
    /// # Errors
    /// The study's directory cannot be written, or the program not be started again.
    pub fn run(mut self, jobs: usize) -> anyhow::Result<Tally> {
        let Tally { done, failed, .. } = self.tally;
        info!("{} trials to run, {done} done, {failed} failed", self.queue.len());
        while !(self.running.is_empty() && self.queue.is_empty()) {
            if self.interrupt.requested() {
                self.stop();
                break;
            }
            while self.running.len() < jobs && self.begin_next()? {}
            self.look_after()?;
            let running: Vec<&Trial> = self.running.iter().map(|running| running.trial).collect();
            self.view.show(&running, self.queue.len(), self.tally);
            std::thread::sleep(POLL_INTERVAL);
        }
        self.view.end();
        Ok(self.tally)
    }

    /// Begins with the next trial that nobody else has. False: there is none.
    fn begin_next(&mut self) -> anyhow::Result<bool> {
        let Some(trial) = self.queue.pop_front() else { return Ok(false) };
        let Some(claim) = self.dir.claim(trial)? else {
            info!("{}: another process is running it", trial.name);
            self.tally.elsewhere += 1;
            self.view.elsewhere(trial);
            return Ok(true);
        };
        // Another process may have been faster.
        match self.dir.standing(trial) {
            Standing::Done => self.tally.done += 1,
            Standing::Failed => self.tally.failed += 1,
            Standing::Begun | Standing::Fresh => {
                let taken = |place: &usize| self.running.iter().any(|running| running.place == *place);
                let place = (0..=self.running.len()).find(|place| !taken(place)).unwrap_or_default();
                self.running.push(Running { trial, place, child: None, said_before: 0, _claim: claim });
                return Ok(true);
            }
        }
        self.view.elsewhere(trial);
        Ok(true)
    }

    fn look_after(&mut self) -> anyhow::Result<()> {
        for mut running in std::mem::take(&mut self.running) {
            let Some(child) = &mut running.child else {
                if !self.dir.is_occupied(running.trial) {
                    running.said_before = fs::metadata(self.dir.log(running.trial)).map_or(0, |log| log.len());
                    running.child = Some(start(self.dir, running.trial, self.metrics_address(&running))?);
                }
                self.running.push(running);
                continue;
            };
            match child.try_wait().with_context(|| format!("{}: cannot wait for it", running.trial.name))? {
                None => self.running.push(running),
                Some(status) => self.ended(&running, status)?,
            }
        }
        Ok(())
    }

    /// Where a trial serves its metrics. Nowhere, if somebody else is there: that is no reason for it to fail.
    fn metrics_address(&self, running: &Running<'_>) -> Option<SocketAddr> {
        let first = self.metrics?;
        let address = SocketAddr::new(first.ip(), first.port() + running.place as u16);
        let free = TcpListener::bind(address);
        if let Err(error) = &free {
            warn!("{}: no metrics at {address}: {error}", running.trial.name);
        }
        free.is_ok().then_some(address)
    }

    fn ended(&mut self, running: &Running<'a>, status: ExitStatus) -> anyhow::Result<()> {
        let trial = running.trial;
        if status.success() && self.dir.standing(trial) == Standing::Done {
            self.tally.done += 1;
            self.view.ended(trial);
            if let Some(summary) = self.dir.summary(trial) {
                let mmer = summary.mmer.unwrap_or(f64::NAN);
                info!("{} done: MMER {mmer:.3} after {} steps", trial.name, summary.env_steps);
            }
            return Ok(());
        }
        let failure =
            Failure { status: status.to_string(), error: last_words(&self.dir.log(trial), running.said_before) };
        self.dir.note_failure(trial, &failure)?;
        let failures = self.dir.failures(trial).len();
        warn!("{} failed ({}), attempt {failures} of {ATTEMPTS}: {}", trial.name, failure.status, failure.error);
        if failures < ATTEMPTS {
            self.queue.push_back(trial);
        } else {
            self.tally.failed += 1;
            self.view.ended(trial);
        }
        Ok(())
    }

    /// Lets the children save what they have and end.
    fn stop(&mut self) {
        for child in self.running.iter_mut().filter_map(|running| running.child.as_mut()) {
            drop(child.stdin.take());
        }
        for Running { trial, child, .. } in &mut self.running {
            if let Some(child) = child {
                // An error means that there is no such process to wait for.
                let _ = child.wait();
            }
            // It may have been waiting for no more than a last look at its metrics.
            let done = self.dir.standing(trial) == Standing::Done;
            *if done { &mut self.tally.done } else { &mut self.tally.left } += 1;
        }
        self.running.clear();
        self.tally.left += self.queue.len();
    }
}

/// Starts `train --continue` of a trial. It ends by itself, saving what it has, when this process does.
fn start(dir: &StudyDir, trial: &Trial, metrics: Option<SocketAddr>) -> anyhow::Result<Child> {
    let config = dir.write_config(trial)?;
    let path = dir.log(trial);
    let log = File::options().create(true).append(true).open(&path);
    let log = log.with_context(|| format!("cannot write {}", path.display()))?;
    let program = std::env::current_exe().context("this program's own file is unknown")?;
    let mut command = Command::new(&program);
    command.args(["train", "--with-parent", "--continue", "--config"]).arg(config).arg("--out").arg(dir.run(trial));
    if let Some(address) = metrics {
        command.arg("--metrics-listen").arg(address.to_string());
    }
    command.stdin(Stdio::piped()).stdout(log.try_clone()?).stderr(log);
    // Ctrl-C in a terminal goes to its whole process group. It is this process that decides what it means.
    command.process_group(0);
    command.spawn().with_context(|| format!("cannot start {}", program.display()))
}

/// The last error in a log from byte `start` on, or its last line.
fn last_words(log: &Path, start: u64) -> String {
    let log = fs::read(log).unwrap_or_default();
    let log = String::from_utf8_lossy(log.get(start as usize..).unwrap_or_default());
    let mut lines = log.lines().rev().filter(|line| !line.trim().is_empty());
    let last = lines.clone().next().unwrap_or("nothing was said");
    lines.find(|line| line.starts_with("error:")).unwrap_or(last).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_words_are_those_of_this_attempt() {
        let dir = tempfile::tempdir().unwrap();
        let log = dir.path().join("log");
        assert_eq!(last_words(&log, 0), "nothing was said");
        fs::write(&log, "error: no actors\nINFO \u{2014}\n\n").unwrap();
        assert_eq!(last_words(&log, 0), "error: no actors");
        assert_eq!(last_words(&log, 17), "INFO \u{2014}");
        // Begun in the middle of a character, or behind the end.
        assert_eq!(last_words(&log, 23), "\u{fffd}\u{fffd}");
        assert_eq!(last_words(&log, 1000), "nothing was said");
    }
}
