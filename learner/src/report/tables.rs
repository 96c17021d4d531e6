//! The tables as Markdown and CSV.

use std::fmt::Write as _;

use serde::Serialize;

use super::cell::Cell;
use super::collect::{Note, by_text};
use super::paper::place;
use super::text;

/// A row of `mmer.csv` and `mmer.parquet`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// Short name of the environment.
    pub env: String,
    /// What kind of environment it is.
    pub group: String,
    /// Its difficulty; empty if it has none.
    pub difficulty: String,
    /// Preset of the runs, and what was changed of it.
    pub preset: String,
    /// Name of the memory.
    pub memory: String,
    /// Its name in the paper's tables, or its own.
    pub paper_memory: String,
    /// Runs.
    pub seeds: u64,
    /// Smallest step budget.
    pub budget_min: u64,
    /// Largest step budget.
    pub budget_max: u64,
    /// Fewest environment steps of a run.
    pub steps_min: u64,
    /// Most environment steps of a run.
    pub steps_max: u64,
    /// Runs that ended before their budget because their MMER was high enough.
    pub stopped_early: u64,
    /// Mean of MMER over the seeds.
    pub mmer_mean: Option<f64>,
    /// Sample standard deviation of MMER.
    pub mmer_std: Option<f64>,
    /// Seeds with a block of 65,536 steps.
    pub mmer_65k_seeds: u64,
    /// Mean of their best blocks.
    pub mmer_65k_mean: Option<f64>,
    /// Sample standard deviation of these.
    pub mmer_65k_std: Option<f64>,
    /// The paper's mean.
    pub paper_mean: Option<f64>,
    /// The paper's standard deviation.
    pub paper_std: Option<f64>,
    /// Environment steps of the paper's runs.
    pub paper_steps: Option<u64>,
    /// `mmer_65k_mean` minus `paper_mean`.
    pub difference: Option<f64>,
    /// Two standard errors of the difference (of one seed, the paper's only), and the half unit by which the paper rounds.
    pub two_standard_errors: Option<f64>,
    /// Whether the difference is within them.
    pub within_two_standard_errors: Option<bool>,
    /// Marks and notes.
    pub notes: String,
}

impl From<&Cell> for Row {
    fn from(cell: &Cell) -> Self {
        let ((budget_min, budget_max), (steps_min, steps_max)) = (cell.budgets(), cell.steps());
        Self {
            env: cell.task.env.clone(),
            group: cell.task.group.clone(),
            difficulty: cell.task.difficulty.map_or_else(String::new, |level| level.to_string()),
            preset: cell.task.preset.clone(),
            memory: cell.memory.clone(),
            paper_memory: cell.paper_memory.clone(),
            seeds: cell.runs.len() as u64,
            budget_min,
            budget_max,
            steps_min,
            steps_max,
            stopped_early: cell.stopped_early() as u64,
            mmer_mean: Some(cell.mmer.mean),
            mmer_std: cell.mmer.std,
            mmer_65k_seeds: cell.mmer_65k.map_or(0, |sample| sample.n as u64),
            mmer_65k_mean: cell.mmer_65k.map(|sample| sample.mean),
            mmer_65k_std: cell.mmer_65k.and_then(|sample| sample.std),
            paper_mean: cell.paper.map(|score| score.mean),
            paper_std: cell.paper.map(|score| score.std),
            paper_steps: cell.paper_steps(),
            difference: cell.verdict.map(|verdict| verdict.difference),
            two_standard_errors: cell.verdict.map(|verdict| verdict.bound),
            within_two_standard_errors: cell.verdict.map(|verdict| verdict.within()),
            notes: text::notes(cell),
        }
    }
}

/// A row of `runs.csv`.
#[derive(Serialize)]
struct RunRow<'a> {
    dir: String,
    env: &'a str,
    group: &'a str,
    preset: &'a str,
    memory: &'a str,
    seed: u64,
    budget: u64,
    stop_at_mmer: Option<f64>,
    steps: u64,
    epochs: u64,
    mmer: f64,
    mmer_65k: Option<f64>,
    final_mean_return: f64,
    wall_seconds: Option<f64>,
    complete: bool,
    stopped_by: Option<&'a str>,
}

