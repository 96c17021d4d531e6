//! Positional encoding: mixes the time step into the memory's input (Vaswani et al., 2017, section 3.5, with POPGym's base and
//! learned weight).
//!
//! ```text
//! u' = (1 - s) u + s PE[t]          s learned, kept within [0, 1], 0.5 at first; t the step within the episode
//! PE[t, 2i] = sin(t w_i)    PE[t, 2i + 1] = cos(t w_i)    w_i = 1024^(-2i / width)
//! ```

use tch::nn::{Init, Path};
use tch::{Kind, Tensor};

/// Base of the wavelengths: POPGym's longest sequence (Vaswani et al. have 10,000).
const BASE: f64 = 1024.0;

/// The table and the weight of its mixture.
#[derive(Debug)]
pub(crate) struct PositionalEncoding {
    scale: Tensor,
    /// `[steps, width]`, not learned.
    table: Tensor,
}

impl PositionalEncoding {
    /// For vectors of an even `width` in episodes of at most `max_steps` steps.
    pub(crate) fn new(path: &Path<'_>, width: i64, max_steps: i64) -> Self {
        let scale = path.var("scale", &[1], Init::Const(0.5));
        // An episode of n steps has n + 1 observations.
        Self { scale, table: table(max_steps + 1, width, BASE).to_device(path.device()) }
    }

    /// `u [rows, width]` at the time steps `t [rows]` (any kind of number) to `u'`.
    pub(crate) fn mix(&self, u: &Tensor, t: &Tensor) -> Tensor {
        let t = t.to_kind(Kind::Int64).clamp_max(self.table.size()[0] - 1);
        let encoding = self.table.index_select(0, &t).to_kind(u.kind());
        // Outside [0, 1] a clamp's gradient is zero, so that s would never come back; 0.5 is the first, and Adam's steps are
        // small: it stays as upstream has it.
        u.lerp_tensor(&encoding, &self.scale.clamp(0.0, 1.0))
    }
}

/// `PE[t, i]`, f32 `[steps, width]`, computed in f64.
fn table(steps: i64, width: i64, base: f64) -> Tensor {
    let row = |t: i64| {
        (0..width).map(move |i| {
            let angle = t as f64 * base.powf(-((i - i % 2) as f64) / width as f64);
            (if i % 2 == 0 { angle.sin() } else { angle.cos() }) as f32
        })
    };
    let numbers: Vec<f32> = (0..steps).flat_map(row).collect();
    Tensor::from_slice(&numbers).view([steps, width])
}

#[cfg(test)]
mod tests {
    use super::{BASE, table};

    /// Reference 4.1.
    #[test]
    fn check_values() {
        let pe = table(1024, 128, BASE);
        let at = |t, i| pe.double_value(&[t, i]);
        let near = |found: f64, expected: f64| assert!((found - expected).abs() < 1e-7, "{found}, not {expected}");
        near(at(1, 0), 0.841_470_98);
        near(at(1023, 126), 0.897_160_52);
        // w_1 and w_63, from the angles of the first step.
        near(at(1, 2).asin(), 0.897_354_54);
        near(at(1, 126).asin(), 0.001_088_27);
        near(at(0, 0), 0.0);
        near(at(0, 127), 1.0);
    }

    /// The recorded table; see the fixtures' description in `tests/fixtures.rs`.
    #[test]
    fn recorded_table() {
        let file: serde_json::Value = serde_json::from_str(include_str!("../tests/fixtures/memories.json")).unwrap();
        let recorded = file["tables"]["positional_encoding_16x8"].as_array().unwrap();
        let pe = table(16, 8, 16.0);
        for (t, row) in recorded.iter().enumerate() {
            for (i, expected) in row.as_array().unwrap().iter().enumerate() {
                let found = pe.double_value(&[t as i64, i as i64]);
                assert!((found - expected.as_f64().unwrap()).abs() < 1e-6, "PE[{t}, {i}]");
            }
        }
    }
}
