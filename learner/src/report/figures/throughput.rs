//! How fast the memories are: figures of `cargo bench -p popgym-models -- --json FILE`.

use std::path::Path;

use anyhow::Context as _;
use serde::Deserialize;

use super::bars::{Bar, Bars};
use super::{Figure, Section};
use crate::chart::short;

/// The parts of the benchmark's JSON that are shown.
#[derive(Debug, Deserialize)]
pub struct Throughput {
    device: String,
    processor: Option<String>,
    threads: u32,
    memories: Vec<Memory>,
}

#[derive(Debug, Deserialize)]
struct Memory {
    paper_name: String,
    training: Vec<Training>,
    steps: Vec<Step>,
}

#[derive(Debug, Deserialize)]
struct Training {
    shape: Shape,
    seconds: Seconds,
}

#[derive(Clone, Copy, Debug, Deserialize, PartialEq)]
struct Shape {
    sequences: i64,
    steps: i64,
}

#[derive(Debug, Deserialize)]
struct Step {
    rows: i64,
    seconds: Seconds,
}

#[derive(Debug, Deserialize)]
struct Seconds {
    mean: f64,
    half_width: f64,
}

impl Throughput {
    /// Reads the file.
    ///
    /// # Errors
    /// It cannot be read, or is not the benchmark's JSON.
    pub fn read(path: &Path) -> anyhow::Result<Self> {
        let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
        let wrong = || format!("{} is not what `cargo bench -p popgym-models -- --json FILE` writes", path.display());
        let found: Self = serde_json::from_str(&text).with_context(wrong)?;
        for memory in &found.memories {
            memory.check().with_context(|| format!("{}, {}", path.display(), memory.paper_name))?;
        }
        Ok(found)
    }

    /// Where it was measured, in words.
    fn place(&self) -> String {
        let processor = self.processor.as_deref().unwrap_or("an unnamed processor");
        format!("device {}, {} threads of {processor}", self.device, self.threads)
    }
}

impl Memory {
    /// Checks every number.
    fn check(&self) -> anyhow::Result<()> {
        for Training { shape, seconds } in &self.training {
            check_count("training.shape.sequences", shape.sequences)?;
            check_count("training.shape.steps", shape.steps)?;
            seconds.check("training.seconds")?;
        }
        for Step { rows, seconds } in &self.steps {
            check_count("steps.rows", *rows)?;
            seconds.check("steps.seconds")?;
        }
        Ok(())
    }
}

fn check_count(key: &str, value: i64) -> anyhow::Result<()> {
    anyhow::ensure!((1..=1 << 30).contains(&value), "{key} is {value}, allowed is 1 to {}", 1 << 30);
    Ok(())
}

impl Seconds {
    fn check(&self, key: &str) -> anyhow::Result<()> {
        let Self { mean, half_width } = *self;
        anyhow::ensure!((1e-9..=1e9).contains(&mean), "{key}.mean is {mean}, allowed is 1e-9 to 1e9 s");
        anyhow::ensure!((0.0..=1e9).contains(&half_width), "{key}.half_width is {half_width}, allowed is 0 to 1e9 s");
        Ok(())
    }
}

/// A figure for each batch shape and each number of rows.
///
/// # Errors
/// None that can be caused from outside.
pub fn throughput(found: &Throughput) -> anyhow::Result<Section> {
    let mut shapes: Vec<Shape> = Vec::new();
    let mut rows: Vec<i64> = Vec::new();
    for memory in &found.memories {
        shapes.extend(memory.training.iter().map(|training| training.shape));
        rows.extend(memory.steps.iter().map(|step| step.rows));
    }
    shapes.sort_by_key(|shape| (shape.steps, shape.sequences));
    shapes.dedup();
    rows.sort_unstable();
    rows.dedup();
    let mut figures = Vec::new();
    for shape in shapes {
        let of = |memory: &Memory| {
            let training = memory.training.iter().find(|training| training.shape == shape)?;
            rate(shape.sequences * shape.steps, &training.seconds)
        };
        let title = format!("Training, {} × {} steps", shape.sequences, shape.steps);
        figures.push(figure(found, format!("throughput-training-{}x{}", shape.sequences, shape.steps), title, of)?);
    }
    for rows in rows {
        let of = |memory: &Memory| rate(rows, &memory.steps.iter().find(|step| step.rows == rows)?.seconds);
        figures.push(figure(found, format!("throughput-step-{rows}"), format!("One step of {rows} rows"), of)?);
    }
    Ok(Section {
        title: "Throughput of the memories".into(),
        text: format!(
            "Environment steps a second, on a logarithmic scale; lines are 95% intervals. Training is forward, backward and \
             the optimiser's step. Measured with {}.",
            found.place()
        ),
        figures,
    })
}

