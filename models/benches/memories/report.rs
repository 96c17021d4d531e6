//! All figures, and their tables.

use serde::Serialize;

use crate::arithmetic::{Sample, median, pass_operations};
use crate::eager::{Comparison, Work};
use crate::options::Shape;

/// What a run measured.
#[derive(Serialize)]
pub(crate) struct Report {
    /// `cpu` or `cuda`.
    pub(crate) device: &'static str,
    /// The processor's name, where the system tells it.
    pub(crate) processor: Option<String>,
    /// Threads of training.
    pub(crate) threads: u32,
    /// Measurements of each figure.
    pub(crate) repeats: usize,
    /// Width of the input.
    pub(crate) input: i64,
    /// The most f32 operations a second of a matrix product, with the same threads.
    pub(crate) peak_operations_per_second: f64,
    /// Each memory's own figures.
    pub(crate) memories: Vec<Figures>,
    /// Each memory beside PyTorch eager.
    pub(crate) comparisons: Vec<Comparison>,
}

/// One memory's figures.
#[derive(Serialize)]
pub(crate) struct Figures {
    /// Its name in configurations.
    pub(crate) name: String,
    /// Its name in POPGym's tables.
    pub(crate) paper_name: String,
    /// Width of its output.
    pub(crate) output: i64,
    /// Trainable parameters.
    pub(crate) parameters: usize,
    /// Of these, in matrices.
    pub(crate) matrix_weights: usize,
    /// Floats of a row's state.
    pub(crate) state_floats: usize,
    /// Training, for each shape.
    pub(crate) training: Vec<Training>,
    /// Single steps, for each number of rows.
    pub(crate) steps: Vec<Step>,
}

/// Training on one shape.
#[derive(Serialize)]
pub(crate) struct Training {
    /// The batch.
    pub(crate) shape: Shape,
    /// Forward, backward of the mean output, and Adam's step.
    pub(crate) seconds: Sample,
    /// Memory beyond parameters and Adam's moments.
    pub(crate) peak_bytes: Option<u64>,
    /// Operations of forward and backward: see [`pass_operations`].
    pub(crate) operations: f64,
}

/// One step of several rows.
#[derive(Serialize)]
pub(crate) struct Step {
    /// Rows.
    pub(crate) rows: i64,
    /// Seconds of the whole step.
    pub(crate) seconds: Sample,
}

impl Report {
    /// Each memory's own figures, as Markdown.
    pub(crate) fn figures(&self) -> String {
        let mut head: Vec<String> = ["memory", "parameters", "state", "batch", "training, ms", "peak, MiB", "of peak"]
            .map(str::to_owned)
            .into();
        let rows = self.memories.first().map_or(&[][..], |figures| &figures.steps);
        head.extend(rows.iter().map(|step| format!("step of {}, us", step.rows)));
        let mut table = vec![head];
        for figures in &self.memories {
            for training in &figures.training {
                let mut line = vec![
                    figures.paper_name.clone(),
                    figures.parameters.to_string(),
                    figures.state_floats.to_string(),
                    training.shape.to_string(),
                    interval(&training.seconds, 1e3),
                    training.peak_bytes.map_or_else(|| "-".to_owned(), |bytes| (bytes >> 20).to_string()),
                    self.share(training.operations, training.seconds.mean),
                ];
                line.extend(figures.steps.iter().map(|step| interval(&step.seconds, 1e6)));
                table.push(line);
            }
        }
        markdown(&table)
    }

    /// Training beside eager, and steps beside eager, as Markdown.
    pub(crate) fn comparison(&self) -> String {
        let head = |columns: &[&str]| vec![columns.iter().map(|&column| column.to_owned()).collect::<Vec<_>>()];
        let mut passes = head(&["memory", "batch", "batches/s", "eager", "ratio", "GFLOP", "of peak"]);
        let mut steps = head(&["memory", "rows", "steps/s", "eager", "ratio"]);
        for comparison in &self.comparisons {
            let Some(figures) = self.memories.iter().find(|figures| figures.name == comparison.memory) else {
                continue;
            };
            let (ours, eager) = (median(&comparison.ours), median(&comparison.eager));
            let [low, high] = comparison.ratio_quartiles;
            let ratio = format!("{:.2} ({low:.2} to {high:.2})", comparison.ratio);
            let name = figures.paper_name.clone();
            match comparison.work {
                Work::Pass(shape) => {
                    let operations = pass_operations(figures.matrix_weights, shape.rows());
                    passes.push(vec![
                        name,
                        shape.to_string(),
                        digits(1.0 / ours),
                        digits(1.0 / eager),
                        ratio,
                        digits(operations / 1e9),
                        self.share(operations, ours),
                    ]);
                }
                Work::Step { rows } => {
                    let rate = |seconds: f64| digits(rows as f64 / seconds);
                    steps.push(vec![name, rows.to_string(), rate(ours), rate(eager), ratio]);
                }
            }
        }
        format!("{}\n{}", markdown(&passes), markdown(&steps))
    }

    fn share(&self, operations: f64, seconds: f64) -> String {
        format!("{:.1}%", 100.0 * operations / seconds / self.peak_operations_per_second)
    }
}

/// Mean and half width of the interval, in units of 1 / `scale`.
pub(crate) fn interval(sample: &Sample, scale: f64) -> String {
    let (mean, half_width) = (sample.mean * scale, sample.half_width * scale);
    let places = places(mean);
    format!("{mean:.places$} ± {half_width:.places$}")
}

/// A positive number with three digits or more.
pub(crate) fn digits(value: f64) -> String {
    format!("{value:.*}", places(value))
}

fn places(value: f64) -> usize {
    (2.0 - value.log10().floor()).clamp(0.0, 6.0) as usize
}

/// A table whose first line is its head; the first column stands left, all others right.
fn markdown(table: &[Vec<String>]) -> String {
    let width = |column: usize| table.iter().map(|line| line[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..table[0].len()).map(width).collect();
    let mut text = String::new();
    for (i, line) in table.iter().enumerate() {
        let cells = line.iter().zip(&widths).enumerate();
        let cells = cells.map(
            |(column, (cell, &width))| {
                if column == 0 { format!(" {cell:<width$} |") } else { format!(" {cell:>width$} |") }
            },
        );
        text.extend(std::iter::once("|".to_owned()).chain(cells).chain(["\n".to_owned()]));
        if i == 0 {
            let rules = widths.iter().enumerate();
            let rules = rules.map(|(column, &width)| {
                let rule = "-".repeat(width + 1);
                if column == 0 { format!("{rule}-|") } else { format!("{rule}:|") }
            });
            text.extend(std::iter::once("|".to_owned()).chain(rules).chain(["\n".to_owned()]));
        }
    }
    text
}
