//! Horizontal bars: MMER by memory and difficulty, single-value scores, throughput.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::{Figure, Section, WIDTH, behind, captioned, heading};
use crate::chart::{FINE, GRID, SvgArea, TEXT, short, svg};
use crate::report::cell::Cell;
use crate::report::compared::{Compared, Scores};
use crate::report::tables::memories;
use crate::report::text;
use crate::statistics::bootstrap_interval;

/// Lengths, before the pen's scale.
const NAMES: f64 = 78.0;
const RIGHT: f64 = 10.0;
const NUMBERS: f64 = 44.0;
const HEAD: f64 = 26.0;
const LEGEND: f64 = 18.0;
const BAR: f64 = 8.0;
const ONLY_BAR: f64 = 13.0;
const GAP: f64 = 7.0;
const AXIS: f64 = 24.0;

/// The first, second and third bar of a row.
const SHADES: [RGBColor; 3] = [RGBColor(120, 175, 225), RGBColor(58, 122, 190), RGBColor(140, 100, 175)];

/// Rows of bars on one scale.
pub(super) struct Bars {
    /// Above them.
    pub(super) title: String,
    /// Name and bars of each row; a bar may be missing.
    pub(super) rows: Vec<(String, Vec<Option<Bar>>)>,
    /// What the first, second and third bar of each row are; one needs no name.
    pub(super) legend: Vec<String>,
    /// Marks of the scale; the first and the last are its ends.
    pub(super) ticks: Vec<f64>,
    /// Whether the scale is logarithmic.
    pub(super) logarithmic: bool,
}

/// One bar.
pub(super) struct Bar {
    /// Its end.
    pub(super) value: f64,
    /// The interval around its end, if it is known.
    pub(super) interval: Option<(f64, f64)>,
    /// What stands beside it.
    pub(super) text: String,
}

impl Bars {
    /// The picture.
    pub(super) fn svg(&self) -> anyhow::Result<String> {
        svg((WIDTH, self.height() as u32), FINE, |area| self.draw(area))
    }

    fn thickness(&self) -> f64 {
        if self.per_row() > 1 { BAR } else { ONLY_BAR }
    }

    fn per_row(&self) -> usize {
        self.rows.iter().map(|(_, bars)| bars.len()).max().unwrap_or(1).max(1)
    }

    fn row(&self) -> f64 {
        self.thickness() * self.per_row() as f64 + GAP
    }

    fn top(&self) -> f64 {
        HEAD + if self.legend.is_empty() { 0.0 } else { LEGEND } + GAP
    }

    fn height(&self) -> f64 {
        self.top() + self.row() * self.rows.len() as f64 + AXIS
    }

    /// Where a value stands, from left to right; values beyond the scale stand at its end.
    fn x(&self, value: f64) -> f64 {
        let place = |value: f64| if self.logarithmic { value.max(f64::MIN_POSITIVE).log10() } else { value };
        let (low, high) = (self.ticks.first().map_or(0.0, |t| place(*t)), self.ticks.last().map_or(1.0, |t| place(*t)));
        let labelled = self.rows.iter().flat_map(|(_, bars)| bars).flatten().any(|bar| !bar.text.is_empty());
        let right = if labelled { NUMBERS } else { RIGHT };
        NAMES + ((place(value) - low) / (high - low)).clamp(0.0, 1.0) * (f64::from(WIDTH) - NAMES - right)
    }

