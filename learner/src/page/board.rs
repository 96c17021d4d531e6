//! What the page shows: filled by the trainer as an [`Observer`] and by the service, read by the port's handlers.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use serde::Serialize;

use crate::observer::{EpochMetrics, EpochReport, EpochTiming, MetricsCsv, Observer, RunStart, Summary};
use crate::service::roster::{ActorView, Roster};

/// Points of the curve that are sent at most: more than a screen has columns for.
const POINTS: usize = 400;

/// Epochs over which the page says where time goes.
const RECENT_EPOCHS: usize = 20;

/// A stretch of the learning curve: some epochs, one after the other.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Point {
    /// Environment steps at its end.
    steps: u64,
    /// Mean of the epochs' mean returns.
    mean: f64,
    /// Smallest and largest return of an episode.
    min: f64,
    max: f64,
    /// Largest mean return of an epoch so far.
    mmer: f64,
    #[serde(skip)]
    epochs: u32,
}

impl Point {
    fn of(row: &EpochMetrics) -> Self {
        let EpochMetrics { env_steps, mean_return, min_return, max_return, mmer, .. } = *row;
        Self { steps: env_steps, mean: mean_return, min: min_return, max: max_return, mmer, epochs: 1 }
    }

    /// This stretch and the one after it.
    fn and(self, next: Self) -> Self {
        let epochs = self.epochs + next.epochs;
        let sum = self.mean * f64::from(self.epochs) + next.mean * f64::from(next.epochs);
        Self { mean: sum / f64::from(epochs), min: self.min.min(next.min), max: self.max.max(next.max), epochs, ..next }
    }
}

/// A curve of [`POINTS`] stretches at most, however long the run.
#[derive(Debug, Default)]
struct Points {
    points: Vec<Point>,
    /// Epochs of a full stretch.
    stretch: u32,
}

impl Points {
    fn push(&mut self, row: &EpochMetrics) {
        let point = Point::of(row);
        match self.points.last_mut() {
            Some(last) if last.epochs < self.stretch => *last = last.and(point),
            _ => self.points.push(point),
        }
        if self.points.len() > POINTS {
            self.points = self.points.chunks(2).filter_map(|pair| pair.iter().copied().reduce(Point::and)).collect();
            self.stretch = 2 * self.stretch.max(1);
        }
    }
}

#[derive(Debug, Default)]
struct Contents {
    run: Option<RunStart>,
    config: String,
    curve: Points,
    last: Option<EpochMetrics>,
    recent: VecDeque<EpochTiming>,
    checkpoint: Option<(u64, Instant)>,
    end: Option<Summary>,
    roster: Option<Arc<Roster>>,
}

/// The run as it stands, for the page.
#[derive(Clone, Debug, Default)]
pub struct Board(Arc<Mutex<Contents>>);

/// What the page asks for, every few seconds.
#[derive(Debug, Serialize)]
pub(super) struct View {
    run: Option<Run>,
    config: String,
    curve: Vec<Point>,
    last: Option<EpochMetrics>,
    /// Sums over the last epochs.
    recent: Option<Recent>,
    /// Epoch of the last checkpoint, and its age in seconds.
    checkpoint: Option<(u64, f64)>,
    /// Why the run has ended, if it has.
    ended: Option<String>,
    actors: Vec<ActorView>,
    files: Vec<&'static str>,
}

#[derive(Debug, Serialize)]
struct Run {
    dir: String,
    env: String,
    memory: String,
    preset: String,
    seed: u64,
    total_steps: u64,
    version: &'static str,
}

#[derive(Debug, Serialize)]
struct Recent {
    epochs: usize,
    seconds: f64,
    steps_per_second: f64,
    wait_seconds: f64,
    learn_seconds: f64,
    other_seconds: f64,
}

impl Recent {
    fn of(timings: &VecDeque<EpochTiming>) -> Option<Self> {
        let sum = |part: fn(&EpochTiming) -> f64| timings.iter().map(part).sum::<f64>();
        let steps = sum(|timing| timing.steps_per_second * seconds(timing));
        let all = sum(seconds);
        (all > 0.0).then(|| Self {
            epochs: timings.len(),
            seconds: all,
            steps_per_second: steps / all,
            wait_seconds: sum(|timing| timing.wait_seconds),
            learn_seconds: sum(|timing| timing.learn_seconds),
            other_seconds: sum(|timing| timing.other_seconds),
        })
    }
}

fn seconds(timing: &EpochTiming) -> f64 {
    timing.wait_seconds + timing.learn_seconds + timing.other_seconds
}

impl Board {
    /// What the run's configuration says, as TOML.
    pub fn set_config(&self, toml: String) {
        self.lock().config = toml;
    }