fn figure(
    found: &Throughput,
    name: String,
    title: String,
    of: impl Fn(&Memory) -> Option<Bar>,
) -> anyhow::Result<Figure> {
    let rows: Vec<_> = found.memories.iter().map(|memory| (memory.paper_name.clone(), vec![of(memory)])).collect();
    let values: Vec<f64> = rows.iter().flat_map(|(_, bars)| bars).flatten().map(|bar| bar.value).collect();
    let ticks = decades(&values);
    let bars = Bars { title: title.clone(), rows, legend: Vec::new(), ticks, logarithmic: true };
    let caption = "Environment steps a second.".to_owned();
    Ok(Figure { name, title, caption, svg: bars.svg()? })
}

fn rate(steps: i64, seconds: &Seconds) -> Option<Bar> {
    let rate = |seconds: f64| steps as f64 / seconds;
    let value = rate(seconds.mean);
    // A time's interval may reach 0 where few were measured.
    let shortest = seconds.mean - seconds.half_width;
    let interval = (shortest > 0.0).then(|| (rate(seconds.mean + seconds.half_width), rate(shortest)));
    let digits = 10_f64.powf(value.log10().floor() - 1.0);
    value.is_finite().then(|| Bar { value, interval, text: short((value / digits).round() * digits) })
}

/// Powers of ten around `values`.
fn decades(values: &[f64]) -> Vec<f64> {
    let least = values.iter().copied().fold(f64::INFINITY, f64::min);
    let most = values.iter().copied().fold(1.0, f64::max);
    let (from, to) = (least.min(most).log10().floor() as i32, most.log10().ceil() as i32);
    (from..=to.max(from + 1)).map(|power| 10_f64.powi(power)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const JSON: &str = r#"{"device": "cpu", "processor": null, "threads": 2, "repeats": 3, "memories": [
        {"name": "gru", "paper_name": "GRU", "training":
            [{"shape": {"sequences": 8, "steps": 1000}, "seconds": {"mean": 0.5, "half_width": 0.25, "values": []}}],
         "steps": [{"rows": 16, "seconds": {"mean": 0.001, "half_width": 0.002, "values": []}}]}]}"#;

    #[test]
    fn rates_from_seconds() {
        let found: Throughput = serde_json::from_str(JSON).unwrap();
        let bar = rate(8000, &found.memories[0].training[0].seconds).unwrap();
        assert_eq!((bar.value, bar.text.as_str()), (16_000.0, "16k"));
        let (low, high) = bar.interval.unwrap();
        assert!((low - 8000.0 / 0.75).abs() < 1e-9 && (high - 32_000.0).abs() < 1e-9);
        assert!(rate(16, &found.memories[0].steps[0].seconds).unwrap().interval.is_none());
        assert_eq!(decades(&[15_000.0, 200.0]), [100.0, 1000.0, 10_000.0, 100_000.0]);
        assert_eq!(decades(&[]), [1.0, 10.0]);
        let section = throughput(&found).unwrap();
        let names: Vec<_> = section.figures.iter().map(|figure| figure.name.as_str()).collect();
        assert_eq!(names, ["throughput-training-8x1000", "throughput-step-16"]);
    }

    #[test]
    fn impossible_numbers_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x.json");
        let refused = |text: &str| {
            std::fs::write(&path, text).unwrap();
            let error = format!("{:#}", Throughput::read(&path).unwrap_err());
            error.strip_prefix(&format!("{}, GRU: ", path.display())).unwrap().to_owned()
        };
        let allowed = "allowed is 1 to 1073741824";
        assert_eq!(refused(&JSON.replace("\"rows\": 16", "\"rows\": 0")), format!("steps.rows is 0, {allowed}"));
        let many = refused(&JSON.replace("1000}", "1073741825}"));
        assert_eq!(many, format!("training.shape.steps is 1073741825, {allowed}"));
        let none = refused(&JSON.replace("\"sequences\": 8", "\"sequences\": -8"));
        assert_eq!(none, format!("training.shape.sequences is -8, {allowed}"));
        let short = refused(&JSON.replace("\"mean\": 0.5", "\"mean\": 1e-300"));
        assert!(short.starts_with("training.seconds.mean is 0.000"), "{short}");
        std::fs::write(&path, JSON).unwrap();
        assert!(Throughput::read(&path).is_ok());
    }

    #[test]
    fn other_files_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x.json");
        for text in ["{}", "not json", &JSON.replace("0.5", "0.0")] {
            std::fs::write(&path, text).unwrap();
            assert!(format!("{:#}", Throughput::read(&path).unwrap_err()).contains("x.json"));
        }
        assert!(Throughput::read(&dir.path().join("gone")).is_err());
    }
}
