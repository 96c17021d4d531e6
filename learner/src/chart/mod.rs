//! What all charts share: font, colours, lengths, labels.

use anyhow::anyhow;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::{FontFamily, FontStyle, register_font};

mod axes;
mod lines;

pub(crate) use axes::{Axis, axes};
pub(crate) use lines::{Lines, Series};

/// Name under which the font is known here, and a list of families where an SVG is viewed.
const FONT: FontFamily<'static> = FontFamily::Name("DejaVu Sans, Verdana, sans-serif");

/// Text and axes.
pub(crate) const TEXT: RGBColor = RGBColor(40, 40, 40);
/// Lines behind the figures.
pub(crate) const GRID: RGBColor = RGBColor(226, 226, 226);
/// Opacity of a band around a line.
pub(crate) const BAND: f64 = 0.18;

/// Colours that can be told apart, on white and on black.
pub(crate) const PALETTE: [RGBColor; 13] = [
    RGBColor(68, 119, 170),
    RGBColor(238, 102, 119),
    RGBColor(34, 136, 51),
    RGBColor(187, 160, 48),
    RGBColor(34, 170, 204),
    RGBColor(170, 51, 119),
    RGBColor(136, 136, 136),
    RGBColor(238, 119, 51),
    RGBColor(119, 85, 204),
    RGBColor(0, 153, 136),
    RGBColor(204, 51, 17),
    RGBColor(153, 170, 51),
    RGBColor(153, 102, 68),
];

/// A bitmap is drawn this much larger in both directions, and averaged: its lines are smooth.
pub(crate) const OVERSAMPLING: u32 = 3;

/// What differs between the backends.
#[derive(Clone, Copy)]
pub(crate) struct Pen {
    /// Every length is this much larger.
    pub(crate) scale: u32,
    /// Size, in the backend's measure, of a font of 1 em.
    em: f64,
    /// What has to be added, in ems, for text to stand where it should.
    drop: f64,
}

/// plotters divides sizes of fonts by 1.24 in an SVG.
pub(crate) const VECTOR: Pen = Pen { scale: 1, em: 1.24, drop: 0.0 };

/// For an SVG that is shown larger or smaller than its size: plotters rounds coordinates to whole numbers.
pub(crate) const FINE: Pen = Pen { scale: 4, ..VECTOR };

/// In a bitmap they are the distance from ascender to descender, 1.164 em here; and text comes out too high.
pub(crate) const BITMAP: Pen = Pen { scale: OVERSAMPLING, em: 1.164, drop: 0.2 };

impl Pen {
    /// A length.
    pub(crate) fn px(self, length: u32) -> u32 {
        length * self.scale
    }

    /// A coordinate.
    pub(crate) fn at(self, x: f64, y: f64) -> (i32, i32) {
        let place = |value: f64| (value * f64::from(self.scale)).round() as i32;
        (place(x), place(y))
    }

    /// Text of this size.
    pub(crate) fn text(self, size: u32) -> TextStyle<'static> {
        (FONT, f64::from(self.px(size)) * self.em).into_font().color(&TEXT)
    }

    /// The style by which widths of text of this size are measured: as a bitmap draws it.
    pub(crate) fn ruler(self, size: u32) -> TextStyle<'static> {
        Self { em: BITMAP.em, ..self }.text(size)
    }

    /// How much lower than wanted text of this size has to be drawn.
    pub(crate) fn drop(self, size: u32) -> i32 {
        (f64::from(self.px(size)) * self.drop) as i32
    }
}

/// Where an SVG is drawn.
pub(crate) type SvgArea<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// Makes the font known; to be called before anything is drawn.
pub(crate) fn register() -> anyhow::Result<()> {
    register_font(FONT.as_str(), FontStyle::Normal, dejavu::sans::regular()).map_err(|_| anyhow!("invalid font"))
}

/// An SVG of `size` (before the pen's scale), drawn by `draw` on white.
pub(crate) fn svg(
    size: (u32, u32),
    pen: Pen,
    draw: impl FnOnce(&SvgArea<'_>) -> anyhow::Result<()>,
) -> anyhow::Result<String> {
    register()?;
    let mut text = String::new();
    {
        let area = SVGBackend::with_string(&mut text, (pen.px(size.0), pen.px(size.1))).into_drawing_area();
        area.fill(&WHITE)?;
        draw(&area)?;
        area.present()?;
    }
    Ok(text)
}

/// A number as a label of an axis: 2000000 is 2M, 0.30000000000000004 is 0.3.
pub(crate) fn short(value: f64) -> String {
    let (value, unit) = match value.abs() {
        1e9.. => (value / 1e9, "G"),
        1e6.. => (value / 1e6, "M"),
        1e3.. => (value / 1e3, "k"),
        _ => (value, ""),
    };
    let rounded = (value * 1e4).round() / 1e4;
    // No negative zero.
    format!("{}{unit}", rounded + 0.0)
}

/// A range that contains all values, with room around them, also around a constant.
pub(crate) fn value_range(values: impl Iterator<Item = f64> + Clone) -> std::ops::Range<f64> {
    let (least, most) = (values.clone().fold(f64::INFINITY, f64::min), values.fold(f64::NEG_INFINITY, f64::max));
    if least > most {
        return -1.0..1.0;
    }
    let room = if most > least { 0.05 * (most - least) } else { 0.5_f64.max(0.05 * most.abs()) };
    least - room..most + room
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_are_short() {
        let labels = [0.0, -1e-9, 0.1 + 0.2, -0.75, 65_536.0, 2e6, 1.5e7, 3e9].map(short);
        assert_eq!(labels, ["0", "0", "0.3", "-0.75", "65.536k", "2M", "15M", "3G"]);
    }

    #[test]
    fn ranges_have_room() {
        assert_eq!(value_range([0.0, 10.0].into_iter()), -0.5..10.5);
        assert_eq!(value_range([2.0].into_iter()), 1.5..2.5);
        assert_eq!(value_range(std::iter::empty()), -1.0..1.0);
    }
}
