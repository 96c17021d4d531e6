//! Which memories can be compared over which environments: only those that all of them have.

use super::cell::Cell;
use super::text::plural;
use crate::statistics::{mean, spearman};

/// Environments are in sets of this group or not.
const LABYRINTHS: &str = "navigation";

/// At most so many sets of memories are compared: the largest.
const MOST: usize = 3;

/// Memories, and the tasks that every one of them has.
pub struct Compared<'a> {
    /// The memories, by their names in the paper, in the paper's order.
    pub memories: Vec<String>,
    /// For each task, the cells of the memories, in the same order.
    pub tasks: Vec<Vec<&'a Cell>>,
}

/// A memory's plain means over tasks.
#[derive(Clone, Debug, PartialEq)]
pub struct Scores {
    /// The memory.
    pub memory: String,
    /// MMER, over all tasks.
    pub mmer: Option<f64>,
    /// Best blocks, over those tasks in which all memories have one and the paper has figures.
    pub mmer_65k: Option<f64>,
    /// The paper's MMER over the same tasks.
    pub paper: Option<f64>,
}

impl<'a> Compared<'a> {
    /// The comparisons that `cells` allow: for each set of two memories or more that some task has, over all tasks that
    /// have at least these. Large tables first.
    pub fn all(cells: &'a [Cell]) -> Vec<Self> {
        let tasks: Vec<&[Cell]> = cells.chunk_by(|a, b| a.task.key() == b.task.key()).collect();
        let mut found: Vec<Self> = Vec::new();
        for task in &tasks {
            let memories: Vec<String> = task.iter().map(|cell| cell.paper_memory.clone()).collect();
            if memories.len() < 2 || found.iter().any(|other| other.memories == memories) {
                continue;
            }
            let tasks = tasks.iter().filter_map(|task| {
                let cell = |name: &String| task.iter().find(|cell| cell.paper_memory == *name);
                memories.iter().map(cell).collect::<Option<Vec<_>>>()
            });
            let tasks = tasks.collect();
            found.push(Self { memories, tasks });
        }
        found.sort_by_key(|compared| std::cmp::Reverse(compared.memories.len() * compared.tasks.len()));
        found.truncate(MOST);
        found
    }

    /// Without the labyrinths; none if there are none, or nothing else.
    pub fn without_labyrinths(&self) -> Option<Self> {
        let tasks: Vec<_> = self.tasks.iter().filter(|task| task[0].task.group != LABYRINTHS).cloned().collect();
        let some = !tasks.is_empty() && tasks.len() < self.tasks.len();
        some.then(|| Self { memories: self.memories.clone(), tasks })
    }

    /// How many tasks have a best block of every memory, and the paper's figures.
    pub fn beside_paper(&self) -> usize {
        self.tasks.iter().filter(|task| beside_paper(task)).count()
    }

    /// Each memory's means.
    pub fn scores(&self) -> Vec<Scores> {
        let score = |(i, memory): (usize, &String)| {
            let of = |value: fn(&Cell) -> Option<f64>, only: bool| {
                let tasks = self.tasks.iter().filter(|task| !only || beside_paper(task));
                mean(&tasks.filter_map(|task| value(task[i])).collect::<Vec<_>>())
            };
            Scores {
                memory: memory.clone(),
                mmer: of(|cell| Some(cell.mmer.mean), false),
                mmer_65k: of(|cell| cell.mmer_65k.map(|sample| sample.mean), true),
                paper: of(|cell| cell.paper.map(|score| score.mean), true),
            }
        };
        self.memories.iter().enumerate().map(score).collect()
    }

    /// Rank correlation over the memories between our scores (best blocks) and the paper's.
    pub fn rank_correlation(&self) -> Option<f64> {
        let scores = self.scores();
        let ours: Vec<f64> = scores.iter().filter_map(|score| score.mmer_65k).collect();
        let paper: Vec<f64> = scores.iter().filter_map(|score| score.paper).collect();
        spearman(&ours, &paper)
    }

    /// Each memory's standardised MMER in every task.
    pub fn standardised(&self) -> Vec<(String, Vec<f64>)> {
        let values = |i: usize| self.tasks.iter().map(|task| task[i].task.standardised(task[i].mmer.mean)).collect();
        self.memories.iter().enumerate().map(|(i, memory)| (memory.clone(), values(i))).collect()
    }

    /// What is compared, in words.
    pub fn title(&self) -> String {
        format!("{} memories over {}", self.memories.len(), plural(self.tasks.len(), "environment"))
    }

    /// Smallest and largest number of seeds of a cell.
    pub fn seeds(&self) -> (usize, usize) {
        let seeds = || self.tasks.iter().flatten().map(|cell| cell.runs.len());
        (seeds().min().unwrap_or(0), seeds().max().unwrap_or(0))
    }

    /// Smallest and largest number of environment steps of a run.
    pub fn steps(&self) -> (u64, u64) {
        let steps = || self.tasks.iter().flatten().map(|cell| cell.steps());
        (steps().map(|steps| steps.0).min().unwrap_or(0), steps().map(|steps| steps.1).max().unwrap_or(0))
    }
}

fn beside_paper(task: &[&Cell]) -> bool {
    task.iter().all(|cell| cell.mmer_65k.is_some() && cell.paper.is_some())
}

#[cfg(test)]
mod tests {
    use super::super::samples::cells_of;
    use super::*;

    #[test]
    fn only_over_what_all_memories_have() {
        let cells = cells_of(&[
            ("RepeatFirstEasy", "mlp", &[-0.5]),
            ("RepeatFirstEasy", "gru", &[1.0]),
            ("RepeatFirstEasy", "lstm", &[0.5]),
            ("RepeatPreviousEasy", "mlp", &[-0.25]),
            ("RepeatPreviousEasy", "gru", &[0.5]),
            ("LabyrinthEscapeEasy", "mlp", &[0.75]),
            ("LabyrinthEscapeEasy", "gru", &[-0.75]),
            ("AutoencodeEasy", "gru", &[0.0]),
        ]);
        let all = Compared::all(&cells);
        let titles: Vec<_> = all.iter().map(Compared::title).collect();
        assert_eq!(titles, ["2 memories over 3 environments", "3 memories over 1 environment"]);
        assert_eq!(all[0].memories, ["MLP", "GRU"]);
        let means: Vec<_> = all[0].scores().iter().map(|score| score.mmer.unwrap()).collect();
        assert_eq!(means, [0.0, 0.25]);
        let fewer = all[0].without_labyrinths().unwrap();
        let means: Vec<_> = fewer.scores().iter().map(|score| score.mmer_65k.unwrap()).collect();
        assert_eq!((fewer.tasks.len(), fewer.beside_paper(), means), (2, 2, vec![-0.375, 0.75]));
        assert!(all[1].without_labyrinths().is_none(), "there are none in it");
        assert_eq!(all[1].standardised()[2], ("LSTM".to_owned(), vec![0.75]));
    }
}
