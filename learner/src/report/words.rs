//! The report's head in plain words.

use super::cell::Cell;
use super::collect::Note;
use super::compared::Compared;
use super::findings::{Agreement, Ranking, largest_differences};
use super::text::{plural, span, steps};
use super::{paper, tables};

/// A difference of at least this much of MMER is named as large.
const LARGE: f64 = 0.2;

/// What was run: numbers, budgets, what is missing.
pub fn what_was_run(cells: &[Cell], left_out: &[Note]) -> Vec<String> {
    let runs = || cells.iter().flat_map(|cell| &cell.runs);
    let mut envs: Vec<&str> = cells.iter().map(|cell| cell.task.env.as_str()).collect();
    envs.sort_unstable();
    envs.dedup();
    let mut presets: Vec<&str> = cells.iter().map(|cell| cell.task.preset.as_str()).collect();
    presets.sort_unstable();
    presets.dedup();
    let seeds = || cells.iter().map(|cell| cell.runs.len());
    let (fewest, most) = (seeds().min().unwrap_or(0), seeds().max().unwrap_or(0));
    let seeds = if fewest == most { plural(most, "seed") } else { format!("{fewest} to {most} seeds") };
    let range = |value: fn(&super::run::Run) -> u64| {
        (runs().map(value).min().unwrap_or(0), runs().map(value).max().unwrap_or(0))
    };
    let budget = range(|run| run.budget);
    let mut lines = vec![
        format!(
            "{}: {}, {}, {seeds} of each; preset {}.",
            plural(runs().count(), "run"),
            plural(envs.len(), "environment"),
            if tables::memories(cells).len() == 1 {
                "1 memory".to_owned()
            } else {
                format!("{} memories", tables::memories(cells).len())
            },
            presets.join(", "),
        ),
        format!(
            "Step budget {}; steps done {}. The paper's runs had 15M steps (DNC: 10M), {} times our largest budget or more, \
             and {} trials each.",
            span(budget),
            span(range(|run| run.steps)),
            short_ratio(budget.1),
            paper::TRIALS
        ),
    ];
    let early = runs().filter(|run| run.stopped_early()).count();
    if early > 0 {
        lines.push(format!(
            "{} stopped before the budget, when MMER had reached the target: there, MMER is the least that the memory can do.",
            plural(early, "run")
        ));
    }
    let unfinished = runs().filter(|run| !run.complete()).count();
    if unfinished > 0 {
        lines.push(format!("{} not finished, but counted as far as it went.", plural(unfinished, "run")));
    }
    if !left_out.is_empty() {
        let noun = if left_out.len() == 1 { "directory is" } else { "directories are" };
        lines.push(format!("{} {noun} not in the figures: the notes at the end say why.", left_out.len()));
    }
    lines
}

/// The paper's steps as a multiple of `budget`.
fn short_ratio(budget: u64) -> String {
    let ratio = paper::steps("DNC") as f64 / budget.max(1) as f64;
    if ratio < 9.95 { format!("{ratio:.1}") } else { format!("{ratio:.0}") }
}

/// What agrees with the paper.
pub fn agreements(cells: &[Cell]) -> Vec<String> {
    let agreement = Agreement::of(cells.iter());
    if agreement.compared() == 0 {
        return vec!["Nothing can be set beside the paper: no environment and memory has both a block of 65,536 steps here and a figure there.".into()];
    }
    let one_seed = cells.iter().filter(|cell| cell.verdict.is_some_and(|verdict| !verdict.both_errors)).count();
    let error = if one_seed > 0 {
        format!(" (in {one_seed} of them one seed of ours, so by the paper's error alone)")
    } else {
        String::new()
    };
    let mut lines = vec![format!(
        "{} of {} results (one memory in one environment) are within two standard errors of the paper's{error}.",
        agreement.within,
        agreement.compared()
    )];
    let rankings = Ranking::all(cells);
    let same: Vec<String> = rankings.iter().filter(|ranking| ranking.agrees()).map(|r| won(r, r.winner())).collect();
    if !rankings.is_empty() {
        let named = if same.is_empty() { String::new() } else { format!(": {}", listed(&same)) };
        let of = plural(rankings.len(), "environment");
        lines.push(format!("The memory that is best here is also best in the paper in {} of {of}{named}.", same.len()));
    }
    for compared in Compared::all(cells) {
        if let Some(correlation) = compared.rank_correlation() {
            lines.push(format!(
                "Over the {} of {} that have all figures, the memories' order has a rank correlation of {correlation:+.2} with \
                 the paper's.",
                compared.beside_paper(),
                compared.title()
            ));
        }
    }
    lines
}

