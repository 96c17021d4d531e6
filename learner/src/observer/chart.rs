//! The picture of a learning curve.

use std::error::Error;
use std::path::Path;

use plotters::coord::Shift;
use plotters::prelude::*;

use super::EpochMetrics;
use crate::chart::{BAND, BITMAP, GRID, OVERSAMPLING, Pen, TEXT, VECTOR, register, short, value_range};

/// Width and height of the picture.
const SIZE: (u32, u32) = (1200, 720);

const MEAN: RGBColor = RGBColor(31, 90, 166);
const MMER: RGBColor = RGBColor(213, 94, 0);

/// The chart as an SVG.
pub(super) fn svg(title: &str, rows: &[EpochMetrics]) -> anyhow::Result<String> {
    let mut text = String::new();
    chart(&SVGBackend::with_string(&mut text, SIZE).into_drawing_area(), VECTOR, title, rows)?;
    Ok(text)
}

/// Writes the chart to the PNG file `path`.
pub(super) fn png(path: &Path, title: &str, rows: &[EpochMetrics]) -> anyhow::Result<()> {
    let pixels = pixels(title, rows)?;
    let mut backend = BitMapBackend::new(path, SIZE);
    backend.blit_bitmap((0, 0), SIZE, &pixels)?;
    backend.present()?;
    Ok(())
}

/// The chart in red, green and blue bytes, row by row.
fn pixels(title: &str, rows: &[EpochMetrics]) -> anyhow::Result<Vec<u8>> {
    let (width, height) = (SIZE.0 * OVERSAMPLING, SIZE.1 * OVERSAMPLING);
    let mut fine = vec![0; (width * height * 3) as usize];
    chart(&BitMapBackend::with_buffer(&mut fine, (width, height)).into_drawing_area(), BITMAP, title, rows)?;

    let (side, line) = (OVERSAMPLING as usize, width as usize * 3);
    let mean = |i: usize| {
        let (y, x, colour) = (i / 3 / SIZE.0 as usize, i / 3 % SIZE.0 as usize, i % 3);
        let first = y * side * line + x * side * 3 + colour;
        let sum: usize = (0..side * side).map(|k| fine[first + k / side * line + k % side * 3] as usize).sum();
        (sum / (side * side)) as u8
    };
    Ok((0..(SIZE.0 * SIZE.1 * 3) as usize).map(mean).collect())
}

fn chart<B: DrawingBackend>(
    area: &DrawingArea<B, Shift>,
    pen: Pen,
    title: &str,
    rows: &[EpochMetrics],
) -> anyhow::Result<()>
where
    B::ErrorType: Error + Send + Sync + 'static,
{
    register()?;
    let px = |length| pen.px(length);
    area.fill(&WHITE)?;
    let (head, plot) = area.split_vertically(px(84));
    let best = rows.last().map_or(f64::NAN, |row| row.mmer);
    draw_head(&head, pen, title, &format!("MMER, the largest mean so far: {best:.3}"))?;

    let points = |value: fn(&EpochMetrics) -> f64| -> Vec<(f64, f64)> {
        rows.iter().map(|row| (row.env_steps as f64, value(row))).filter(|(_, y)| y.is_finite()).collect()
    };
    let (mean, mmer) = (points(|row| row.mean_return), points(|row| row.mmer));
    let (least, most) = (points(|row| row.min_return), points(|row| row.max_return));
    let steps = rows.last().map_or(1.0, |row| row.env_steps as f64) * if rows.len() == 1 { 2.0 } else { 1.01 };

    let values = [&mean, &least, &most, &mmer].into_iter().flatten().map(|(_, y)| *y);
    let mut chart = ChartBuilder::on(&plot)
        .margin_right(px(40))
        .margin_bottom(px(12))
        .margin_left(px(16))
        .x_label_area_size(px(58))
        .y_label_area_size(px(84))
        .build_cartesian_2d(0.0..steps, value_range(values))?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(GRID.stroke_width(px(1)))
        .axis_style(TEXT.stroke_width(px(1)))
        .set_all_tick_mark_size(px(5))
        .label_style(pen.text(15))
        .axis_desc_style(pen.text(17))
        .x_desc("environment steps")
        .y_desc("return per episode")
        .x_labels(12)
        .y_labels(12)
        .y_label_offset(pen.drop(15))
        .x_label_formatter(&|x| short(*x))
        .y_label_formatter(&|y| short(*y))
        .draw()?;

    let band = MEAN.mix(BAND);
    if rows.len() == 1 {
        let ends = least.iter().chain(&most).copied();
        chart.draw_series([PathElement::new(ends.collect::<Vec<_>>(), band.stroke_width(px(10)))])?;
    } else {
        let outline = least.iter().chain(most.iter().rev()).copied();
        chart.draw_series([Polygon::new(outline.collect::<Vec<_>>(), band.filled())])?;
    }
    chart.draw_series([PathElement::new(mmer, MMER.stroke_width(px(4)))])?;
    chart.draw_series([PathElement::new(mean.clone(), MEAN.stroke_width(px(2)))])?;
    if rows.len() <= 40 {
        chart.draw_series(mean.into_iter().map(|point| Circle::new(point, px(4), MEAN.filled())))?;
    }
    area.present()?;
    Ok(())
}

