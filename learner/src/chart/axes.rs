//! A pair of axes with numbers on both.

use plotters::coord::ranged1d::{AsRangedCoord, Ranged, ValueFormatter};
use plotters::prelude::*;

use super::{GRID, Pen, SvgArea, TEXT, short};

/// One of the two.
pub(crate) struct Axis<'a, R> {
    /// What it spans.
    pub(crate) range: R,
    /// What it shows.
    pub(crate) desc: &'a str,
    /// About how many of its numbers are written.
    pub(crate) labels: usize,
}

/// What can be drawn into, in coordinates of both axes.
type Plot<'a, 'b, X, Y> = ChartContext<
    'a,
    SVGBackend<'b>,
    Cartesian2d<<X as AsRangedCoord>::CoordDescType, <Y as AsRangedCoord>::CoordDescType>,
>;

/// Draws the axes, and lines behind the figures, on `area`.
pub(crate) fn axes<'a, 'b, X, Y>(
    area: &'a SvgArea<'b>,
    pen: Pen,
    x: Axis<'_, X>,
    y: Axis<'_, Y>,
) -> anyhow::Result<Plot<'a, 'b, X, Y>>
where
    X: AsRangedCoord<Value = f64>,
    Y: AsRangedCoord<Value = f64>,
    X::CoordDescType: Ranged<ValueType = f64> + ValueFormatter<f64>,
    Y::CoordDescType: Ranged<ValueType = f64> + ValueFormatter<f64>,
{
    let px = |length| pen.px(length);
    let mut chart = ChartBuilder::on(area)
        .margin_right(px(16))
        .margin_top(px(4))
        .x_label_area_size(px(38))
        .y_label_area_size(px(60))
        .build_cartesian_2d(x.range, y.range)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(GRID.stroke_width(px(1)))
        .axis_style(TEXT.stroke_width(px(1)))
        .set_all_tick_mark_size(px(3))
        .label_style(pen.text(11))
        .axis_desc_style(pen.text(11))
        .x_desc(x.desc)
        .y_desc(y.desc)
        .x_labels(x.labels)
        .y_labels(y.labels)
        .x_label_formatter(&|x| short(*x))
        .y_label_formatter(&|y| short(*y))
        .draw()?;
    Ok(chart)
}
