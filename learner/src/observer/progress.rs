//! Progress for people: a bar on a terminal, plain lines elsewhere, a summary at the end.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use indicatif::{HumanCount, MultiProgress, ProgressBar, ProgressFinish, ProgressStyle};

use super::{EpochReport, Observer, RunStart, Summary};

/// All bars of the process, so that log lines know what to draw around.
static BARS: LazyLock<MultiProgress> = LazyLock::new(MultiProgress::new);

/// Plain lines are at least this far apart.
const INTERVAL: Duration = Duration::from_secs(10);

/// Weight of the newest epoch in the pace from which the remaining time is estimated.
const NEWEST: f64 = 0.2;

/// Shows progress on stderr, and a summary on stdout at the end of the run.
///
/// If stderr is a terminal, progress is a bar; log lines must then go through [`Progress::log_writer`]. Otherwise it is
/// a line every ten seconds at most, and for the first and the last epoch.
///
/// Comes last among the observers: its summary names the files that there are.
pub struct Progress {
    dir: PathBuf,
    total_steps: u64,
    seconds_per_step: Option<f64>,
    checkpoint: Option<PathBuf>,
    view: View,
}

enum View {
    /// On a terminal; drawn from the start of the run on.
    Bar(Option<ProgressBar>),
    /// Elsewhere.
    Lines { out: Box<dyn Write + Send>, printed: Option<Instant>, held_back: Option<String> },
}

impl Progress {
    /// Progress on stderr, in the form that suits what stderr is.
    pub fn new() -> Self {
        if BARS.is_hidden() { Self::lines(Box::new(io::stderr())) } else { Self::with(View::Bar(None)) }
    }

    /// Plain lines to `out`.
    fn lines(out: Box<dyn Write + Send>) -> Self {
        Self::with(View::Lines { out, printed: None, held_back: None })
    }

    fn with(view: View) -> Self {
        Self { dir: PathBuf::new(), total_steps: 0, seconds_per_step: None, checkpoint: None, view }
    }

    /// All bars of the process: log lines are drawn above whatever is among them.
    pub(crate) fn bars() -> &'static MultiProgress {
        &BARS
    }

    /// Writes to stderr, above the bar if there is one: `tracing_subscriber::fmt().with_writer(Progress::log_writer)`.
    pub fn log_writer() -> impl Write {
        LogWriter
    }

    /// Estimated seconds until `env_steps` have become the total.
    fn eta(&mut self, env_steps: u64, steps_per_second: f64) -> Option<f64> {
        if steps_per_second.is_finite() && steps_per_second > 0.0 {
            let newest = 1.0 / steps_per_second;
            let pace = self.seconds_per_step.map_or(newest, |pace| pace + NEWEST * (newest - pace));
            self.seconds_per_step = Some(pace);
        }
        self.seconds_per_step.map(|pace| pace * self.total_steps.saturating_sub(env_steps) as f64)
    }
}

impl Default for Progress {
    fn default() -> Self {
        Self::new()
    }
}

impl Observer for Progress {
    fn run_start(&mut self, start: &RunStart) -> anyhow::Result<()> {
        self.dir.clone_from(&start.dir);
        self.total_steps = start.total_steps;
        if let View::Bar(bar) = &mut self.view {
            let style = ProgressStyle::with_template(
                "{spinner:.green} {elapsed} [{bar:24.cyan/blue}] {human_pos}/{human_len} steps  {wide_msg}",
            )?;
            let new = ProgressBar::new(start.total_steps).with_style(style.progress_chars("=> "));
            let new = BARS.add(new.with_finish(ProgressFinish::Abandon));
            new.set_position(start.env_steps);
            new.enable_steady_tick(Duration::from_millis(250));
            *bar = Some(new);
        }
        Ok(())
    }

    fn epoch(&mut self, report: &EpochReport) -> anyhow::Result<()> {
        let (metrics, timing) = (&report.metrics, &report.timing);
        let eta = self.eta(metrics.env_steps, timing.steps_per_second).map_or_else(|| "?".into(), clock);
        let total = self.total_steps;
        let values = format!(
            "{} steps/s  return {:.3}  mmer {:.3}  eta {eta}",
            HumanCount(timing.steps_per_second as u64),
            metrics.mean_return,
            metrics.mmer
        );
        match &mut self.view {
            View::Bar(None) => {}
            View::Bar(Some(bar)) => {
                bar.set_position(metrics.env_steps);
                bar.set_message(values);
            }
            View::Lines { out, printed, held_back } => {
                let (epoch, steps) = (metrics.epoch + 1, metrics.env_steps);
                let percent = steps * 100 / total.max(1);
                let (steps, total) = (HumanCount(steps), HumanCount(total));
                let line = format!("epoch {epoch}  steps {steps} / {total} ({percent}%)  {values}");
                if printed.is_none_or(|printed| printed.elapsed() >= INTERVAL) {
                    *printed = Some(Instant::now());
                    *held_back = None;
                    writeln!(out, "{line}").context("cannot write progress to stderr")?;
                } else {
                    *held_back = Some(line);
                }
            }
        }
        Ok(())
    }

    fn checkpoint(&mut self, _epoch: u64, path: &Path) -> anyhow::Result<()> {
        self.checkpoint = Some(path.to_owned());
        Ok(())
    }

    fn run_end(&mut self, summary: &Summary) -> anyhow::Result<()> {
        match &mut self.view {
            View::Bar(bar) => {
                if let Some(bar) = bar.take() {
                    bar.finish_and_clear();
                }
            }
            View::Lines { out, held_back, .. } => {
                if let Some(line) = held_back.take() {
                    writeln!(out, "{line}").context("cannot write progress to stderr")?;
                }
            }
        }
        let text = describe(summary, &self.dir, self.checkpoint.as_deref());
        io::stdout().lock().write_all(text.as_bytes()).context("cannot write the summary to stdout")
    }
}

