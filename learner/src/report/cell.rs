//! The runs of one memory in one environment, over seeds, beside the paper's figure.

use super::labels::differing_keys;
use super::paper::{self, Paper, Score};
use super::run::{Run, Task};
use super::text::plural;
use crate::statistics::Sample;

/// A place in the table: one memory on one task.
#[derive(Clone, Debug)]
pub struct Cell {
    /// Environment and hyper-parameters.
    pub task: Task,
    /// Name of the memory.
    pub memory: String,
    /// Its name in the paper's tables, or its own.
    pub paper_memory: String,
    /// A run for each seed.
    pub runs: Vec<Run>,
    /// MMER over the seeds.
    pub mmer: Sample,
    /// The best blocks of 65,536 steps, over those seeds that have one.
    pub mmer_65k: Option<Sample>,
    /// The paper's figure, if it has one.
    pub paper: Option<Score>,
    /// How `mmer_65k` stands to the paper's figure, if every run has its part in both: none stopped early, none is without a
    /// block.
    pub verdict: Option<Verdict>,
    /// What else must be known to read the figures.
    pub notes: Vec<String>,
}

/// Two means side by side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Verdict {
    /// Ours minus the paper's.
    pub difference: f64,
    /// Two standard errors of the difference, `2 sqrt(s1^2 / n1 + s2^2 / n2)`, and the half unit by which the paper rounds.
    /// With one seed of ours only the paper's error is known.
    pub bound: f64,
    /// Whether the error of ours is part of the bound.
    pub both_errors: bool,
}

impl Verdict {
    /// `ours` beside the paper's `score`.
    pub fn new(ours: &Sample, score: &Score) -> Self {
        let square = |std: f64, n: usize| std * std / n as f64;
        let own = ours.std.map(|std| square(std, ours.n));
        Self {
            difference: ours.mean - score.mean,
            bound: 2.0 * (own.unwrap_or(0.0) + square(score.std, paper::TRIALS)).sqrt() + paper::ROUNDING,
            both_errors: own.is_some(),
        }
    }

    /// Whether the difference is within the bound.
    pub fn within(&self) -> bool {
        self.difference.abs() <= self.bound
    }
}

impl Cell {
    /// The smallest and the largest of the runs' step budgets.
    pub fn budgets(&self) -> (u64, u64) {
        least_and_most(self.runs.iter().map(|run| run.budget))
    }

    /// The smallest and the largest number of steps that a run has done.
    pub fn steps(&self) -> (u64, u64) {
        least_and_most(self.runs.iter().map(|run| run.steps))
    }

    /// How many runs ended before their budget because their MMER was high enough.
    pub fn stopped_early(&self) -> usize {
        self.runs.iter().filter(|run| run.stopped_early()).count()
    }

    /// Whether `mmer_65k` only says what the memory can do at least: what a run does just before it stops at its target is
    /// mostly not in a complete block.
    pub fn lower_bound(&self) -> bool {
        self.stopped_early() > 0
    }

    /// Environment steps of the paper's runs, if the paper has this cell.
    pub fn paper_steps(&self) -> Option<u64> {
        self.paper.map(|_| paper::steps(&self.paper_memory))
    }

    /// Why the paper's figure is of something else, if it is.
    pub fn marks(&self) -> Vec<&'static str> {
        self.memory_mark().into_iter().chain(self.game_mark()).collect()
    }

    /// The memory's name, with an asterisk if the paper's figure is of another model.
    pub fn marked_memory(&self) -> String {
        paper::marked(&self.paper_memory, self.memory_mark())
    }

    /// The environment's name, with an asterisk if the paper's figure is of other rules.
    pub fn marked_env(&self) -> String {
        paper::marked(&self.task.env, self.game_mark())
    }

    fn memory_mark(&self) -> Option<&'static str> {
        self.paper.and_then(|_| paper::memory_mark(&self.paper_memory))
    }

    fn game_mark(&self) -> Option<&'static str> {
        self.paper.and_then(|_| paper::game_mark(self.task.paper_game.as_deref()?))
    }

    fn new(runs: Vec<Run>, paper: &Paper) -> Option<Self> {
        let first = runs.first()?.clone();
        let values: Vec<f64> = runs.iter().map(|run| run.mmer).collect();
        let blocks: Vec<f64> = runs.iter().filter_map(|run| run.mmer_65k).collect();
        let score = first.task.paper_game.as_deref().zip(first.task.difficulty);
        let score = score.and_then(|(game, level)| paper.score(game, level, &first.paper_memory));
        let mmer_65k = Sample::of(&blocks);
        // Of runs that stop at a target, only the slow ones have many blocks, or any.
        let comparable = blocks.len() == runs.len() && !runs.iter().any(Run::stopped_early);
        let pair = mmer_65k.as_ref().zip(score.as_ref()).filter(|_| comparable);
        Some(Self {
            mmer: Sample::of(&values)?,
            mmer_65k,
            paper: score,
            verdict: pair.map(|(ours, score)| Verdict::new(ours, score)),
            notes: notes(&first.task, &runs, score.is_some()),
            task: first.task,
            memory: first.memory,
            paper_memory: first.paper_memory,
            runs,
        })
    }
}

