//! The command line.

use std::fmt::Display;
use std::path::PathBuf;
use std::str::FromStr;

use popgym_models::device;
use popgym_models::memory::Registry;
use serde::Serialize;
use tch::Device;

/// What [`Options::parse`] understands.
pub(crate) const USAGE: &str = "  --memories NAME,...   which memories (default: all)
  --shapes SxT,...      training batches: S sequences of T steps (default: 64x1024)
  --repeats N           measurements of each figure, 2 to 1000 (default: 10); --quick: 3
  --threads N           threads of training; a step on the CPU has one (default: all cores)
  --device DEVICE       auto, cpu or cuda (default: cpu)
  --json FILE           write all figures and their samples
  --chart FILE          draw the figures, as .svg or .png
  --python PYTHON       compare with PyTorch eager (eager.py), run in turns by this interpreter
  --help";

/// A training batch: sequences of equal length.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(crate) struct Shape {
    /// Number of sequences.
    pub(crate) sequences: i64,
    /// Steps of each.
    pub(crate) steps: i64,
}

impl Shape {
    /// Steps of all sequences.
    pub(crate) fn rows(self) -> i64 {
        self.sequences * self.steps
    }
}

impl Display for Shape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}x{}", self.sequences, self.steps)
    }
}

impl FromStr for Shape {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let size = |text: &str| text.parse().ok().filter(|size| (1..=65_536).contains(size));
        let parts = text.split_once('x').and_then(|(s, t)| Some((size(s)?, size(t)?)));
        let (sequences, steps) = parts.ok_or_else(|| {
            format!("`{text}` is no shape; allowed are two numbers from 1 to 65536 with an x between, as in 64x1024")
        })?;
        Ok(Self { sequences, steps })
    }
}

/// What to measure, and where to write it.
#[derive(Debug)]
pub(crate) struct Options {
    /// Names of memories.
    pub(crate) memories: Vec<String>,
    /// Training batches.
    pub(crate) shapes: Vec<Shape>,
    /// Measurements of each figure.
    pub(crate) repeats: usize,
    /// Threads of training.
    pub(crate) threads: u32,
    /// Where to compute.
    pub(crate) device: Device,
    /// File for all figures.
    pub(crate) json: Option<PathBuf>,
    /// File for the chart.
    pub(crate) chart: Option<PathBuf>,
    /// Interpreter with torch.
    pub(crate) python: Option<PathBuf>,
    /// Whether this is `cargo bench`, and not a test that all of it runs.
    pub(crate) measure: bool,
}

impl Options {
    /// From the arguments after the program's name; none if help is asked for.
    ///
    /// # Errors
    /// The first argument that is wrong, and what is allowed.
    pub(crate) fn parse(arguments: &[String]) -> Result<Option<Self>, String> {
        let measure = arguments.iter().any(|argument| argument == "--bench");
        let all = Registry::standard();
        let mut options = Self {
            memories: all.entries().iter().map(|entry| entry.name.to_owned()).collect(),
            shapes: vec![if measure { Shape { sequences: 64, steps: 1024 } } else { Shape { sequences: 2, steps: 3 } }],
            repeats: if measure { 10 } else { 2 },
            threads: std::thread::available_parallelism().map_or(1, |cores| cores.get() as u32),
            device: Device::Cpu,
            json: None,
            chart: None,
            python: None,
            measure,
        };
        let names = options.memories.clone();
        let mut rest = arguments.iter();
        while let Some(flag) = rest.next() {
            let mut value = || rest.next().ok_or_else(|| format!("{flag} needs a value"));
            match flag.as_str() {
                "--bench" => {}
                "--help" => return Ok(None),
                "--quick" => options.repeats = 3,
                "--memories" => options.memories = list(value()?, |name| known(name, &names))?,
                "--shapes" => options.shapes = list(value()?, str::parse)?,
                "--repeats" => options.repeats = number(flag, value()?, 2, 1000)? as usize,
                "--threads" => options.threads = number(flag, value()?, 1, 1024)?,
                "--device" => options.device = device::parse(value()?).map_err(|error| error.to_string())?,
                "--json" => options.json = Some(value()?.into()),
                "--chart" => options.chart = Some(chart(value()?)?),
                "--python" => options.python = Some(value()?.into()),
                // What cargo's own test runner would take means nothing here.
                _ if !measure => {}
                _ => return Err(format!("unknown argument `{flag}`; allowed are\n\n{USAGE}")),
            }
        }
        Ok(Some(options))
    }
}

fn list<T>(text: &str, parse: impl Fn(&str) -> Result<T, String>) -> Result<Vec<T>, String> {
    text.split(',').map(parse).collect()
}

fn known(name: &str, names: &[String]) -> Result<String, String> {
    let found = names.iter().find(|known| *known == name).cloned();
    found.ok_or_else(|| format!("unknown memory `{name}`; allowed are {}", names.join(", ")))
}

fn number(flag: &str, text: &str, least: u32, most: u32) -> Result<u32, String> {
    let number = text.parse().ok().filter(|number| (least..=most).contains(number));
    number.ok_or_else(|| format!("{flag} is `{text}`, allowed is {least} to {most}"))
}

fn chart(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    let known = path.extension().is_some_and(|extension| extension == "svg" || extension == "png");
    if known { Ok(path) } else { Err(format!("--chart is `{text}`, allowed is a file that ends in .svg or .png")) }
}
