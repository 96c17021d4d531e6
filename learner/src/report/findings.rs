//! What agrees with the paper and what does not, from the figures alone.

use super::cell::Cell;
use super::paper::memory_mark;
use crate::statistics::spearman;

/// A task on which several memories can be compared, here and in the paper.
pub struct Ranking<'a> {
    /// The memories' cells; each has a verdict.
    pub cells: Vec<&'a Cell>,
    /// How many more memories have runs here, but no verdict.
    pub missing: usize,
    /// Rank correlation over the memories; none of fewer than three.
    pub correlation: Option<f64>,
    /// The same without memories of which the paper's figure is of another model.
    pub unmarked_correlation: Option<f64>,
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
    /// Not compared, because a run stopped at its target.
    pub lower_bounds: usize,
    /// Not compared, because a run has no block, or the paper no figure.
    pub unknown: usize,
}

impl Agreement {
    /// Of `cells`.
    pub fn of<'a>(cells: impl Iterator<Item = &'a Cell>) -> Self {
        let mut counts = Self::default();
        for cell in cells {
            *match cell.verdict {
                None if cell.paper.is_some() && cell.lower_bound() => &mut counts.lower_bounds,
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
    /// The tasks on which at least two memories can be compared. Where a run stopped at its target nobody knows who would have
    /// won.
    pub fn all(cells: &'a [Cell]) -> Vec<Self> {
        let tasks = cells.chunk_by(|a, b| a.task.key() == b.task.key());
        let ranking = |task: &'a [Cell]| {
            let cells: Vec<&Cell> = task.iter().filter(|cell| cell.verdict.is_some()).collect();
            let unmarked = cells.iter().copied().filter(|cell| memory_mark(&cell.paper_memory).is_none());
            let (correlation, unmarked_correlation) = (correlation(cells.iter().copied()), correlation(unmarked));
            let missing = task.len() - cells.len();
            let fair = cells.len() > 1 && !task.iter().any(Cell::lower_bound);
            fair.then_some(Self { cells, missing, correlation, unmarked_correlation })
        };
        tasks.filter_map(ranking).collect()
    }

    /// The best memory here; of equals the one that is better in the paper, then the first.
    pub fn winner(&self) -> &'a Cell {
        self.best(|cell| (ours(cell), paper(cell)))
    }

    /// The best of these memories in the paper; of equals the one that is better here, then the first.
    pub fn paper_winner(&self) -> &'a Cell {
        self.best(|cell| (paper(cell), ours(cell)))
    }

    fn best(&self, value: fn(&Cell) -> (Option<f64>, Option<f64>)) -> &'a Cell {
        let better = |a: &'a Cell, b: &'a Cell| if value(b) > value(a) { b } else { a };
        self.cells[1..].iter().fold(self.cells[0], |a, b| better(a, b))
    }

    /// Whether some memory is best both here and in the paper, alone or among equals: then it is both winners.
    pub fn agrees(&self) -> bool {
        paper(self.winner()) == paper(self.paper_winner())
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

/// Rank correlation over `cells` between our best blocks and the paper's figures.
fn correlation<'a>(cells: impl Iterator<Item = &'a Cell>) -> Option<f64> {
    let (ours, paper): (Vec<f64>, Vec<f64>) = cells.filter_map(|cell| ours(cell).zip(paper(cell))).unzip();
    spearman(&ours, &paper)
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
    fn of_equals_any_counts() {
        // In the paper's AutoencodeEasy GRU has -0.283, LSTM -0.312: GRU is the one that both agree on.
        let cells = cells_of(&[("AutoencodeEasy", "lstm", &[0.5]), ("AutoencodeEasy", "gru", &[0.5])]);
        let rankings = Ranking::all(&cells);
        let names = |ranking: &Ranking<'_>| (ranking.winner().memory.clone(), ranking.paper_winner().memory.clone());
        assert_eq!((names(&rankings[0]), rankings[0].agrees()), (("gru".into(), "gru".into()), true));
    }

    #[test]
    fn marked_memories_can_be_left_out() {
        // The paper: MLP -0.470, GRU -0.283, LSTM -0.312, and FART.
        let cells = cells_of(&[
            ("AutoencodeEasy", "mlp", &[0.1]),
            ("AutoencodeEasy", "fart", &[-0.9]),
            ("AutoencodeEasy", "gru", &[0.3]),
            ("AutoencodeEasy", "lstm", &[0.2]),
        ]);
        let ranking = &Ranking::all(&cells)[0];
        assert_eq!((ranking.unmarked_correlation, ranking.cells.len()), (Some(1.0), 4));
        assert!(ranking.correlation.unwrap() < 1.0);
    }

    #[test]
    fn nobody_wins_where_a_run_stopped_at_its_target() {
        let mut cells = cells();
        cells[0].runs[0].stopped_by = Some("mmer".into());
        cells[0].runs[0].budget = 1_000_000;
        cells[0].verdict = None;
        assert_eq!(Ranking::all(&cells).len(), 0);
        let agreement = Agreement::of(cells.iter());
        assert_eq!((agreement.lower_bounds, agreement.unknown, agreement.compared()), (1, 2, 2));
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