/// What does not agree.
pub fn disagreements(cells: &[Cell]) -> Vec<String> {
    let agreement = Agreement::of(cells.iter());
    let mut lines = Vec::new();
    if agreement.higher + agreement.lower > 0 {
        lines.push(format!(
            "{} of {} results are higher than the paper's by more than two standard errors, {} lower.",
            agreement.higher,
            agreement.compared(),
            agreement.lower
        ));
    }
    let others: Vec<String> = Ranking::all(cells)
        .iter()
        .filter(|ranking| !ranking.agrees())
        .map(|ranking| {
            format!("{} (in the paper {})", won(ranking, ranking.winner()), ranking.paper_winner().paper_memory)
        })
        .collect();
    if !others.is_empty() {
        let of = plural(Ranking::all(cells).len(), "environment");
        lines.push(format!("Another memory is best in {} of {of}: {}.", others.len(), listed(&others)));
    }
    let large: Vec<String> = largest_differences(cells, 5)
        .into_iter()
        .filter_map(|cell| {
            let difference = cell.verdict.filter(|verdict| verdict.difference.abs() >= LARGE)?.difference;
            let ours = span(cell.steps());
            let steps = cell
                .paper_steps()
                .map_or_else(String::new, |paper| format!(" ({ours} steps against {})", steps(paper)));
            Some(format!("{} in {} {difference:+.2}{steps}", cell.marked_memory(), cell.task.env))
        })
        .collect();
    if !large.is_empty() {
        lines.push(format!("The largest differences: {}.", listed(&large)));
    }
    if agreement.unknown > 0 {
        lines.push(format!(
            "{} cannot be set beside the paper: no block of 65,536 steps here, or no figure there.",
            plural(agreement.unknown, "result")
        ));
    }
    lines
}

fn won(ranking: &Ranking<'_>, cell: &Cell) -> String {
    format!("{} in {}", cell.paper_memory, ranking.cells[0].task.env)
}

/// The first dozen, with commas.
fn listed(items: &[String]) -> String {
    const MOST: usize = 12;
    let shown = items.iter().take(MOST).cloned().collect::<Vec<_>>().join(", ");
    let more = items.len().saturating_sub(MOST);
    if more > 0 { format!("{shown} and {more} more") } else { shown }
}

#[cfg(test)]
mod tests {
    use super::super::samples::cells_of;
    use super::*;

    #[test]
    fn the_head_of_a_report() {
        let cells = cells_of(&[
            ("AutoencodeEasy", "mlp", &[-0.47]),
            ("AutoencodeEasy", "gru", &[0.9]),
            ("AutoencodeEasy", "lstm", &[0.1]),
            ("RepeatPreviousEasy", "gru", &[0.5, 0.5]),
        ]);
        let run = what_was_run(&cells, &[Note { dir: "x".into(), text: "y".into() }]);
        assert_eq!(run[0], "5 runs: 2 environments, 3 memories, 1 to 2 seeds of each; preset quick.");
        assert!(
            run[1].starts_with("Step budget 1M; steps done 70k. The paper's runs had 15M steps (DNC: 10M), 10 times")
        );
        assert_eq!(run[2], "1 directory is not in the figures: the notes at the end say why.");
        let same = agreements(&cells);
        assert!(same[0].starts_with("1 of 4 results") && same[0].contains("in 3 of them one seed"), "{same:?}");
        assert_eq!(
            same[1],
            "The memory that is best here is also best in the paper in 1 of 1 environment: GRU in AutoencodeEasy."
        );
        assert!(same[2].ends_with("a rank correlation of +1.00 with the paper's."), "{same:?}");
        let other = disagreements(&cells);
        assert_eq!(other[0], "2 of 4 results are higher than the paper's by more than two standard errors, 1 lower.");
        assert!(other[1].contains("GRU in AutoencodeEasy +1.18 (70k steps against 15M)"), "{other:?}");
    }
}