/// What the figures alone do not tell.
fn notes(task: &Task, runs: &[Run], in_paper: bool) -> Vec<String> {
    let (n, mut notes) = (runs.len(), Vec::new());
    let mut count = |number: usize, text: &str| {
        if number > 0 {
            notes.push(if n == 1 { text.to_owned() } else { format!("{number} of {n} {text}") });
        }
    };
    count(runs.iter().filter(|run| !run.complete()).count(), "not finished");
    count(
        runs.iter().filter(|run| run.stopped_early()).count(),
        "stopped early at its target, so MMER and MMER-65k are lower bounds",
    );
    count(runs.iter().filter(|run| run.mmer_65k.is_none()).count(), "without a block of 65,536 steps");
    if let Some(steps) = task.cut_after {
        notes.push(format!("not the benchmark's task: episodes are cut after {steps} steps"));
    }
    if n == 1 {
        notes.push(if in_paper { "one seed: only the paper's error is known" } else { "one seed" }.to_owned());
    }
    let configs: Vec<_> = runs.iter().map(|run| &run.config).collect();
    let keys: Vec<String> = differing_keys(&configs).into_iter().filter(|key| key != "seed").collect();
    if !keys.is_empty() {
        notes.push(format!("the seeds differ in {}", keys.join(", ")));
    }
    notes
}

/// Groups sorted runs by task and memory.
///
/// # Errors
/// None that can be caused from outside.
pub fn cells(runs: Vec<Run>) -> anyhow::Result<Vec<Cell>> {
    let paper = Paper::embedded()?;
    let mut groups: Vec<Vec<Run>> = Vec::new();
    for run in runs {
        let same = |group: &&mut Vec<Run>| {
            group.last().is_some_and(|last| last.task.key() == run.task.key() && last.memory == run.memory)
        };
        match groups.last_mut().filter(same) {
            Some(group) => group.push(run),
            None => groups.push(vec![run]),
        }
    }
    Ok(groups.into_iter().filter_map(|group| Cell::new(group, &paper)).collect())
}

/// The smallest and the largest number of seeds of `cells`, in words.
pub fn seeds<'a>(cells: impl IntoIterator<Item = &'a Cell>) -> String {
    match least_and_most(cells.into_iter().map(|cell| cell.runs.len() as u64)) {
        (fewest, most) if fewest == most => plural(most as usize, "seed"),
        (fewest, most) => format!("{fewest} to {most} seeds"),
    }
}

/// The smallest and the largest number of steps that a run of `cells` has done.
pub fn steps<'a>(cells: impl IntoIterator<Item = &'a Cell>) -> (u64, u64) {
    least_and_most(cells.into_iter().flat_map(|cell| &cell.runs).map(|run| run.steps))
}

/// The smallest and the largest of the step budgets of `cells`.
pub fn budgets<'a>(cells: impl IntoIterator<Item = &'a Cell>) -> (u64, u64) {
    least_and_most(cells.into_iter().flat_map(|cell| &cell.runs).map(|run| run.budget))
}

fn least_and_most(values: impl Iterator<Item = u64>) -> (u64, u64) {
    let joined = values.fold((u64::MAX, 0), |(least, most), value| (least.min(value), most.max(value)));
    if joined.0 > joined.1 { (0, 0) } else { joined }
}

#[cfg(test)]
mod tests {
    use super::super::samples::{RunFiles, cells_of, collected};
    use super::*;

    #[test]
    fn seeds_are_aggregated() {
        let cells = cells_of(&[
            ("RepeatFirstEasy", "gru", &[1.0, 0.5, 0.0]),
            ("StatelessCartPoleEasy", "fart", &[0.25]),
            ("RepeatFirstEasy", "mlp", &[-0.5, -0.25]),
        ]);
        let names: Vec<_> = cells.iter().map(|cell| (cell.task.env.as_str(), cell.paper_memory.as_str())).collect();
        let cart = "PositionOnlyCartPoleEasy";
        assert_eq!(names, [("RepeatFirstEasy", "MLP"), ("RepeatFirstEasy", "GRU"), (cart, "FART")]);
        assert_eq!(cells[1].mmer, Sample { n: 3, mean: 0.5, std: Some(0.5) });
        assert_eq!(cells[1].mmer_65k, Some(cells[1].mmer));
        assert_eq!((cells[1].notes.len(), cells[1].steps()), (0, (70_000, 70_000)));
        assert_eq!(cells[2].mmer, Sample { n: 1, mean: 0.25, std: None });
        assert_eq!(cells[2].notes, ["one seed: only the paper's error is known"]);
        assert_eq!(cells[2].marks().len(), 1);
        assert!(cells[2].paper.is_some(), "the paper calls it StatelessCartPole");
    }

