//! How fast the memories are: POPGym's figure of model throughput, and a comparison with PyTorch eager.
//!
//! ```text
//! cargo bench -p popgym-models
//! cargo bench -p popgym-models -- --json "$PWD/memories.json" --chart "$PWD/memories.svg"
//! cargo bench -p popgym-models -- --memories gru,lmu --shapes 158x52,8x1023 --threads 2 --python "$PWD/venv/bin/python"
//! cargo bench -p popgym-models -- --help
//! ```
//!
//! Cargo runs it in `models/`: give files with their whole path. Every memory of the registry is measured alone, without
//! encoder and heads, input 128, hidden 256, with its default options:
//!
//! - training: `scan` forward, the backward of the mean output to the parameters and the input, and one step of Adam, on 64
//!   sequences of 1024 steps (or `--shapes`), `--threads` threads;
//! - step: one time step (`act`) of 1 and of 64 rows, one thread, the state carried on from step to step;
//! - peak: memory of a training step beyond the parameters and Adam's moments, of a process that does nothing else; on CUDA
//!   tch offers no figure, so there is none;
//! - of peak: operations of forward and backward a second, by those of a product of square f32 matrices (1024, on CUDA 8192),
//!   the fastest of a second before and a second after all else, same threads. Counted are the products with the trainable
//!   matrices alone: 2 operations for each weight and row forward, and twice that backward. What else a memory does (outer products, Fourier
//!   transforms, the LMU's fixed matrix) counts as nothing.
//!
//! Each figure is the mean of `--repeats` measurements after one to warm up, `±` half of its 95% interval (Student).
//!
//! `--python PYTHON`, an interpreter with torch, adds a comparison with `eager.py`, the same memories as one would write them
//! in PyTorch: passes (training without Adam) and steps of 1, 64 and 256 rows. Both do the same work in turns, `--repeats` of
//! them, so that whatever else the machine does meets both; rates are medians over the turns, the ratio is the median of
//! each turn's (above 1: faster than eager), and half of the turns lie within the numbers in brackets. steps/s are rows a second.
//!
//! libtorch's threads wait for one another without sleeping: on a machine with other work, training on all cores takes many
//! times its time unless OMP_WAIT_POLICY=passive is set (for both sides).
//!
//! Without cargo's `--bench` (under `cargo test --all-targets`) it only runs everything once, at a tiny size.

mod arithmetic;
mod chart;
mod eager;
mod measure;
mod options;
mod peak;
mod report;

use std::fs::File;
use std::process::ExitCode;
use std::time::Instant;

use popgym_models::memory::{Entry, Registry};

use crate::arithmetic::{Sample, mean, pass_operations};
use crate::eager::{Comparison, Eager, Work};
use crate::measure::{INPUT, Subject, peak_operations};
use crate::options::{Options, Shape, USAGE};
use crate::report::{Figures, Report, Step, Training, interval};