/// A row a cell, as CSV.
///
/// # Errors
/// None that can be caused from outside.
pub fn mmer_csv(cells: &[Cell]) -> anyhow::Result<String> {
    csv(cells.iter().map(Row::from))
}

/// A row a run, as CSV.
///
/// # Errors
/// None that can be caused from outside.
pub fn runs_csv(cells: &[Cell]) -> anyhow::Result<String> {
    csv(cells.iter().flat_map(|cell| &cell.runs).map(|run| RunRow {
        dir: run.dir.display().to_string(),
        env: &run.task.env,
        group: &run.task.group,
        preset: &run.task.preset,
        memory: &run.memory,
        seed: run.seed,
        budget: run.budget,
        stop_at_mmer: run.stop_at_mmer,
        steps: run.steps,
        epochs: run.epochs,
        mmer: run.mmer,
        mmer_65k: run.mmer_65k,
        final_mean_return: run.last,
        wall_seconds: run.wall_seconds,
        complete: run.complete(),
        stopped_by: run.stopped_by.as_deref(),
    }))
}

fn csv<R: Serialize>(rows: impl Iterator<Item = R>) -> anyhow::Result<String> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    for row in rows {
        writer.serialize(row)?;
    }
    Ok(String::from_utf8(writer.into_inner()?)?)
}

/// The columns of the comparison with the paper.
pub const BESIDE_PAPER: [&str; 11] = [
    "Environment",
    "Preset",
    "Memory",
    "Seeds",
    "Our steps",
    "MMER",
    "MMER-65k",
    "Paper",
    "Paper's steps",
    "Difference",
    "Within 2 s.e.",
];

/// A cell's row of it.
pub fn beside_paper(cell: &Cell) -> [String; 11] {
    let paper = cell.paper.map(|score| format!("{:.3} ± {:.3}", score.mean, score.std));
    [
        cell.marked_env(),
        cell.task.preset.clone(),
        cell.marked_memory(),
        cell.runs.len().to_string(),
        text::steps_of(cell),
        text::sample(Some(&cell.mmer)),
        text::best_blocks(cell),
        paper.unwrap_or_else(|| text::NONE.to_owned()),
        cell.paper_steps().map_or_else(|| text::NONE.to_owned(), text::steps),
        text::signed(cell.verdict.map(|verdict| verdict.difference)),
        text::within(cell).to_owned(),
    ]
}

/// Both tables as a Markdown document: MMER by environment and memory, and each cell beside the paper.
pub fn mmer_markdown(cells: &[Cell], left_out: &[Note]) -> String {
    let mut out = String::from("# MMER by environment and memory\n\n");
    out += "Mean ± sample standard deviation over seeds, then environment steps; the paper's are of 15M steps (DNC: 10M).\n\n";
    out += &markdown(&matrix(cells));
    out += "\n## Beside the paper\n\nMMER-65k is the best block of at least 65,536 steps, the paper's batch. Within 2 s.e.: \
        |difference| <= 2 sqrt(s1^2 / n1 + s2^2 / n2) + 0.0005, the paper's n being 3 and its last place rounded; of one seed \
        only the paper's error is known. A run that stops at its target mostly has its best part in an incomplete block, so its \
        MMER-65k is a lower bound, and is not compared. An asterisk: the paper's figure is of something else, see the notes.\n\n";
    let mut head: Vec<String> = BESIDE_PAPER.iter().map(|name| (*name).to_owned()).collect();
    head.push("Notes".to_owned());
    let rows = cells.iter().map(|cell| {
        let mut line = beside_paper(cell).to_vec();
        line.push(text::notes(cell));
        line
    });
    out += &markdown(&std::iter::once(head).chain(rows).collect::<Vec<_>>());
    if !left_out.is_empty() {
        out += "\n## Notes\n\n";
        for (text, dirs) in by_text(left_out) {
            let dirs: Vec<String> = dirs.iter().map(|dir| escaped(&dir.display().to_string())).collect();
            let _ = writeln!(out, "- {}: {}", escaped(text), dirs.join(", "));
        }
    }
    out
}

