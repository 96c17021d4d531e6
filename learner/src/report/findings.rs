//! What agrees with the paper and what does not, from the figures alone.

use super::cell::Cell;
use crate::statistics::spearman;

/// A task on which several memories can be compared, here and in the paper.
pub struct Ranking<'a> {
    /// The memories' cells; each has a best block and a figure of the paper.
    pub cells: Vec<&'a Cell>,
    /// How many more memories have runs here, but no such block or figure.
    pub missing: usize,
    /// Rank correlation over the memories; none of fewer than three.
    pub correlation: Option<f64>,
}

/// How the cells stand to the paper.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Agreement {
    /// Within two standard errors.
    pub within: usize,
    /// Above them.
    pub higher: usize,
    /// Below them.
    pub lower: usize,
    /// Without a best block, or without a figure of the paper.
    pub unknown: usize,
}

impl Agreement {
    /// Of `cells`.
    pub fn of<'a>(cells: impl Iterator<Item = &'a Cell>) -> Self {
        let mut counts = Self::default();
        for cell in cells {
            *match cell.verdict {
                None => &mut counts.unknown,
                Some(verdict) if verdict.within() => &mut counts.within,
                Some(verdict) if verdict.difference > 0.0 => &mut counts.higher,
                Some(_) => &mut counts.lower,
            } += 1;
        }
        counts
    }

    /// How many cells could be set beside the paper.
    pub fn compared(&self) -> usize {
        self.within + self.higher + self.lower
    }
}

impl<'a> Ranking<'a> {
    /// The tasks on which at least two memories can be compared.
    pub fn all(cells: &'a [Cell]) -> Vec<Self> {
        let tasks = cells.chunk_by(|a, b| a.task.key() == b.task.key());
        let ranking = |task: &'a [Cell]| {
            let cells: Vec<&Cell> = task.iter().filter(|cell| cell.verdict.is_some()).collect();
            let ours: Vec<f64> = cells.iter().filter_map(|cell| ours(cell)).collect();
            let paper: Vec<f64> = cells.iter().filter_map(|cell| paper(cell)).collect();
            let missing = task.len() - cells.len();
            (cells.len() > 1).then(|| Self { missing, correlation: spearman(&ours, &paper), cells })
        };
        tasks.filter_map(ranking).collect()
    }

    /// The best memory here; the first of equals.
    pub fn winner(&self) -> &'a Cell {
        self.best(ours)
    }

    /// The best of these memories in the paper; the first of equals.
    pub fn paper_winner(&self) -> &'a Cell {
        self.best(paper)
    }

    fn best(&self, value: fn(&Cell) -> Option<f64>) -> &'a Cell {
        let better = |a: &'a Cell, b: &'a Cell| if value(b) > value(a) { b } else { a };
        self.cells[1..].iter().fold(self.cells[0], |a, b| better(a, b))
    }

    /// Whether the memory that is best here is among the best in the paper, where several may print the same figure.
    pub fn agrees(&self) -> bool {
        paper(self.winner()) >= paper(self.paper_winner())
    }
}

/// The cells that differ most from the paper, the largest difference first.
pub fn largest_differences(cells: &[Cell], most: usize) -> Vec<&Cell> {
    let size = |cell: &Cell| cell.verdict.map_or(0.0, |verdict| verdict.difference.abs());
    let mut found: Vec<&Cell> = cells.iter().filter(|cell| cell.verdict.is_some()).collect();
    found.sort_by(|a, b| size(b).total_cmp(&size(a)));
    found.truncate(most);
    found
}

fn ours(cell: &Cell) -> Option<f64> {
    cell.mmer_65k.map(|sample| sample.mean)
}

fn paper(cell: &Cell) -> Option<f64> {
    cell.paper.map(|score| score.mean)
}

#[cfg(test)]
mod tests {
    use super::super::samples::cells_of;
    use super::*;

    /// In the paper's AutoencodeEasy GRU has -0.283, LSTM -0.312 and MLP -0.470.
    fn cells() -> Vec<Cell> {
        cells_of(&[
            ("AutoencodeEasy", "mlp", &[-0.5]),
            ("AutoencodeEasy", "gru", &[0.9]),
            ("AutoencodeEasy", "lstm", &[0.95]),
            ("VelocityOnlyCartPoleEasy", "mlp", &[1.0]),
            ("VelocityOnlyCartPoleEasy", "gru", &[1.0]),
        ])
    }

    #[test]
    fn winners_and_ranks() {
        let cells = cells();
        let rankings = Ranking::all(&cells);
        assert_eq!(rankings.len(), 1, "the paper has no VelocityOnlyCartPole");
        let ranking = &rankings[0];
        let paper: Vec<f64> = ranking.cells.iter().map(|cell| cell.paper.unwrap().mean).collect();
        assert!(paper[0] < paper[2] && paper[2] < paper[1], "{paper:?}");
        assert_eq!((ranking.winner().memory.as_str(), ranking.paper_winner().memory.as_str()), ("lstm", "gru"));
        // Ranks 1 2 3 and 1 3 2: 1 - 6 * 2 / (3 * 8).
        assert!((ranking.correlation.unwrap() - 0.5).abs() < 1e-12 && !ranking.agrees() && ranking.missing == 0);
    }

    #[test]
    fn agreement_and_differences() {
        let cells = cells();
        let agreement = Agreement::of(cells.iter());
        assert_eq!((agreement.unknown, agreement.compared()), (2, 3));
        let names: Vec<&str> = largest_differences(&cells, 2).iter().map(|cell| cell.memory.as_str()).collect();
        assert_eq!(names, ["lstm", "gru"]);
    }
}
