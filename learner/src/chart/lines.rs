//! Curves in one pair of axes, with bands and a legend.

use plotters::coord::ranged1d::{KeyPointHint, Ranged};
use plotters::prelude::*;

use super::{Axis, BAND, Pen, SvgArea, axes, value_range};

/// A chart of curves.
pub(crate) struct Lines {
    /// Above it.
    pub(crate) title: String,
    /// What the horizontal axis shows.
    pub(crate) x_desc: String,
    /// What the vertical axis shows.
    pub(crate) y_desc: String,
    /// The curves, drawn one over the other.
    pub(crate) series: Vec<Series>,
    /// Columns of the legend below it.
    pub(crate) columns: u32,
}

/// A curve.
pub(crate) struct Series {
    /// Its name in the legend.
    pub(crate) name: String,
    /// Its colour.
    pub(crate) colour: RGBColor,
    /// Its points, from left to right.
    pub(crate) points: Vec<(f64, f64)>,
    /// Around it, from left to right: x, lower and upper end.
    pub(crate) band: Vec<(f64, f64, f64)>,
}

/// Lengths, before the pen's scale.
const HEAD: u32 = 26;
const PLOT: u32 = 220;
const LEGEND_ROW: u32 = 17;

impl Lines {
    /// The height of the chart.
    pub(crate) fn height(&self) -> u32 {
        HEAD + PLOT + self.rows() * LEGEND_ROW + 8
    }

    /// Draws it on `area`, which must have its [`height`](Self::height).
    pub(crate) fn draw(&self, area: &SvgArea<'_>, pen: Pen) -> anyhow::Result<()> {
        area.draw_text(&self.title, &pen.text(13), pen.at(8.0, 8.0))?;
        let (_, rest) = area.split_vertically(pen.px(HEAD));
        let (plot, legend) = rest.split_vertically(pen.px(PLOT));
        self.draw_plot(&plot, pen)?;
        self.draw_legend(&legend, pen)
    }

    fn draw_plot(&self, area: &SvgArea<'_>, pen: Pen) -> anyhow::Result<()> {
        let xs = self.series.iter().flat_map(|series| series.points.iter().map(|point| point.0));
        let end = xs.filter(|x| x.is_finite()).fold(0.0, f64::max);
        let end = if end > 0.0 { end } else { 1.0 };
        let inner = self.series.iter().flat_map(|series| series.points.iter().map(|point| point.1));
        let bands = self.series.iter().flat_map(|series| series.band.iter().flat_map(|(_, low, high)| [*low, *high]));
        let px = |length| pen.px(length);
        let x = Axis { range: FewTicks(0.0..end * 1.01), desc: &self.x_desc, labels: 5 };
        let y = Axis { range: value_range(inner.chain(bands)), desc: &self.y_desc, labels: 7 };
        let mut chart = axes(area, pen, x, y)?;
        for Series { band, colour, .. } in &self.series {
            if band.len() > 1 {
                let lower = band.iter().map(|(x, low, _)| (*x, *low));
                let upper = band.iter().rev().map(|(x, _, high)| (*x, *high));
                chart.draw_series([Polygon::new(lower.chain(upper).collect::<Vec<_>>(), colour.mix(BAND).filled())])?;
            }
        }
        for Series { points, colour, .. } in &self.series {
            if let [only] = points[..] {
                chart.draw_series([Circle::new(only, px(2), colour.filled())])?;
            } else {
                chart.draw_series([PathElement::new(points.clone(), colour.stroke_width(px(2)))])?;
            }
        }
        Ok(())
    }

    fn draw_legend(&self, area: &SvgArea<'_>, pen: Pen) -> anyhow::Result<()> {
        let width = f64::from(area.dim_in_pixel().0 / pen.scale - 16) / f64::from(self.columns);
        for (i, series) in self.series.iter().enumerate() {
            let (column, row) = (i as u32 % self.columns, i as u32 / self.columns);
            let (x, y) = (8.0 + f64::from(column) * width, 5.0 + f64::from(row * LEGEND_ROW));
            area.draw(&Rectangle::new([pen.at(x, y + 5.0), pen.at(x + 12.0, y + 9.0)], series.colour.filled()))?;
            area.draw_text(&series.name, &pen.text(11), pen.at(x + 16.0, y))?;
        }
        Ok(())
    }

    fn rows(&self) -> u32 {
        (self.series.len() as u32).div_ceil(self.columns)
    }
}

/// An axis from 0 with so few labels that they do not touch on a small chart.
struct FewTicks(std::ops::Range<f64>);

impl Ranged for FewTicks {
    type FormatOption = plotters::coord::ranged1d::DefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, limit: (i32, i32)) -> i32 {
        let share = (value - self.0.start) / (self.0.end - self.0.start);
        limit.0 + (share * f64::from(limit.1 - limit.0)).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, _: Hint) -> Vec<f64> {
        let step = step(self.0.end / 4.0);
        (0..=4).map(|i| f64::from(i) * step).filter(|tick| *tick <= self.0.end).collect()
    }

    fn range(&self) -> std::ops::Range<f64> {
        self.0.clone()
    }
}

/// The smallest of 1, 2, 5, 10, 20, ... and their tenths that is at least `least`.
fn step(least: f64) -> f64 {
    let power = 10_f64.powf(least.log10().floor());
    [1.0, 2.0, 5.0].into_iter().map(|digit| digit * power).find(|step| *step >= least).unwrap_or(10.0 * power)
}

#[cfg(test)]
mod tests {
    use super::super::{FINE, svg};
    use super::*;

    #[test]
    fn steps_are_round() {
        for (least, expected) in [(0.3, 0.5), (1.0, 1.0), (3.7, 5.0), (4000.0, 5000.0), (7e6, 1e7)] {
            assert!((step(least) / expected - 1.0_f64).abs() < 1e-12, "{least}: {}", step(least));
        }
        let ticks = FewTicks(0.0..150_000.0 * 1.01).key_points(0);
        assert_eq!(ticks, [0.0, 50_000.0, 100_000.0, 150_000.0]);
    }

    #[test]
    fn curves_bands_and_names_are_drawn() {
        let series =
            |name: &str, points: Vec<(f64, f64)>, band| Series { name: name.into(), colour: BLUE, points, band };
        let band = vec![(0.0, 0.0, 0.5), (10.0, 0.5, 1.5)];
        let lines = Lines {
            title: "a < b".into(),
            x_desc: "steps".into(),
            y_desc: "return".into(),
            series: vec![series("one", vec![(0.0, 0.25), (10.0, 1.0)], band), series("two", vec![(5.0, 0.5)], vec![])],
            columns: 2,
        };
        let text = svg((340, lines.height()), FINE, |area| lines.draw(area, FINE)).unwrap();
        for expected in ["a &lt; b", "one", "two", "<polygon", "<polyline", "<circle"] {
            assert!(text.contains(expected), "no `{expected}`");
        }
        let empty = Lines { series: vec![], ..lines };
        assert!(svg((340, empty.height()), FINE, |area| empty.draw(area, FINE)).is_ok());
    }
}
