//! The comparison with PyTorch eager: `eager.py` in a process of its own, in turns with the memories here.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tch::Device;

use crate::arithmetic::{median, quartiles};
use crate::measure::Subject;
use crate::options::Shape;

const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/benches/eager.py");

/// Between turns, so that the other's threads have come to rest.
const REST: Duration = Duration::from_millis(20);

/// A running `eager.py --serve`.
pub(crate) struct Eager {
    process: Child,
    requests: Option<ChildStdin>,
    answers: BufReader<ChildStdout>,
}

/// The work that is compared.
#[derive(Clone, Copy, Serialize)]
#[serde(untagged)]
pub(crate) enum Work {
    /// Forward, and the backward of the mean output.
    Pass(Shape),
    /// One step without gradients on one thread.
    Step {
        /// Rows of the batch.
        rows: i64,
    },
}

#[derive(Serialize)]
struct Request<'a> {
    memory: &'a str,
    #[serde(flatten)]
    work: Work,
    /// Both sides must have as many.
    parameters: usize,
    seconds: f64,
}

#[derive(Deserialize)]
struct Answer {
    seconds: f64,
}

/// One memory doing one work, here and in eager.
#[derive(Serialize)]
pub(crate) struct Comparison {
    /// Name of the memory.
    pub(crate) memory: String,
    /// What it does.
    #[serde(flatten)]
    pub(crate) work: Work,
    /// Median seconds of each turn here.
    pub(crate) ours: Vec<f64>,
    /// Median seconds of each turn in eager.
    pub(crate) eager: Vec<f64>,
    /// Median over turns of eager's seconds by ours.
    pub(crate) ratio: f64,
    /// Its quartiles over turns.
    pub(crate) ratio_quartiles: [f64; 2],
}

impl Eager {
    /// Starts `python`.
    pub(crate) fn start(python: &Path, device: Device, threads: u32) -> Result<Self, String> {
        let device = if device.is_cuda() { "cuda" } else { "cpu" };
        let process = Command::new(python)
            .args([SCRIPT, "--serve", "--device", device, "--threads", &threads.to_string()])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn();
        let mut process = process.map_err(|error| format!("{}: {error}", python.display()))?;
        let (requests, answers) = (process.stdin.take(), process.stdout.take());
        let answers = BufReader::new(answers.expect("its output is piped"));
        Ok(Self { process, requests, answers })
    }

    /// Median seconds of a pass or step.
    fn time(&mut self, request: &Request<'_>) -> Result<f64, String> {
        let mut line = serde_json::to_string(request).expect("plain data");
        line.push('\n');
        let sent = self.requests.as_mut().map_or(Ok(()), |requests| requests.write_all(line.as_bytes()));
        line.clear();
        let received = sent.and_then(|()| self.answers.read_line(&mut line));
        let answer: Option<Answer> = received.ok().and_then(|_| serde_json::from_str(&line).ok());
        answer
            .map(|answer| answer.seconds)
            .ok_or_else(|| format!("eager.py gave no answer for {}; see above", request.memory))
    }
}

impl Drop for Eager {
    fn drop(&mut self) {
        // It ends when its input does.
        self.requests = None;
        let _ = self.process.wait();
    }
}

impl Comparison {
    /// Turns about: `rounds` after one to warm up, each of about `seconds`.
    pub(crate) fn measure(
        (memory, subject): (&str, &mut Subject),
        eager: &mut Eager,
        work: Work,
        rounds: usize,
        seconds: f64,
    ) -> Result<Self, String> {
        let parameters = subject.parameters();
        let mut here: Box<dyn FnMut(f64) -> f64> = match work {
            Work::Pass(shape) => {
                let batch = subject.batch(shape);
                Box::new(move |seconds| median(&subject.passes(&batch, seconds)))
            }
            Work::Step { rows } => Box::new(move |seconds| median(&subject.steps(rows, seconds))),
        };
        let (mut ours, mut theirs) = (Vec::new(), Vec::new());
        for round in 0..=rounds {
            // The first only warms up.
            let seconds = if round == 0 { 0.0 } else { seconds };
            let mut times = [0.0; 2];
            // Neither is always first.
            for turn in [round % 2, 1 - round % 2] {
                std::thread::sleep(REST);
                times[turn] = if turn == 0 {
                    here(seconds)
                } else {
                    eager.time(&Request { memory, work, parameters, seconds })?
                };
            }
            if round > 0 {
                ours.push(times[0]);
                theirs.push(times[1]);
            }
        }
        let ratios: Vec<f64> = ours.iter().zip(&theirs).map(|(ours, eager)| eager / ours).collect();
        let (ratio, ratio_quartiles) = (median(&ratios), quartiles(&ratios));
        Ok(Self { memory: memory.to_owned(), work, ours, eager: theirs, ratio, ratio_quartiles })
    }
}
