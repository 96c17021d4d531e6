//! Every memory's first weights are drawn as upstream's are (PyTorch's defaults, unless the memory has its own).

mod common;

use std::f64::consts::PI;

use common::*;
use tch::{Kind, Tensor};

const INPUTS: i64 = 128;

#[derive(Clone, Copy)]
enum Drawn {
    /// Between these.
    Uniform(f64, f64),
    /// Around 0, with this standard deviation.
    Normal(f64),
    All(f64),
    /// pi n along the last dimension.
    Harmonics,
    /// 1 as a complex number.
    ComplexOne,
}
use Drawn::{All, ComplexOne, Harmonics, Normal, Uniform};

/// Within `+-1/sqrt(fan_in)`.
fn default(fan_in: f64) -> Drawn {
    Uniform(-1.0 / fan_in.sqrt(), 1.0 / fan_in.sqrt())
}

/// Within `+-sqrt(3 / fan_in)`.
fn wide(fan_in: f64) -> Drawn {
    Uniform(-(3.0 / fan_in).sqrt(), (3.0 / fan_in).sqrt())
}

/// Xavier's, between 256 units and as many.
fn xavier(other: f64) -> Drawn {
    Normal((2.0 / (256.0 + other)).sqrt())
}

/// Reference 4.3: memory, parameter (all whose name starts so), distribution.
fn table() -> Vec<(&'static str, &'static str, Drawn)> {
    let mut table = vec![
        ("indrnn", "weight_input", default(128.0)),
        ("indrnn", "weight_between", default(256.0)),
        ("indrnn", "first_bias_input", default(128.0)),
        ("indrnn", "second_bias_input", default(256.0)),
        ("indrnn", "first_recurrent", Uniform(0.0, 1.0)),
        ("indrnn", "second_recurrent", Uniform(0.0, 1.0)),
        ("indrnn", "first_bias_state", Uniform(0.0, 1.0)),
        ("indrnn", "second_bias_state", Uniform(0.0, 1.0)),
        ("lmu", "encoder_input", wide(128.0)),
        ("lmu", "encoder_state", wide(256.0)),
        ("lmu", "encoder_memory", All(0.0)),
        ("lmu", "weight_input", xavier(128.0)),
        ("lmu", "weight_state", xavier(256.0)),
        ("lmu", "weight_memory", xavier(256.0)),
        ("frame_stack", "frame", default(128.0)),
        ("frame_stack", "first", default(256.0)),
        ("frame_stack", "second", default(256.0)),
        ("tcn", "", default(512.0)),
        ("s4d", "input", default(128.0)),
        ("s4d", "log_decay", All(0.5_f64.ln())),
        ("s4d", "frequency", Harmonics),
        ("s4d", "state_input", ComplexOne),
        ("s4d", "state_output", Normal(0.5_f64.sqrt())),
        ("s4d", "skip", Normal(1.0)),
        ("s4d", "log_step", Uniform(0.001_f64.ln(), 0.1_f64.ln())),
        ("s4d", "output", default(256.0)),
        ("dnc", "weight_output", default(320.0)),
        ("dnc", "bias_output", default(320.0)),
    ];
    let same = ["weight_input", "weight_state", "bias_input", "bias_state"];
    table.extend(
        ["elman", "gru", "lstm", "dnc"].iter().flat_map(|memory| same.map(|name| (*memory, name, default(256.0)))),
    );
    table.extend(["weight_interface", "bias_interface"].map(|name| ("dnc", name, default(256.0))));
    for memory in ["mlp", "pos_mlp"] {
        table.extend([(memory, "first", default(128.0)), (memory, "second", default(256.0))]);
    }
    for (memory, keys) in [("fart", 15.0), ("fwp", 16.0)] {
        table.extend([(memory, "norm_weight", All(1.0)), (memory, "norm_bias", All(0.0))]);
        table.extend(["key", "query", "value", "shortcut"].map(|name| (memory, name, default(128.0))));
        table.extend(["first", "second", "output"].map(|name| (memory, name, default(keys))));
    }
    table
}

#[test]
fn first_weights_are_the_references() {
    tch::manual_seed(4);
    let table = table();
    for memory_name in names() {
        let (_, parameters) = memory(memory_name, INPUTS, "");
        for (name, values) in &parameters {
            let of_this = table.iter().filter(|(memory, start, _)| *memory == memory_name && name.starts_with(start));
            let [(.., drawn)] = of_this.collect::<Vec<_>>()[..] else {
                panic!("{memory_name}: {name} is not in the table once")
            };
            assert_drawn(&values.to_kind(Kind::Double), *drawn, &format!("{memory_name}: {name}"));
        }
    }
}

fn assert_drawn(values: &Tensor, drawn: Drawn, what: &str) {
    let count = values.numel() as f64;
    let number = |x: Tensor| x.double_value(&[]);
    let (mean, least, most) = (number(values.mean(None::<Kind>)), number(values.min()), number(values.max()));
    // Means and deviations within five standard errors.
    match drawn {
        All(value) => assert!((least - value).abs() < 1e-6 && (most - value).abs() < 1e-6, "{what}: {least} to {most}"),
        Uniform(low, high) => {
            let deviation = (high - low) / 12.0_f64.sqrt();
            assert!(least >= low - 1e-6 && most <= high + 1e-6, "{what}: {least} to {most}");
            assert!((mean - f64::midpoint(low, high)).abs() <= 5.0 * deviation / count.sqrt(), "{what}: mean {mean}");
            // That all of n numbers miss the outer twentieth at one end has the probability 0.95^n.
            let margin = 0.05 * (high - low);
            assert!(count < 200.0 || (least < low + margin && most > high - margin), "{what}: {least} to {most}");
        }
        Normal(deviation) => {
            assert!(mean.abs() <= 5.0 * deviation / count.sqrt(), "{what}: mean {mean}");
            let found = number(values.square().mean(None::<Kind>)).sqrt();
            assert!((found / deviation - 1.0).abs() <= 5.0 / (2.0 * count).sqrt(), "{what}: deviation {found}");
        }
        Harmonics => {
            let expected = Tensor::arange(*values.size().last().unwrap(), (Kind::Double, values.device())) * PI;
            assert!(number((values - expected).abs().max()) < 1e-5, "{what}");
        }
        ComplexOne => {
            let expected = Tensor::from_slice(&[1.0, 0.0]);
            assert!(number((values - expected).abs().max()) < 1e-9, "{what}");
        }
    }
}
