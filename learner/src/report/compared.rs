//! Which memories can be compared over which environments: only those that all of them have.

use super::cell::Cell;
use super::paper::{marked, memory_mark};
use super::text::plural;
use crate::statistics::{mean, spearman};

/// Environments are in sets of this group or not.
const LABYRINTHS: &str = "navigation";

/// At most so many sets of memories are compared: the largest.
const MOST: usize = 3;

/// Memories, and the tasks of one preset that every one of them has.
pub struct Compared<'a> {
    /// The runs' preset, and what was changed of it.
    pub preset: String,
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
    /// Best blocks, over those tasks in which all memories can be set beside the paper.
    pub mmer_65k: Option<f64>,
    /// The paper's MMER over the same tasks.
    pub paper: Option<f64>,
}

impl<'a> Compared<'a> {
    /// The comparisons that `cells` allow: for each set of two memories or more that some task has, over all tasks of
    /// the same preset that have at least these. Large tables first.
    pub fn all(cells: &'a [Cell]) -> Vec<Self> {
        let tasks: Vec<&[Cell]> = cells.chunk_by(|a, b| a.task.key() == b.task.key()).collect();
        let mut found: Vec<Self> = Vec::new();
        for task in &tasks {
            let memories: Vec<String> = task.iter().map(|cell| cell.paper_memory.clone()).collect();
            let preset = &task[0].task.preset;
            if memories.len() < 2 || found.iter().any(|other| other.preset == *preset && other.memories == memories) {
                continue;
            }
            let same = tasks.iter().filter(|task| task[0].task.preset == *preset);
            let tasks = same.filter_map(|task| {
                let cell = |name: &String| task.iter().find(|cell| cell.paper_memory == *name);
                memories.iter().map(cell).collect::<Option<Vec<_>>>()
            });
            let tasks = tasks.collect();
            found.push(Self { preset: preset.clone(), memories, tasks });
        }
        found.sort_by_key(|compared| std::cmp::Reverse(compared.memories.len() * compared.tasks.len()));
        found.truncate(MOST);
        found
    }

    /// Without the labyrinths; none if there are none, or nothing else.
    pub fn without_labyrinths(&self) -> Option<Self> {
        let tasks: Vec<_> = self.tasks.iter().filter(|task| task[0].task.group != LABYRINTHS).cloned().collect();
        let some = !tasks.is_empty() && tasks.len() < self.tasks.len();
        some.then(|| Self { preset: self.preset.clone(), memories: self.memories.clone(), tasks })
    }

    /// In how many tasks all memories can be set beside the paper.
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
        correlation(self.scores().iter())
    }

    /// The same without the memories of which the paper's figures are of another model; none if there are no such memories.
    pub fn unmarked_rank_correlation(&self) -> Option<f64> {
        let scores = self.scores();
        let unmarked: Vec<&Scores> = scores.iter().filter(|score| memory_mark(&score.memory).is_none()).collect();
        correlation(unmarked.iter().copied()).filter(|_| unmarked.len() < scores.len())
    }

    /// Each memory's standardised MMER in every task.
    pub fn standardised(&self) -> Vec<(String, Vec<f64>)> {
        let values = |i: usize| self.tasks.iter().map(|task| task[i].task.standardised(task[i].mmer.mean)).collect();
        self.memories.iter().enumerate().map(|(i, memory)| (memory.clone(), values(i))).collect()
    }

    /// What is compared, in words.
    pub fn title(&self) -> String {
        format!("{} memories over {}, {}", self.memories.len(), plural(self.tasks.len(), "environment"), self.preset)
    }

    /// All cells.
    pub fn cells(&self) -> impl Iterator<Item = &'a Cell> {
        self.tasks.iter().flatten().copied()
    }
}

impl Scores {
    /// The memory, with an asterisk if the paper's figures are of another model.
    pub fn marked_memory(&self) -> String {
        marked(&self.memory, memory_mark(&self.memory))
    }
}

fn correlation<'a>(scores: impl Iterator<Item = &'a Scores>) -> Option<f64> {
    let (ours, paper): (Vec<f64>, Vec<f64>) = scores.filter_map(|score| score.mmer_65k.zip(score.paper)).unzip();
    spearman(&ours, &paper)
}

fn beside_paper(task: &[&Cell]) -> bool {
    task.iter().all(|cell| cell.verdict.is_some())
}

#[cfg(test)]
mod tests {
    use super::super::cell::cells;
    use super::super::samples::{RunFiles, cells_of, collected};
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
        assert_eq!(titles, ["2 memories over 3 environments, quick", "3 memories over 1 environment, quick"]);
        assert_eq!(all[0].memories, ["MLP", "GRU"]);
        let means: Vec<_> = all[0].scores().iter().map(|score| score.mmer.unwrap()).collect();
        assert_eq!(means, [0.0, 0.25]);
        let fewer = all[0].without_labyrinths().unwrap();
        let means: Vec<_> = fewer.scores().iter().map(|score| score.mmer_65k.unwrap()).collect();
        assert_eq!((fewer.tasks.len(), fewer.beside_paper(), means), (2, 2, vec![-0.375, 0.75]));
        assert!(all[1].without_labyrinths().is_none(), "there are none in it");
        assert_eq!(all[1].standardised()[2], ("LSTM".to_owned(), vec![0.75]));
    }

    #[test]
    fn presets_are_compared_apart() {
        let root = tempfile::tempdir().unwrap();
        let runs = [("quick", "mlp", 0.0), ("quick", "gru", 0.5), ("paper", "mlp", 0.25), ("paper", "gru", 1.0)];
        for (preset, memory, score) in runs {
            RunFiles { memory, preset, ..RunFiles::default() }
                .write(&root.path().join(format!("{preset}-{memory}")), &[(70_000, 200, score)]);
        }
        let cells = cells(collected(&[root.path()]).unwrap().runs).unwrap();
        let all = Compared::all(&cells);
        let means = |compared: &Compared<'_>| -> Vec<f64> { compared.scores().iter().filter_map(|s| s.mmer).collect() };
        let found: Vec<_> = all.iter().map(|compared| (compared.title(), means(compared))).collect();
        let title = |preset: &str| format!("2 memories over 1 environment, {preset}");
        assert_eq!(found, [(title("paper"), vec![0.25, 1.0]), (title("quick"), vec![0.0, 0.5])]);
    }

    #[test]
    fn rank_correlation_with_and_without_marked_memories() {
        // In the paper's AutoencodeEasy MLP has -0.470, LSTM -0.312, GRU -0.283; FART is marked.
        let cells = cells_of(&[
            ("AutoencodeEasy", "mlp", &[0.1]),
            ("AutoencodeEasy", "fart", &[-0.9]),
            ("AutoencodeEasy", "gru", &[0.3]),
            ("AutoencodeEasy", "lstm", &[0.2]),
        ]);
        let compared = &Compared::all(&cells)[0];
        assert_eq!(compared.unmarked_rank_correlation(), Some(1.0));
        assert!(compared.rank_correlation().unwrap() < 1.0);
        let names: Vec<String> = compared.scores().iter().map(Scores::marked_memory).collect();
        assert_eq!(names, ["MLP", "FART*", "GRU", "LSTM"]);
        let cells = cells_of(&[("AutoencodeEasy", "mlp", &[0.1]), ("AutoencodeEasy", "gru", &[0.3])]);
        assert_eq!(Compared::all(&cells)[0].unmarked_rank_correlation(), None, "none of them is marked");
    }
}
