//! What a study shows while it runs: a line for each trial that runs, and one for all.

use std::collections::BTreeMap;
use std::io::{Write as _, stderr};
use std::time::{Duration, Instant};

use indicatif::{HumanCount, ProgressBar, ProgressStyle};

use super::dir::StudyDir;
use super::plan::Trial;
use super::runner::Tally;
use crate::observer::{EpochMetrics, MetricsCsv, Progress, clock};

/// How often the trials' own files are read.
const READ_INTERVAL: Duration = Duration::from_secs(1);

/// Lines, where there is no terminal, are at least so far apart.
const LINES_INTERVAL: Duration = Duration::from_secs(30);

/// Progress on stderr: bars on a terminal, else lines.
pub(super) struct View<'a> {
    dir: &'a StudyDir,
    bars: Option<Bars>,
    pace: Pace,
    read: Option<Instant>,
    printed: Option<Instant>,
}

/// One bar for all trials, and one for each that runs.
struct Bars {
    all: ProgressBar,
    trials: BTreeMap<usize, ProgressBar>,
}

impl<'a> View<'a> {
    /// A view of these trials that are about to run, in the form that suits what stderr is.
    pub(super) fn new<'t>(dir: &'a StudyDir, trials: impl Iterator<Item = &'t Trial>) -> Self {
        let trials = trials.map(|trial| (trial.number, trial.config.steps, steps(last_epoch(dir, trial).as_ref())));
        let pace = Pace::new(trials);
        let bars = Progress::bars();
        let bars = (!bars.is_hidden()).then(|| Bars { all: new_bar(pace.total), trials: BTreeMap::new() });
        Self { dir, bars, pace, read: None, printed: None }
    }

    /// A trial has ended.
    pub(super) fn ended(&mut self, trial: &Trial) {
        self.pace.ended(trial.number);
    }

    /// A trial is another process's work.
    pub(super) fn elsewhere(&mut self, trial: &Trial) {
        self.pace.elsewhere(trial.number);
        if let Some(bars) = &self.bars {
            bars.all.set_length(self.pace.total);
        }
    }

    /// Shows the trials that run, now and then.
    pub(super) fn show(&mut self, running: &[&Trial], waiting: usize, tally: Tally) {
        if self.read.is_some_and(|read| read.elapsed() < READ_INTERVAL) {
            return;
        }
        self.read = Some(Instant::now());
        let epochs: Vec<Option<EpochMetrics>> = running.iter().map(|trial| last_epoch(self.dir, trial)).collect();
        let now = running.iter().zip(&epochs).map(|(trial, epoch)| (trial.number, steps(epoch.as_ref())));
        let progress = self.pace.progress(now);
        let eta = self.pace.eta(progress).map_or_else(|| "?".to_owned(), clock);
        let Tally { done, failed, .. } = tally;
        let all =
            format!("study: {done} done, {} running, {waiting} waiting, {failed} failed, eta {eta}", running.len());
        let trials = running.iter().zip(&epochs).map(|(trial, epoch)| (*trial, epoch.as_ref()));
        if let Some(bars) = &mut self.bars {
            bars.show(trials, progress, all);
        } else if self.printed.is_none_or(|printed| printed.elapsed() >= LINES_INTERVAL) {
            self.printed = Some(Instant::now());
            let lines = trials.map(|(trial, epoch)| {
                let (steps, budget) = (HumanCount(steps(epoch)), HumanCount(trial.config.steps));
                format!("{}  {steps} / {budget} steps  {}\n", trial.name, describe(epoch))
            });
            // Nothing better to do if nobody reads it.
            let _ = writeln!(stderr(), "{}{all}", lines.collect::<String>());
        }
    }

    /// Takes the bars away.
    pub(super) fn end(&mut self) {
        if let Some(bars) = self.bars.take() {
            bars.trials.values().chain([&bars.all]).for_each(ProgressBar::finish_and_clear);
        }
    }
}

