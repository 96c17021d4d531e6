//! The figures: each a small SVG, as wide as a phone.

use plotters::style::RGBColor;

use super::cell::Cell;
use super::compared::Compared;
use super::{paper, text};
use crate::chart::PALETTE;

mod bars;
mod boxes;
mod curves;
mod scatter;
mod throughput;

pub use throughput::{Throughput, throughput};

/// Memories that are not in the paper.
const OTHER: RGBColor = RGBColor(85, 85, 153);

/// Width of a figure in its own units, which are pixels where it is as wide as that.
const WIDTH: u32 = 340;

/// A figure.
pub struct Figure {
    /// The file's name, without `.svg`.
    pub name: String,
    /// What it shows, for those who cannot see it.
    pub title: String,
    /// What must be known to read it.
    pub caption: String,
    /// The picture.
    pub svg: String,
}

/// Figures of one kind.
pub struct Section {
    /// Its heading.
    pub title: String,
    /// What all its figures have in common.
    pub text: String,
    /// The figures.
    pub figures: Vec<Figure>,
}

/// All figures that `cells` allow.
///
/// # Errors
/// None that can be caused from outside.
pub fn sections(cells: &[Cell]) -> anyhow::Result<Vec<Section>> {
    let compared = Compared::all(cells);
    Ok(vec![bars::section(cells)?, curves::section(cells)?, boxes::section(&compared)?, scatter::section(cells)?]
        .into_iter()
        .filter(|section| !section.figures.is_empty())
        .collect())
}

/// The single-value scores of one comparison.
///
/// # Errors
/// None that can be caused from outside.
pub fn scores(name: &str, compared: &Compared<'_>) -> anyhow::Result<Figure> {
    bars::scores(name, compared)
}

/// A colour for each of the paper's memories, and one for all others.
fn colour(paper_memory: &str) -> RGBColor {
    let place = paper::MEMORIES.iter().position(|known| *known == paper_memory);
    place.map_or(OTHER, |place| PALETTE[place])
}

/// How many seeds and steps are behind the figures of `cells`, in words; of what has intervals, also where they are.
fn behind(cells: &[&Cell], intervals: bool) -> String {
    let seeds = || cells.iter().map(|cell| cell.runs.len());
    let (fewest, most) = (seeds().min().unwrap_or(0), seeds().max().unwrap_or(0));
    let seeds = match (fewest, most) {
        (1, 1) if intervals => "1 seed, so no intervals".to_owned(),
        (1, most) if intervals => format!("1 to {most} seeds, intervals from 2"),
        (fewest, most) if fewest == most => text::plural(most, "seed"),
        (fewest, most) => format!("{fewest} to {most} seeds"),
    };
    let steps = |pick: fn((u64, u64)) -> u64| cells.iter().map(move |cell| pick(cell.steps()));
    let budgets = |pick: fn((u64, u64)) -> u64| cells.iter().map(move |cell| pick(cell.budgets()));
    let done = (steps(|pair| pair.0).min().unwrap_or(0), steps(|pair| pair.1).max().unwrap_or(0));
    let budget = (budgets(|pair| pair.0).min().unwrap_or(0), budgets(|pair| pair.1).max().unwrap_or(0));
    let early: usize = cells.iter().map(|cell| cell.stopped_early()).sum();
    let early =
        if early > 0 { format!("; {} stopped early at the target", text::plural(early, "run")) } else { String::new() };
    format!("{seeds}; {} steps, budget {}{early}", text::span(done), text::span(budget))
}