    fn draw(&self, area: &SvgArea<'_>) -> anyhow::Result<()> {
        let pen = FINE;
        let anchored = |size, h| pen.text(size).pos(Pos::new(h, VPos::Center));
        area.draw_text(&heading(&self.title), &pen.text(13), pen.at(8.0, 8.0))?;
        for (i, name) in self.legend.iter().enumerate() {
            let (x, y) = (8.0 + 108.0 * i as f64, HEAD + 6.0);
            area.draw(&Rectangle::new([pen.at(x, y - 4.0), pen.at(x + 12.0, y + 4.0)], SHADES[i % 3].filled()))?;
            area.draw_text(name, &anchored(11, HPos::Left), pen.at(x + 16.0, y))?;
        }
        let bottom = self.height() - AXIS;
        for tick in &self.ticks {
            let x = self.x(*tick);
            let line = vec![pen.at(x, self.top() - 3.0), pen.at(x, bottom)];
            area.draw(&PathElement::new(line, GRID.stroke_width(pen.px(1))))?;
            area.draw_text(&short(*tick), &anchored(11, HPos::Center), pen.at(x, bottom + 10.0))?;
        }
        for (i, (name, bars)) in self.rows.iter().enumerate() {
            let top = self.top() + self.row() * i as f64;
            let middle = top + self.thickness() * self.per_row() as f64 / 2.0;
            area.draw_text(name, &anchored(11, HPos::Right), pen.at(NAMES - 6.0, middle))?;
            for (j, bar) in bars.iter().enumerate() {
                let Some(bar) = bar else { continue };
                self.draw_bar(area, bar, SHADES[j % 3], top + self.thickness() * j as f64)?;
            }
        }
        Ok(())
    }

    fn draw_bar(&self, area: &SvgArea<'_>, bar: &Bar, colour: RGBColor, top: f64) -> anyhow::Result<()> {
        let pen = FINE;
        let (left, right, middle) = (NAMES, self.x(bar.value), top + self.thickness() / 2.0);
        let corners = [pen.at(left, top + 0.5), pen.at(right.max(left + 0.5), top + self.thickness() - 0.5)];
        area.draw(&Rectangle::new(corners, colour.filled()))?;
        let mut end = right;
        if let Some((low, high)) = bar.interval {
            end = end.max(self.x(high));
            let line = vec![pen.at(self.x(low), middle), pen.at(self.x(high), middle)];
            area.draw(&PathElement::new(line, TEXT.stroke_width(pen.px(1))))?;
        }
        if !bar.text.is_empty() {
            let style = pen.text(11).pos(Pos::new(HPos::Left, VPos::Center));
            area.draw_text(&bar.text, &style, pen.at(end + 4.0, middle))?;
        }
        Ok(())
    }
}

/// Marks from 0 to 1.
pub(super) fn unit_ticks() -> Vec<f64> {
    vec![0.0, 0.25, 0.5, 0.75, 1.0]
}

/// A figure for each game and preset: all memories, all difficulties.
pub(super) fn section(cells: &[Cell]) -> anyhow::Result<Section> {
    let game = |a: &Cell, b: &Cell| a.task.game == b.task.game && a.task.preset == b.task.preset;
    // Presets of one game are not neighbours; these are.
    let mut sorted: Vec<&Cell> = cells.iter().collect();
    let first = |cell: &Cell| cells.iter().position(|other| other.task.game == cell.task.game);
    sorted.sort_by(|a, b| (first(a), &a.task.preset, a.task.order).cmp(&(first(b), &b.task.preset, b.task.order)));
    let figures = sorted.chunk_by(|a, b| game(a, b)).map(game_figure).collect::<anyhow::Result<_>>()?;
    Ok(Section {
        title: "MMER by environment".into(),
        text: "Mean over seeds of MMER, as a share of the environment's range of returns: 0 is the smallest possible \
               return, 1 the largest. Lines are 95% bootstrap intervals of the mean over the seeds."
            .into(),
        figures,
    })
}