impl Bars {
    fn show<'t>(
        &mut self,
        trials: impl Iterator<Item = (&'t Trial, Option<&'t EpochMetrics>)>,
        progress: u64,
        all: String,
    ) {
        let mut before = std::mem::take(&mut self.trials);
        for (trial, epoch) in trials {
            let bar = before.remove(&trial.number).unwrap_or_else(|| new_bar(trial.config.steps));
            bar.set_position(steps(epoch).min(trial.config.steps));
            bar.set_message(format!("{}  {}", trial.name, describe(epoch)));
            self.trials.insert(trial.number, bar);
        }
        before.values().for_each(ProgressBar::finish_and_clear);
        self.all.set_position(progress);
        self.all.set_message(all);
    }
}

fn new_bar(steps: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{elapsed} [{bar:24.cyan/blue}] {percent:>3}%  {wide_msg}");
    let style = style.unwrap_or_else(|_| ProgressStyle::default_bar());
    Progress::bars().add(ProgressBar::new(steps).with_style(style.progress_chars("=> ")))
}

fn last_epoch(dir: &StudyDir, trial: &Trial) -> Option<EpochMetrics> {
    MetricsCsv::read(&dir.run(trial)).ok().and_then(|mut epochs| epochs.pop())
}

fn steps(epoch: Option<&EpochMetrics>) -> u64 {
    epoch.map_or(0, |epoch| epoch.env_steps)
}

fn describe(epoch: Option<&EpochMetrics>) -> String {
    epoch.map_or_else(String::new, |epoch| format!("return {:.3}  mmer {:.3}", epoch.mean_return, epoch.mmer))
}

/// How much is done and left, and when that will be done.
///
/// A trial that has ended, however early, counts as its whole budget; so a study in which many stop early is not thought
/// to be longer than it is.
struct Pace {
    began: Instant,
    /// Steps that were to do when the session began.
    total: u64,
    /// Of each trial: its budget, and the steps it had when the session began.
    trials: BTreeMap<usize, (u64, u64)>,
    /// Of `total`, what was for trials that have ended.
    ended: u64,
}

impl Pace {
    /// Of trials' numbers, budgets, and steps done.
    fn new(trials: impl Iterator<Item = (usize, u64, u64)>) -> Self {
        let trials: BTreeMap<usize, (u64, u64)> =
            trials.map(|(number, budget, done)| (number, (budget, done))).collect();
        let total = trials.values().map(|(budget, done)| budget.saturating_sub(*done)).sum();
        Self { began: Instant::now(), total, trials, ended: 0 }
    }

    fn ended(&mut self, number: usize) {
        if let Some((budget, done)) = self.trials.remove(&number) {
            self.ended += budget.saturating_sub(done);
        }
    }

    fn elsewhere(&mut self, number: usize) {
        if let Some((budget, done)) = self.trials.remove(&number) {
            self.total -= budget.saturating_sub(done);
        }
    }

    /// Of `total`, what is done, given the steps of the trials that run.
    fn progress(&self, running: impl Iterator<Item = (usize, u64)>) -> u64 {
        let of_trial = |(number, steps): (usize, u64)| {
            let (budget, done) = self.trials.get(&number)?;
            Some(steps.min(*budget).saturating_sub(*done))
        };
        self.ended + running.filter_map(of_trial).sum::<u64>()
    }

    /// Seconds until all is done, at the pace of the session so far.
    fn eta(&self, progress: u64) -> Option<f64> {
        (progress > 0).then(|| self.began.elapsed().as_secs_f64() * (self.total - progress) as f64 / progress as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_trial_that_ends_early_counts_whole() {
        let mut pace = Pace::new([(0, 100, 0), (1, 100, 40), (7, 300, 0)].into_iter());
        assert_eq!(pace.total, 460);
        assert_eq!(pace.progress([(0, 30), (1, 50)].into_iter()), 40);
        // Epochs end a little beyond the budget.
        assert_eq!(pace.progress([(1, 105)].into_iter()), 60);
        pace.ended(0);
        assert_eq!(pace.progress([(1, 50), (7, 90)].into_iter()), 200);
        pace.ended(0);
        assert_eq!(pace.progress(std::iter::empty()), 100, "it ends once");
        pace.elsewhere(1);
        assert_eq!((pace.total, pace.progress(std::iter::empty())), (400, 100), "what others do is not ours");
        assert_eq!(pace.eta(0), None);
        pace.began = Instant::now().checked_sub(Duration::from_secs(50)).unwrap();
        assert!((pace.eta(100).unwrap() - 150.0).abs() < 1.0);
    }
}