    #[test]
    fn verdict_is_by_two_standard_errors_of_both() {
        let ours = Sample { n: 2, mean: 0.5, std: Some(0.1) };
        // 2 sqrt(0.01 / 2 + 0.0012 / 3) = 2 sqrt(0.0054) = 0.14697, and half a unit of the third place.
        let verdict = |mean: f64| Verdict::new(&ours, &Score { mean, std: 0.0012_f64.sqrt() });
        assert!((verdict(0.4).bound - 0.147_469_384_566_99).abs() < 1e-12);
        assert!(verdict(0.4).within() && verdict(0.64).within() && verdict(0.4).both_errors);
        assert!(!verdict(0.35).within() && !verdict(0.65).within());
        assert!((verdict(0.35).difference - 0.15).abs() < 1e-12);
        // Of one seed: 2 sqrt(0.0012 / 3) = 0.04, and again 0.0005.
        let one = Verdict::new(&Sample { n: 1, mean: 0.5, std: None }, &Score { mean: 0.45, std: 0.0012_f64.sqrt() });
        assert!((one.bound - 0.0405).abs() < 1e-12 && !one.both_errors && !one.within());
        // The paper's 1.000 may be 0.9995.
        let exact = |mean| Verdict::new(&Sample { n: 1, mean, std: None }, &Score { mean: 1.0, std: 0.0 });
        assert!(exact(0.9996).within() && !exact(0.9994).within());
        assert!((exact(1.0).bound - 0.0005).abs() < 1e-12);
    }

    #[test]
    fn what_must_be_known_is_noted() {
        let root = tempfile::tempdir().unwrap();
        let short = [(60_000, 200, 0.96)];
        let budget = Some(1_000_000);
        RunFiles { stopped_by: "mmer", budget, ..RunFiles::default() }.write(&root.path().join("0"), &short);
        RunFiles { seed: 1, stopped_by: "", budget, ..RunFiles::default() }
            .write(&root.path().join("1"), &[(70_000, 200, 0.5)]);
        RunFiles { seed: 2, ..RunFiles::default() }.write(&root.path().join("2"), &[(80_000, 200, 0.7)]);
        let cells = cells(collected(&[root.path()]).unwrap().runs).unwrap();
        assert_eq!(
            cells[0].notes,
            [
                "1 of 3 not finished",
                "1 of 3 stopped early at its target, so MMER and MMER-65k are lower bounds",
                "1 of 3 without a block of 65,536 steps",
                "the seeds differ in steps, stop_at_mmer",
            ]
        );
        assert_eq!((cells[0].budgets(), cells[0].steps()), ((80_000, 1_000_000), (60_000, 80_000)));
        assert_eq!(cells[0].stopped_early(), 1);
        assert!((cells[0].mmer_65k.unwrap().mean - 0.6).abs() < 1e-12);
        assert_eq!(cells[0].mmer_65k.unwrap().n, 2);
        assert_eq!((cells[0].verdict, cells[0].lower_bound()), (None, true));
    }

    #[test]
    fn no_verdict_where_the_good_part_of_a_run_does_not_count() {
        let verdict = |files: RunFiles<'_>, epochs: &[(u64, u64, f64)]| {
            let root = tempfile::tempdir().unwrap();
            files.write(&root.path().join("0"), epochs);
            RunFiles { seed: 1, ..RunFiles::default() }.write(&root.path().join("1"), &[(70_000, 200, 0.5)]);
            let cells = cells(collected(&[root.path()]).unwrap().runs).unwrap();
            assert!(cells[0].mmer_65k.is_some() && cells[0].paper.is_some());
            cells[0].verdict.is_some()
        };
        assert!(verdict(RunFiles::default(), &[(70_000, 200, 0.5)]));
        // It mastered the task after its only complete block: MMER 0.98, MMER-65k 0.5.
        let stopped = || RunFiles { stopped_by: "mmer", budget: Some(1_000_000), ..RunFiles::default() };
        assert!(!verdict(stopped(), &[(70_000, 200, 0.5), (60_000, 200, 0.98)]));
        assert!(!verdict(stopped(), &[(60_000, 200, 0.98)]));
        // No block at all, for want of steps.
        assert!(!verdict(RunFiles::default(), &[(60_000, 200, 0.5)]));
    }

    #[test]
    fn shorter_episodes_are_not_set_beside_the_paper() {
        let root = tempfile::tempdir().unwrap();
        RunFiles { keys: "max_episode_steps = 20\n", ..RunFiles::default() }.write(root.path(), &[(70_000, 200, 0.5)]);
        let cells = cells(collected(&[root.path()]).unwrap().runs).unwrap();
        assert_eq!((cells[0].paper, cells[0].verdict), (None, None));
        assert_eq!(cells[0].notes, ["not the benchmark's task: episodes are cut after 20 steps", "one seed"]);
    }
}
