//! The figures: each a small SVG, as wide as a phone.

use std::collections::BTreeSet;

use plotters::style::RGBColor;

use super::cell::{Cell, budgets, seeds, steps};
use super::compared::Compared;
use super::paper::place;
use super::text;
use crate::chart::PALETTE;

mod bars;
mod boxes;
mod curves;
mod scatter;
mod throughput;

pub use throughput::{Throughput, throughput};

/// Memories that are not in the paper.
const OTHER: RGBColor = RGBColor(85, 85, 153);

/// Characters of a figure's name, at most: names of files may not be long.
const NAME: usize = 120;

/// Characters of the title that stands in a figure, at most.
const TITLE: usize = 42;

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

/// Makes the names of `figures` plain (a preset of some configuration file is any text), short, and each another one.
pub fn make_names_plain<'a>(figures: impl Iterator<Item = &'a mut Figure>) {
    let mut known = BTreeSet::new();
    let plain = |symbol: char| if symbol.is_ascii_alphanumeric() || "-_".contains(symbol) { symbol } else { '_' };
    for (i, figure) in figures.enumerate() {
        figure.name = figure.name.chars().map(plain).take(NAME).collect();
        if !known.insert(figure.name.clone()) {
            figure.name = format!("{}-{i}", figure.name);
        }
    }
}

/// Whether a report writes figures of such names, and so may remove what an earlier one wrote.
pub fn is_figure(file: &str) -> bool {
    let kinds = ["bars-", "curve-", "summary-", "paper-", "scores-", "throughput-"];
    file.strip_suffix(".svg").is_some() && kinds.iter().any(|kind| file.starts_with(kind))
}

/// As much of `title` as there is room for above a figure.
fn heading(title: &str) -> String {
    if title.chars().count() <= TITLE { title.to_owned() } else { title.chars().take(TITLE).chain(['…']).collect() }
}

/// `caption`, after the title where that is not whole in the figure.
fn captioned(title: &str, caption: &str) -> String {
    if heading(title) == title { caption.to_owned() } else { format!("{title}: {caption}") }
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
pub fn sections(cells: &[Cell], comparisons: &[Compared<'_>]) -> anyhow::Result<Vec<Section>> {
    Ok(vec![bars::section(cells)?, curves::section(cells)?, boxes::section(comparisons)?, scatter::section(cells)?]
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
    PALETTE.get(place(paper_memory)).copied().unwrap_or(OTHER)
}

/// How many seeds and steps are behind the figures of `cells`, in words; of what has intervals, also where they are.
fn behind(cells: &[&Cell], intervals: bool) -> String {
    let all = || cells.iter().copied();
    let single = |cell: &Cell| cell.runs.len() == 1;
    let bands = match (all().all(single), all().any(single)) {
        _ if !intervals => "",
        (true, _) => ", so no intervals",
        (false, true) => ", intervals from 2",
        (false, false) => "",
    };
    let (seeds, done, budget) = (seeds(all()), text::span(steps(all())), text::span(budgets(all())));
    let early: usize = cells.iter().map(|cell| cell.stopped_early()).sum();
    let early =
        if early > 0 { format!("; {} stopped early at the target", text::plural(early, "run")) } else { String::new() };
    format!("{seeds}{bands}; {done} steps, budget {budget}{early}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_plain_short_and_different() {
        let [title, caption, svg] = [""; 3].map(str::to_owned);
        let figure =
            |name: &str| Figure { name: name.into(), title: title.clone(), caption: caption.clone(), svg: svg.clone() };
        let mut figures = ["a-1, x 0.5", "a-1_ x 0_5", &"b".repeat(500)].map(figure);
        make_names_plain(figures.iter_mut());
        let names: Vec<&str> = figures.iter().map(|figure| figure.name.as_str()).collect();
        assert_eq!(names, ["a-1__x_0_5", "a-1__x_0_5-1", &"b".repeat(120)]);
        assert!(is_figure("bars-A-quick.svg") && !is_figure("bars-A-quick.png") && !is_figure("own.svg"));
    }

    #[test]
    fn long_titles_are_cut_and_whole_in_the_caption() {
        assert_eq!((heading("short"), captioned("short", "1 seed.")), ("short".to_owned(), "1 seed.".to_owned()));
        let long = "x".repeat(50);
        assert_eq!(heading(&long), format!("{}…", "x".repeat(42)));
        assert_eq!(captioned(&long, "1 seed."), format!("{long}: 1 seed."));
    }
}
