//! The picture: times of all memories as horizontal bars, one panel for each kind of work.

use std::error::Error;
use std::path::Path;

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters::style::{FontFamily, FontStyle, register_font};

use crate::arithmetic::Sample;
use crate::report::{Report, digits};

/// Name under which the font is known here, and a list of families where the SVG is viewed.
const FONT: FontFamily<'static> = FontFamily::Name("DejaVu Sans, Verdana, sans-serif");

const BAR: RGBColor = RGBColor(120, 160, 205);
const INTERVAL: RGBColor = RGBColor(20, 50, 95);
const TEXT: RGBColor = RGBColor(40, 40, 40);
const GRID: RGBColor = RGBColor(226, 226, 226);

/// Lengths, in pixels of the SVG.
const NAMES: i32 = 110;
const PANEL: i32 = 340;
/// Within a panel, for the number beside the longest bar.
const NUMBER: i32 = 60;
const GAP: i32 = 20;
const HEAD: i32 = 96;
const ROW: i32 = 28;
const FOOT: i32 = 64;

/// One kind of work.
struct Panel {
    title: String,
    unit: &'static str,
    /// For each memory, in `unit`.
    bars: Vec<Bar>,
}

struct Bar {
    mean: f64,
    half_width: f64,
}

/// What differs between the backends: scale of all lengths, and the size of a font of one em in the backend's measure.
#[derive(Clone, Copy)]
struct Pen {
    scale: i32,
    em: f64,
}

/// plotters divides sizes of fonts by 1.24 in an SVG.
const VECTOR: Pen = Pen { scale: 1, em: 1.24 };

/// In a bitmap they are the distance from ascender to descender, 1.164 em here.
const BITMAP: Pen = Pen { scale: 2, em: 1.164 };

impl Pen {
    fn px(self, length: i32) -> i32 {
        length * self.scale
    }

    fn at(self, x: i32, y: i32) -> (i32, i32) {
        (self.px(x), self.px(y))
    }

    fn text(self, size: i32, side: HPos) -> TextStyle<'static> {
        let font = (FONT, f64::from(self.px(size)) * self.em).into_font();
        font.color(&TEXT).pos(Pos::new(side, VPos::Center))
    }
}

/// Draws the report's own figures to an SVG or PNG file.
pub(crate) fn draw(path: &Path, report: &Report) -> Result<(), Box<dyn Error>> {
    register_font(FONT.as_str(), FontStyle::Normal, dejavu::sans::regular()).map_err(|_| "invalid font")?;
    let (names, panels) = (names(report), panels(report));
    let width = NAMES + (PANEL + GAP) * panels.len() as i32;
    let height = HEAD + ROW * names.len() as i32 + FOOT;
    let size = |pen: Pen| (pen.px(width) as u32, pen.px(height) as u32);
    let title = format!(
        "Memories on {}, {}",
        if report.device == "cuda" { "CUDA" } else { "the CPU" },
        format_args!("input {}, mean of {} and its 95% interval", report.input, report.repeats)
    );
    if path.extension().is_some_and(|extension| extension == "svg") {
        let area = SVGBackend::new(path, size(VECTOR)).into_drawing_area();
        chart(&area, VECTOR, &title, &names, &panels)
    } else {
        let area = BitMapBackend::new(path, size(BITMAP)).into_drawing_area();
        chart(&area, BITMAP, &title, &names, &panels)
    }
}

fn names(report: &Report) -> Vec<String> {
    report.memories.iter().map(|figures| figures.paper_name.clone()).collect()
}

fn panels(report: &Report) -> Vec<Panel> {
    let first = report.memories.first();
    let bars = |get: &dyn Fn(usize) -> Sample, scale: f64| -> Vec<Bar> {
        let bar = |sample: Sample| Bar { mean: sample.mean * scale, half_width: sample.half_width * scale };
        (0..report.memories.len()).map(|i| bar(get(i))).collect()
    };
    let training = first.map_or(&[][..], |figures| &figures.training).iter().enumerate().map(|(k, training)| Panel {
        title: format!("Training step, {}, {} threads", training.shape, report.threads),
        unit: "ms",
        bars: bars(&|i| report.memories[i].training[k].seconds.clone(), 1e3),
    });
    let steps = first.map_or(&[][..], |figures| &figures.steps).iter().enumerate().map(|(k, step)| Panel {
        title: format!("One step of {} row{}", step.rows, if step.rows == 1 { "" } else { "s" }),
        unit: "us",
        bars: bars(&|i| report.memories[i].steps[k].seconds.clone(), 1e6),
    });
    training.chain(steps).collect()
}