/// The end of a run in a few lines, with those of its files that exist.
fn describe(summary: &Summary, dir: &Path, checkpoint: Option<&Path>) -> String {
    let Summary { env, memory, preset, seed, .. } = summary;
    let rate = summary.env_steps as f64 / summary.wall_seconds;
    let rate = if rate.is_finite() { format!(" ({} steps/s)", HumanCount(rate as u64)) } else { String::new() };
    let number = |value: Option<f64>| value.map_or_else(|| "none".into(), |value| format!("{value:.3}"));
    let stopped_by = match summary.stopped_by.as_str() {
        "steps" => "all steps done",
        "mmer" => "the MMER asked for was reached",
        "interrupt" => "interrupted",
        other => other,
    };
    let mut lines = vec![
        ("trained", format!("{memory} on {env}, preset {preset}, seed {seed}")),
        (
            "steps",
            format!(
                "{} in {} epochs, {} episodes",
                HumanCount(summary.env_steps),
                HumanCount(summary.epochs),
                HumanCount(summary.episodes)
            ),
        ),
        ("time", format!("{}{rate}", clock(summary.wall_seconds))),
        ("mmer", format!("{} (last epoch {})", number(summary.mmer), number(summary.final_mean_return))),
        ("stopped", stopped_by.to_owned()),
    ];
    for (name, file) in [("curve", "curve.svg"), ("metrics", "metrics.csv")] {
        let path = dir.join(file);
        if path.exists() {
            lines.push((name, path.display().to_string()));
        }
    }
    if let Some(path) = checkpoint {
        lines.push(("checkpoint", path.display().to_string()));
    }
    lines.iter().fold(String::new(), |text, (name, value)| text + &format!("{name:<11} {value}\n"))
}

/// Seconds as `m:ss`, `h:mm:ss`.
pub(crate) fn clock(seconds: f64) -> String {
    let seconds = seconds.max(0.0).round() as u64;
    let (hours, minutes, seconds) = (seconds / 3600, seconds / 60 % 60, seconds % 60);
    if hours > 0 { format!("{hours}:{minutes:02}:{seconds:02}") } else { format!("{minutes}:{seconds:02}") }
}

/// Stderr without the bar.
struct LogWriter;

impl Write for LogWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        BARS.suspend(|| io::stderr().write(bytes))
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().flush()
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::sync::{Arc, Mutex};

    use super::super::samples::{report, start, summary};
    use super::*;

    #[derive(Clone, Default)]
    struct Page(Arc<Mutex<Vec<u8>>>);

    impl Page {
        fn lines(&self) -> Vec<String> {
            String::from_utf8(self.0.lock().unwrap().clone()).unwrap().lines().map(str::to_owned).collect()
        }
    }

    impl Write for Page {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn first_and_last_epoch_have_lines() {
        let page = Page::default();
        let mut progress = Progress::lines(Box::new(page.clone()));
        progress.run_start(&start(Path::new("run"), 0)).unwrap();
        (0..10).for_each(|epoch| progress.epoch(&report(epoch)).unwrap());
        assert_eq!(
            page.lines(),
            ["epoch 1  steps 1,000 / 10,000 (10%)  500 steps/s  return -0.500  mmer -0.500  eta 0:18"]
        );
        if let View::Lines { printed, .. } = &mut progress.view {
            *printed = Instant::now().checked_sub(INTERVAL);
        }
        progress.epoch(&report(7)).unwrap();
        progress.epoch(&report(8)).unwrap();
        assert_eq!(page.lines().len(), 2);
        progress.run_end(&summary(9)).unwrap();
        assert_eq!(page.lines().len(), 3);
        assert!(page.lines()[2].starts_with("epoch 9  steps 9,000 / 10,000 (90%)"), "{:?}", page.lines());
    }

    #[test]
    fn eta_follows_the_pace() {
        let mut progress = Progress::lines(Box::new(io::sink()));
        progress.run_start(&start(Path::new("run"), 0)).unwrap();
        assert_eq!(progress.eta(0, f64::NAN), None);
        assert!((progress.eta(0, 100.0).unwrap() - 100.0).abs() < 1e-9);
        // 0.01 + 0.2 * (0.02 - 0.01) seconds a step.
        assert!((progress.eta(5000, 50.0).unwrap() - 60.0).abs() < 1e-9);
        assert!((progress.eta(5000, 0.0).unwrap() - 60.0).abs() < 1e-9);
        assert_eq!(progress.eta(11_000, 50.0), Some(0.0));
    }

    #[test]
    fn summary_names_files_that_exist() {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("metrics.csv"), "").unwrap();
        let text = describe(&summary(10), dir.path(), Some(Path::new("run/checkpoints/10")));
        let metrics = dir.path().join("metrics.csv").display().to_string();
        let expected = [
            "trained     GRU on RepeatPreviousEasy, preset paper, seed 0",
            "steps       10,000 in 10 epochs, 100 episodes",
            "time        0:20 (500 steps/s)",
            "mmer        1.750 (last epoch 1.750)",
            "stopped     all steps done",
            &format!("metrics     {metrics}"),
            "checkpoint  run/checkpoints/10",
        ];
        assert_eq!(text.lines().collect::<Vec<_>>(), expected);
        assert!(describe(&summary(0), dir.path(), None).contains("mmer        none (last epoch none)"));
    }

    #[test]
    fn clocks() {
        assert_eq!([0.4, 61.0, 3599.6, 90_061.0].map(clock), ["0:00", "1:01", "1:00:00", "25:01:01"]);
    }
}