/// MMER by environment and memory, with its head.
pub fn matrix(cells: &[Cell]) -> Vec<Vec<String>> {
    let names = memories(cells);
    let mut table = vec![vec!["Environment".to_owned(), "Preset".to_owned()]];
    table[0].extend(names.iter().cloned());
    for row in cells.chunk_by(|a, b| a.task.key() == b.task.key()) {
        let shown = |name: &String| {
            let cell = row.iter().find(|cell| cell.paper_memory == *name)?;
            Some(format!("{} ({})", text::sample(Some(&cell.mmer)), text::steps_of(cell)))
        };
        let mut line = vec![row[0].task.env.clone(), row[0].task.preset.clone()];
        line.extend(names.iter().map(|name| shown(name).unwrap_or_else(|| text::NONE.to_owned())));
        table.push(line);
    }
    table
}

/// The memories of the cells, in the paper's order; others after them.
pub fn memories<'a>(cells: impl IntoIterator<Item = &'a Cell>) -> Vec<String> {
    let mut names: Vec<String> = cells.into_iter().map(|cell| cell.paper_memory.clone()).collect();
    names.sort_by(|a, b| (place(a), a).cmp(&(place(b), b)));
    names.dedup();
    names
}

/// A table whose first line is its head.
fn markdown(table: &[Vec<String>]) -> String {
    let mut out = String::new();
    for (i, line) in table.iter().enumerate() {
        let cells: Vec<String> = line.iter().map(|cell| escaped(cell)).collect();
        let _ = writeln!(out, "| {} |", cells.join(" | "));
        if i == 0 {
            let _ = writeln!(out, "|{}", "---|".repeat(line.len()));
        }
    }
    out
}

/// Text in which nothing is Markdown.
fn escaped(text: &str) -> String {
    let mut out = String::new();
    for symbol in text.chars() {
        if "\\|*_`<[]".contains(symbol) {
            out.push('\\');
        }
        out.push(if symbol.is_control() { ' ' } else { symbol });
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::samples::cells_of;
    use super::*;

    #[test]
    fn csv_has_every_column() {
        let cells = cells_of(&[("RepeatFirstEasy", "gru", &[1.0, 0.5]), ("VelocityOnlyCartPoleEasy", "fart", &[0.5])]);
        let text = mmer_csv(&cells).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(
            lines[0],
            "env,group,difficulty,preset,memory,paper_memory,seeds,budget_min,budget_max,steps_min,steps_max,stopped_early,\
             mmer_mean,mmer_std,mmer_65k_seeds,mmer_65k_mean,mmer_65k_std,paper_mean,paper_std,paper_steps,difference,\
             two_standard_errors,within_two_standard_errors,notes"
        );
        let start = "RepeatFirstEasy,diagnostic,Easy,quick,gru,GRU,2,70000,70000,70000,70000,0,0.75,0.35355339059327";
        assert!(lines[1].starts_with(start), "{}", lines[1]);
        assert!(lines[2].contains(",0.5,,1,0.5,,,,,,,,one seed"), "{}", lines[2]);
        let runs = runs_csv(&cells).unwrap();
        assert_eq!(runs.lines().count(), 4);
        assert!(runs.contains(",RepeatFirstEasy,diagnostic,quick,gru,1,70000,,70000,1,0.5,0.5,0.5,70.0,true,steps"));
    }

    #[test]
    fn markdown_shows_steps_marks_and_what_is_left_out() {
        let cells = cells_of(&[("RepeatFirstEasy", "gru", &[1.0]), ("RepeatFirstHard", "fart", &[0.5, 0.5])]);
        let notes = [Note { dir: "a|b".into(), text: "left out".into() }];
        let text = mmer_markdown(&cells, &notes);
        for expected in [
            "| Environment | Preset | FART | GRU |\n|---|---|---|---|\n",
            "| RepeatFirstEasy | quick | – | 1.000 (70k) |",
            "| RepeatFirstHard | quick | 0.500 ± 0.000 (70k) | – |",
            r"| RepeatFirstHard | quick | FART\* | 2 | 70k | 0.500 ± 0.000 | 0.500 ± 0.000 |",
            "| 15M |",
            r"- left out: a\|b",
        ] {
            assert!(text.contains(expected), "no `{expected}` in\n{text}");
        }
    }
}