fn chart<B>(
    area: &DrawingArea<B, Shift>,
    pen: Pen,
    title: &str,
    names: &[String],
    panels: &[Panel],
) -> Result<(), Box<dyn Error>>
where
    B: DrawingBackend,
    B::ErrorType: 'static,
{
    area.fill(&WHITE)?;
    area.draw_text(title, &pen.text(18, HPos::Left), pen.at(16, 26))?;
    for (i, name) in names.iter().enumerate() {
        area.draw_text(name, &pen.text(14, HPos::Right), pen.at(NAMES - 10, middle(i)))?;
    }
    for (i, panel) in panels.iter().enumerate() {
        draw_panel(area, pen, NAMES + (PANEL + GAP) * i as i32, panel)?;
    }
    area.present()?;
    Ok(())
}

/// Where the bar of memory `i` lies.
fn middle(i: usize) -> i32 {
    HEAD + ROW * i as i32 + ROW / 2
}

fn draw_panel<B>(area: &DrawingArea<B, Shift>, pen: Pen, left: i32, panel: &Panel) -> Result<(), Box<dyn Error>>
where
    B: DrawingBackend,
    B::ErrorType: 'static,
{
    let bottom = HEAD + ROW * panel.bars.len() as i32;
    // Times differ a hundredfold, so the axis is logarithmic: whole decades, the first of them below every bar.
    let least = panel.bars.iter().map(|bar| bar.mean).fold(f64::INFINITY, f64::min);
    let most = panel.bars.iter().map(|bar| bar.mean + bar.half_width).fold(0.0, f64::max);
    let (low, high) = ((least.log10() - 0.2).floor(), most.log10().ceil());
    let x = |value: f64| {
        let along = ((value.max(f64::MIN_POSITIVE).log10() - low) / (high - low)).clamp(0.0, 1.0);
        pen.px(left) + (along * f64::from(pen.px(PANEL - NUMBER))) as i32
    };

    area.draw_text(&panel.title, &pen.text(14, HPos::Left), pen.at(left, HEAD - 24))?;
    let tick = pen.text(12, HPos::Center);
    for decade in low as i32..=high as i32 {
        let value = 10_f64.powi(decade);
        let line = [(x(value), pen.px(HEAD - 4)), (x(value), pen.px(bottom + 4))];
        area.draw(&PathElement::new(line, GRID.stroke_width(pen.px(1) as u32)))?;
        // What its shortest exact form is.
        area.draw_text(&format!("{value}"), &tick, (x(value), pen.px(bottom + 16)))?;
    }
    let axis = format!("{}, logarithmic", panel.unit);
    area.draw_text(&axis, &tick, pen.at(left + (PANEL - NUMBER) / 2, bottom + 40))?;
    for (i, bar) in panel.bars.iter().enumerate() {
        draw_bar(area, pen, (left, middle(i)), bar, &x)?;
    }
    Ok(())
}

fn draw_bar<B>(
    area: &DrawingArea<B, Shift>,
    pen: Pen,
    (left, y): (i32, i32),
    bar: &Bar,
    x: &dyn Fn(f64) -> i32,
) -> Result<(), Box<dyn Error>>
where
    B: DrawingBackend,
    B::ErrorType: 'static,
{
    let corners = [pen.at(left, y - 9), (x(bar.mean), pen.px(y + 9))];
    area.draw(&Rectangle::new(corners, BAR.filled()))?;
    let (from, to) = (x(bar.mean - bar.half_width), x(bar.mean + bar.half_width));
    let style = INTERVAL.stroke_width(pen.px(1) as u32);
    area.draw(&PathElement::new([(from, pen.px(y)), (to, pen.px(y))], style))?;
    for end in [from, to] {
        area.draw(&PathElement::new([(end, pen.px(y - 4)), (end, pen.px(y + 4))], style))?;
    }
    area.draw_text(&digits(bar.mean), &pen.text(12, HPos::Left), (to + pen.px(6), pen.px(y)))?;
    Ok(())
}