    /// Where to look for the actors.
    pub fn set_roster(&self, roster: Arc<Roster>) {
        self.lock().roster = Some(roster);
    }

    /// The run directory, once there is one.
    pub(super) fn dir(&self) -> Option<PathBuf> {
        self.lock().run.as_ref().map(|run| run.dir.clone())
    }

    /// All of it; `files` are those of the run directory.
    pub(super) fn view(&self, files: Vec<&'static str>) -> View {
        let contents = self.lock();
        let run = contents.run.as_ref();
        View {
            config: contents.config.clone(),
            curve: contents.curve.points.clone(),
            last: contents.last.clone(),
            recent: Recent::of(&contents.recent),
            checkpoint: contents.checkpoint.map(|(epoch, at)| (epoch, at.elapsed().as_secs_f64())),
            ended: contents.end.as_ref().map(|summary| summary.stopped_by.clone()),
            actors: contents.roster.as_ref().map(|roster| roster.actors()).unwrap_or_default(),
            files,
            run: run.map(|run| Run {
                dir: run.dir.display().to_string(),
                env: run.env.clone(),
                memory: run.memory.clone(),
                preset: run.preset.clone(),
                seed: run.seed,
                total_steps: run.total_steps,
                version: env!("CARGO_PKG_VERSION"),
            }),
        }
    }

    fn lock(&self) -> MutexGuard<'_, Contents> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Observer for Board {
    fn run_start(&mut self, start: &RunStart) -> anyhow::Result<()> {
        let earlier = if start.epoch > 0 { MetricsCsv::read(&start.dir)? } else { Vec::new() };
        let mut contents = self.lock();
        contents.run = Some(start.clone());
        for row in earlier.iter().filter(|row| row.epoch < start.epoch) {
            contents.curve.push(row);
            contents.last = Some(row.clone());
        }
        Ok(())
    }

    fn epoch(&mut self, EpochReport { metrics, timing }: &EpochReport) -> anyhow::Result<()> {
        let mut contents = self.lock();
        contents.curve.push(metrics);
        contents.last = Some(metrics.clone());
        contents.recent.push_back(timing.clone());
        if contents.recent.len() > RECENT_EPOCHS {
            contents.recent.pop_front();
        }
        Ok(())
    }

    fn checkpoint(&mut self, epoch: u64, _path: &Path) -> anyhow::Result<()> {
        self.lock().checkpoint = Some((epoch, Instant::now()));
        Ok(())
    }

    fn run_end(&mut self, summary: &Summary) -> anyhow::Result<()> {
        self.lock().end = Some(summary.clone());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observer::samples::{report, start};

    #[test]
    fn a_long_curve_keeps_its_extremes_its_end_and_its_mean() {
        let mut curve = Points::default();
        let mut row = report(0).metrics;
        for epoch in 0..5000_u32 {
            row.env_steps = u64::from(epoch + 1) * 100;
            row.mean_return = f64::from(epoch);
            row.min_return = if epoch == 1234 { -7.0 } else { 0.0 };
            row.max_return = if epoch == 4321 { 9e9 } else { 1e6 };
            curve.push(&row);
        }
        let points = &curve.points;
        assert!(points.len() <= POINTS && points.len() > POINTS / 2, "{}", points.len());
        assert_eq!(points.iter().map(|point| point.epochs).sum::<u32>(), 5000);
        assert_eq!(points.last().unwrap().steps, 500_000);
        assert!(points.is_sorted_by_key(|point| point.steps));
        assert_eq!(points.iter().filter(|point| (point.min + 7.0).abs() < 1e-9).count(), 1);
        assert_eq!(points.iter().filter(|point| (point.max - 9e9).abs() < 1.0).count(), 1);
        let mean = points.iter().map(|point| point.mean * f64::from(point.epochs)).sum::<f64>() / 5000.0;
        assert!((mean - 2499.5).abs() < 1e-6, "{mean}");
    }

    #[test]
    fn where_time_goes_is_of_the_last_epochs() {
        let mut board = Board::default();
        board.run_start(&start(Path::new("/"), 0)).unwrap();
        for epoch in 0..30 {
            let mut report = report(epoch);
            let slow = if epoch < 10 { 100.0 } else { 1.0 };
            (report.timing.wait_seconds, report.timing.learn_seconds, report.timing.other_seconds) = (slow, 2.0, 1.0);
            report.timing.steps_per_second = 500.0;
            board.epoch(&report).unwrap();
        }
        let recent = board.view(Vec::new()).recent.unwrap();
        assert_eq!((recent.epochs, recent.seconds), (20, 80.0));
        assert_eq!((recent.wait_seconds, recent.learn_seconds, recent.other_seconds), (20.0, 40.0, 20.0));
        assert!((recent.steps_per_second - 500.0).abs() < 1e-9);
    }
}