/// Title and legend.
fn draw_head<B: DrawingBackend>(area: &DrawingArea<B, Shift>, pen: Pen, title: &str, mmer: &str) -> anyhow::Result<()>
where
    B::ErrorType: Error + Send + Sync + 'static,
{
    let px = |length: u32| pen.px(length) as i32;
    area.draw_text(title, &pen.text(24), (px(100), px(16) + pen.drop(24)))?;
    let font = pen.text(15);
    let ruler = pen.ruler(15);
    let entries = [
        ("mean of an epoch's episodes", MEAN.filled(), 1),
        ("smallest to largest", MEAN.mix(BAND).filled(), 7),
        (mmer, MMER.filled(), 2),
    ];
    let (mut x, middle) = (px(100), px(63));
    for (text, style, half_height) in entries {
        let corners = [(x, middle - px(half_height)), (x + px(32), middle + px(half_height))];
        area.draw(&Rectangle::new(corners, style))?;
        x += px(42);
        area.draw_text(text, &font, (x, middle - px(6) + pen.drop(15)))?;
        x += area.estimate_text_size(text, &ruler)?.0 as i32 + px(40);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::samples::report;
    use super::*;

    fn rows(epochs: u64) -> Vec<EpochMetrics> {
        (0..epochs).map(|epoch| report(epoch).metrics).collect()
    }

    /// The points of the last element `<name ... points="...">`.
    fn points(svg: &str, name: &str) -> Vec<(f64, f64)> {
        let element = svg.split(&format!("<{name} ")).last().unwrap();
        let list = element.split("points=\"").nth(1).unwrap().split('"').next().unwrap();
        let point = |text: &str| text.split_once(',').map(|(x, y)| (x.parse().unwrap(), y.parse().unwrap())).unwrap();
        list.split_whitespace().map(point).collect()
    }

    #[test]
    fn svg_has_all_epochs_and_labels() {
        let svg = svg("GRU on RepeatPreviousEasy, seed 0", &rows(5)).unwrap();
        for text in ["GRU on RepeatPreviousEasy, seed 0", "environment steps", "return per episode", "so far: 0.500"] {
            assert!(svg.contains(text), "no `{text}`");
        }
        let (band, line) = (points(&svg, "polygon"), points(&svg, "polyline"));
        assert_eq!((band.len(), line.len()), (10, 5));
        // The smallest returns from left to right, below the mean, then the largest back, as far above it.
        for (i, (_, y)) in line.iter().enumerate() {
            let (below, above) = (band[i].1 - y, y - band[9 - i].1);
            assert!(below > 50.0 && (below - above).abs() <= 2.0, "{below} {above}");
        }
        // Both coordinates of the invented run are linear.
        for (i, (x, y)) in line.iter().enumerate() {
            let along = |from: f64, to: f64| from + (to - from) * i as f64 / 4.0;
            assert!((x - along(line[0].0, line[4].0)).abs() <= 1.0 && (y - along(line[0].1, line[4].1)).abs() <= 1.0);
        }
        assert!(line[4].0 > 1100.0 && line[4].1 < line[0].1 - 100.0, "{line:?}");
    }

    #[test]
    fn bitmap_has_lines_and_text() {
        let pixels = pixels("Title", &rows(5)).unwrap();
        let is = |i: usize, colour: RGBColor| pixels[i * 3..i * 3 + 3] == [colour.0, colour.1, colour.2];
        let count = |colour, from: usize, to: usize| (from * 1200..to * 1200).filter(|i| is(*i, colour)).count();
        assert!(count(TEXT, 0, 50) > 20, "no title");
        assert!(count(MEAN, 84, 650) > 500, "no curve");
        assert!(count(WHITE, 0, 720) > 400_000, "too full");
    }

    #[test]
    fn degenerate_runs_are_drawn() {
        let mut rows = rows(3);
        assert!(svg("one", &rows[..1]).is_ok());
        for row in &mut rows {
            (row.mean_return, row.min_return, row.max_return, row.mmer) = (0.0, 0.0, 0.0, 0.0);
        }
        let line = points(&svg("constant", &rows).unwrap(), "polyline");
        assert!(
            line.iter().all(|point| point.1.to_bits() == line[0].1.to_bits()) && (300.0..450.0).contains(&line[0].1)
        );
        rows[1].mean_return = f64::NAN;
        rows[2].max_return = f64::INFINITY;
        assert!(!svg("not finite", &rows).unwrap().contains("NaN"));
        for row in &mut rows {
            (row.mean_return, row.min_return, row.max_return, row.mmer) = (f64::NAN, f64::NAN, f64::NAN, f64::NAN);
        }
        assert!(svg("not a number at all", &rows).is_ok());
    }
}