fn game_figure(cells: &[&Cell]) -> anyhow::Result<Figure> {
    let task = &cells[0].task;
    let mut levels: Vec<_> = cells.iter().map(|cell| cell.task.difficulty).collect();
    levels.dedup();
    let memories = memories(cells.iter().copied());
    let bar = |memory: &String, level| {
        let cell = cells.iter().find(|cell| cell.paper_memory == *memory && cell.task.difficulty == level)?;
        let standardised = |value| cell.task.standardised(value);
        let seeds: Vec<f64> = cell.runs.iter().map(|run| standardised(run.mmer)).collect();
        Some(Bar { value: standardised(cell.mmer.mean), interval: bootstrap_interval(&seeds), text: String::new() })
    };
    let row = |memory: &String| (memory.clone(), levels.iter().map(|level| bar(memory, *level)).collect());
    let bars = Bars {
        title: format!("{}, {}", task.game, task.preset),
        rows: memories.iter().map(row).collect(),
        legend: levels.iter().flatten().map(ToString::to_string).collect(),
        ticks: unit_ticks(),
        logarithmic: false,
    };
    Ok(Figure {
        name: format!("bars-{}-{}", task.game, task.preset),
        title: format!("MMER of {} by memory and difficulty", task.game),
        caption: captioned(&bars.title, &format!("{}.", behind(cells, true))),
        svg: bars.svg()?,
    })
}

/// The single-value scores of one comparison.
pub(super) fn scores(name: &str, compared: &Compared<'_>) -> anyhow::Result<Figure> {
    let bar = |value: Option<f64>| value.map(|value| Bar { value, interval: None, text: String::new() });
    let scores = compared.scores();
    let row = |score: &Scores| (score.marked_memory(), vec![bar(score.mmer), bar(score.mmer_65k), bar(score.paper)]);
    let beside = compared.beside_paper();
    let bars = Bars {
        title: format!("Mean return, {}", compared.title()),
        rows: scores.iter().map(row).collect(),
        legend: vec!["MMER".into(), "MMER-65k".into(), "paper".into()],
        ticks: vec![-1.0, -0.5, 0.0, 0.5, 1.0],
        logarithmic: false,
    };
    let cells: Vec<&Cell> = compared.cells().collect();
    Ok(Figure {
        name: name.to_owned(),
        title: bars.title.clone(),
        caption: captioned(
            &bars.title,
            &format!(
                "MMER: mean over {}. MMER-65k and the paper (15M steps, DNC 10M): mean over the {beside} of these in which \
                 every memory can be set beside the paper. *: the paper's figures are of another model. {}.",
                text::plural(compared.tasks.len(), "environment"),
                behind(&cells, false)
            ),
        ),
        svg: bars.svg()?,
    })
}

#[cfg(test)]
mod tests {
    use super::super::super::samples::cells_of;
    use super::*;

    #[test]
    fn a_figure_for_each_game() {
        let cells = cells_of(&[
            ("RepeatFirstEasy", "gru", &[1.0, 0.5]),
            ("RepeatFirstHard", "gru", &[0.0]),
            ("RepeatFirstHard", "mlp", &[-0.5]),
            ("BattleshipEasy", "mlp", &[0.0]),
        ]);
        let section = section(&cells).unwrap();
        let names: Vec<_> = section.figures.iter().map(|figure| figure.name.as_str()).collect();
        assert_eq!(names, ["bars-RepeatFirst-quick", "bars-Battleship-quick"]);
        assert_eq!(section.figures[0].caption, "1 to 2 seeds, intervals from 2; 70k steps, budget 70k.");
        for expected in ["Easy", "Hard", "GRU", "MLP", "0.25"] {
            assert!(section.figures[0].svg.contains(expected), "no `{expected}`");
        }
    }

    #[test]
    fn scales() {
        let bars = |ticks: Vec<f64>, logarithmic| Bars {
            title: String::new(),
            rows: vec![("a".into(), vec![Some(Bar { value: 1.0, interval: None, text: String::new() })])],
            legend: vec![],
            ticks,
            logarithmic,
        };
        let (linear, log) = (bars(unit_ticks(), false), bars(vec![10.0, 100.0, 1000.0], true));
        // From 78 to 330.
        for (value, expected) in [(0.0, 78.0), (0.5, 204.0), (1.0, 330.0), (2.0, 330.0)] {
            assert!((linear.x(value) - expected).abs() < 1e-9, "{value}");
        }
        for (value, expected) in [(1.0, 78.0), (10.0, 78.0), (100.0, 204.0), (1000.0, 330.0), (0.0, 78.0)] {
            assert!((log.x(value) - expected).abs() < 1e-9, "{value}");
        }
    }
}