const STEP_ROWS: [i64; 2] = [1, 64];
const COMPARED_ROWS: [i64; 3] = [1, 64, 256];

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let done = match arguments.split_first() {
        Some((first, rest)) if first == peak::ARGUMENT => peak::child(rest),
        _ => Options::parse(&arguments).and_then(|options| {
            options.map_or_else(
                || {
                    println!("{USAGE}");
                    Ok(())
                },
                |options| run(&options),
            )
        }),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(options: &Options) -> Result<(), String> {
    // A file that cannot be written is better known before than after.
    for path in options.json.iter().chain(&options.chart) {
        File::create(path).map_err(|error| format!("{}: {error}", path.display()))?;
    }
    let start = |python: &std::path::PathBuf| Eager::start(python, options.device, options.threads);
    let mut eager = options.python.as_ref().map(start).transpose()?;
    let registry = Registry::standard();
    let peak = || peak_operations(options.device, options.threads, seconds(options, 1.0));
    let mut report = Report {
        device: if options.device.is_cuda() { "cuda" } else { "cpu" },
        processor: processor(),
        threads: options.threads,
        repeats: options.repeats,
        input: INPUT,
        peak_operations_per_second: peak(),
        memories: Vec::new(),
        comparisons: Vec::new(),
    };
    for (i, name) in options.memories.iter().enumerate() {
        let entry = registry.get(name).map_err(|error| error.to_string())?;
        let begun = Instant::now();
        let mut subject = Subject::new(entry, options.device, options.threads)?;
        let figures = figures(entry, &mut subject, options);
        let compared = eager.as_mut().map(|eager| compare(name, &mut subject, eager, options)).transpose()?;
        let compared = compared.unwrap_or_default();
        progress((i + 1, options.memories.len()), &figures, &compared, begun);
        report.memories.push(figures);
        report.comparisons.extend(compared);
    }
    report.peak_operations_per_second = report.peak_operations_per_second.max(peak());
    write(options, &report)
}

/// `whole` seconds, or next to none where nothing is to be measured.
fn seconds(options: &Options, whole: f64) -> f64 {
    if options.measure { whole } else { 0.0 }
}

fn figures(entry: &Entry, subject: &mut Subject, options: &Options) -> Figures {
    let training = options.shapes.iter().map(|&shape| training(entry.name, subject, shape, options)).collect();
    let steps = STEP_ROWS.map(|rows| {
        let time = seconds(options, 0.05);
        subject.steps(rows, time);
        let values = (0..options.repeats).map(|_| mean(&subject.steps(rows, time))).collect();
        Step { rows, seconds: Sample::new(values) }
    });
    Figures {
        name: entry.name.to_owned(),
        paper_name: entry.paper_name.to_owned(),
        output: subject.output_width(),
        parameters: subject.parameters(),
        matrix_weights: subject.matrix_weights(),
        state_floats: subject.state_floats(),
        training,
        steps: steps.into(),
    }
}

fn training(name: &str, subject: &mut Subject, shape: Shape, options: &Options) -> Training {
    let batch = subject.batch(shape);
    subject.train(&batch);
    let values = (0..options.repeats).map(|_| subject.train_seconds(&batch)).collect();
    let peak_bytes = if options.device.is_cuda() {
        None
    } else {
        peak::of(name, shape, options.threads).map_err(|error| eprintln!("no peak memory of {name}: {error}")).ok()
    };
    let operations = pass_operations(subject.matrix_weights(), shape.rows());
    Training { shape, seconds: Sample::new(values), peak_bytes, operations }
}

fn compare(name: &str, subject: &mut Subject, eager: &mut Eager, options: &Options) -> Result<Vec<Comparison>, String> {
    let passes = options.shapes.iter().map(|&shape| (Work::Pass(shape), seconds(options, 0.3)));
    let steps = COMPARED_ROWS.map(|rows| (Work::Step { rows }, seconds(options, 0.1)));
    let all = passes.chain(steps);
    all.map(|(work, time)| Comparison::measure((name, &mut *subject), eager, work, options.repeats, time)).collect()
}

/// One line on the standard error.
fn progress((done, all): (usize, usize), figures: &Figures, compared: &[Comparison], begun: Instant) {
    let training = figures.training.iter().map(|part| format!("{}: {} ms", part.shape, interval(&part.seconds, 1e3)));
    let steps = figures.steps.iter().map(|part| format!("step of {}: {} us", part.rows, interval(&part.seconds, 1e6)));
    let ratios: Vec<String> = compared.iter().map(|comparison| format!("{:.2}", comparison.ratio)).collect();
    let ratios = (!ratios.is_empty()).then(|| format!("eager's times by ours: {}", ratios.join(" ")));
    let parts: Vec<String> = training.chain(steps).chain(ratios).collect();
    let (name, took) = (&figures.name, begun.elapsed().as_secs_f64());
    eprintln!("[{done}/{all}] {name}: {} ({took:.0} s)", parts.join(", "));
}

fn write(options: &Options, report: &Report) -> Result<(), String> {
    let at = if report.device == "cuda" { "on CUDA".to_owned() } else { format!("{} threads", report.threads) };
    println!(
        "{}, {at}, {} repeats; peak: {:.0} GFLOP/s of a matrix product\n",
        report.processor.as_deref().unwrap_or("unknown processor"),
        report.repeats,
        report.peak_operations_per_second / 1e9
    );
    println!("{}", report.figures());
    if !report.comparisons.is_empty() {
        println!("{}", report.comparison());
    }
    if let Some(path) = &options.json {
        let text = serde_json::to_string_pretty(report).map_err(|error| error.to_string())?;
        std::fs::write(path, text + "\n").map_err(|error| format!("{}: {error}", path.display()))?;
    }
    if let Some(path) = &options.chart {
        chart::draw(path, report).map_err(|error| format!("{}: {error}", path.display()))?;
    }
    Ok(())
}

fn processor() -> Option<String> {
    let text = std::fs::read_to_string("/proc/cpuinfo").ok()?;
    let name = text.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'))?.1;
    Some(name.trim().to_owned())
}
