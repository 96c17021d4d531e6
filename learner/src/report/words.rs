//! The report's head in plain words.

use super::cell::{self, Cell, budgets, seeds};
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
    let memories = tables::memories(cells).len();
    let budget = budgets(cells);
    let mut lines = vec![
        format!(
            "{}: {}, {}, {} of each; {}{}.",
            plural(runs().count(), "run"),
            plural(envs.len(), "environment"),
            if memories == 1 { "1 memory".to_owned() } else { format!("{memories} memories") },
            seeds(cells),
            if presets.len() == 1 { "preset " } else { "presets " },
            presets.join("; "),
        ),
        format!(
            "Step budget {}; steps done {}. The paper's runs had 15M steps (DNC: 10M){}, and {} trials each.",
            span(budget),
            span(cell::steps(cells)),
            times(budget.1),
            paper::TRIALS
        ),
    ];
    let early = runs().filter(|run| run.stopped_early()).count();
    if early > 0 {
        lines.push(format!(
            "{} stopped before the budget, when MMER had reached the target: there, MMER and MMER-65k are lower bounds, and \
             nothing is compared with the paper.",
            plural(early, "run")
        ));
    }
    let unfinished = runs().filter(|run| !run.complete()).count();
    if unfinished > 0 {
        lines.push(format!("{} not finished, but counted as far as it went.", plural(unfinished, "run")));
    }
    if !left_out.is_empty() {
        let noun = if left_out.len() == 1 { "directory that is" } else { "directories that are" };
        lines.push(format!("{} {noun} not in the figures or failed: see the notes at the end.", left_out.len()));
    }
    lines
}

/// The paper's fewest steps as a multiple of `budget`, in words; nothing if they are not more.
fn times(budget: u64) -> String {
    match paper::steps("DNC") as f64 / budget.max(1) as f64 {
        ratio if ratio <= 1.0 => String::new(),
        ratio if ratio < 9.95 => format!(", {ratio:.1} times our largest budget or more"),
        ratio => format!(", {ratio:.0} times our largest budget or more"),
    }
}

/// What agrees with the paper.
pub fn agreements(cells: &[Cell], comparisons: &[Compared<'_>]) -> Vec<String> {
    let agreement = Agreement::of(cells.iter());
    if agreement.compared() == 0 {
        return vec![
            "Nothing can be set beside the paper: no environment and memory has a figure there, and here \
                     runs with a block of 65,536 steps that did not stop at a target."
                .into(),
        ];
    }
    let compared = agreement.compared();
    let mut lines = vec![format!(
        "{} of {compared} results (one memory in one environment) {} within two standard errors of the paper's.",
        agreement.within,
        if agreement.within == 1 { "is" } else { "are" },
    )];
    let marked = cells.iter().filter(|cell| !cell.marks().is_empty());
    let marked = Agreement::of(marked);
    if marked.compared() > 0 {
        lines.push(format!(
            "Without those marked with an asterisk, of which the paper's figure is of something else: {} of {}.",
            agreement.within - marked.within,
            compared - marked.compared()
        ));
    }
    let one_seed = cells.iter().filter(|cell| cell.verdict.is_some_and(|verdict| !verdict.both_errors)).count();
    if one_seed > 0 {
        lines.push(format!(
            "Of the {compared}, {one_seed} have one seed of ours: there, only the paper's error counts."
        ));
    }
    let rankings = Ranking::all(cells);
    let same: Vec<String> =
        rankings.iter().filter(|ranking| ranking.agrees()).map(|r| won(cells, r.winner())).collect();
    if !rankings.is_empty() {
        let named = if same.is_empty() { String::new() } else { format!(": {}", listed(&same)) };
        let of = plural(rankings.len(), "environment");
        lines.push(format!("The memory that is best here is also best in the paper in {} of {of}{named}.", same.len()));
    }
    for compared in comparisons {
        let Some(correlation) = compared.rank_correlation() else { continue };
        let unmarked = compared.unmarked_rank_correlation();
        lines.push(format!(
            "{}: over the {} that can be compared, the memories' order has a rank correlation of {correlation:+.2} with the \
             paper's{}.",
            compared.title(),
            plural(compared.beside_paper(), "environment"),
            unmarked.map_or_else(String::new, |value| format!("; without the memories marked *, {value:+.2}"))
        ));
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
            format!("{} (in the paper {})", won(cells, ranking.winner()), ranking.paper_winner().marked_memory())
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
            Some(format!("{} {difference:+.2}{steps}", won(cells, cell)))
        })
        .collect();
    if !large.is_empty() {
        lines.push(format!("The largest differences: {}.", listed(&large)));
    }
    if agreement.lower_bounds > 0 {
        lines.push(format!(
            "{} cannot be set beside the paper because a run stopped at its target: MMER-65k is a lower bound.",
            plural(agreement.lower_bounds, "result")
        ));
    }
    if agreement.unknown > 0 {
        lines.push(format!(
            "{} cannot be set beside the paper: a run without a block of 65,536 steps here, or no figure there.",
            plural(agreement.unknown, "result")
        ));
    }
    lines
}

/// Memory and environment of `cell`, and the preset where not all of `cells` have the same.
fn won(cells: &[Cell], cell: &Cell) -> String {
    let preset = &cell.task.preset;
    let same = cells.iter().all(|other| other.task.preset == *preset);
    let preset = if same { String::new() } else { format!(" ({preset})") };
    format!("{} in {}{preset}", cell.marked_memory(), cell.marked_env())
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
            run[1].starts_with("Step budget 70k; steps done 70k. The paper's runs had 15M steps (DNC: 10M), 143 times")
        );
        assert_eq!(run[2], "1 directory that is not in the figures or failed: see the notes at the end.");
        let same = agreements(&cells, &Compared::all(&cells));
        assert_eq!(
            same[0],
            "1 of 4 results (one memory in one environment) is within two standard errors of the paper's."
        );
        assert_eq!(same[1], "Of the 4, 3 have one seed of ours: there, only the paper's error counts.");
        assert_eq!(
            same[2],
            "The memory that is best here is also best in the paper in 1 of 1 environment: GRU in AutoencodeEasy."
        );
        assert!(same[3].ends_with("a rank correlation of +1.00 with the paper's."), "{same:?}");
        let other = disagreements(&cells);
        assert_eq!(other[0], "2 of 4 results are higher than the paper's by more than two standard errors, 1 lower.");
        assert!(other[1].contains("GRU in AutoencodeEasy +1.18 (70k steps against 15M)"), "{other:?}");
    }

    #[test]
    fn a_budget_above_the_papers_is_no_multiple() {
        let found = [1_000_000, 4_000_000, 10_000_000, 15_000_000].map(times);
        assert_eq!(found, [", 10 times our largest budget or more", ", 2.5 times our largest budget or more", "", ""]);
    }

    #[test]
    fn marked_results_and_lower_bounds_are_told_apart() {
        let mut cells = cells_of(&[
            ("AutoencodeEasy", "fart", &[-0.447]),
            ("AutoencodeEasy", "gru", &[0.9]),
            ("AutoencodeEasy", "lstm", &[0.1]),
        ]);
        let same = agreements(&cells, &[]);
        assert!(same[0].starts_with("1 of 3 results"), "{same:?}");
        assert!(same[1].ends_with("of something else: 0 of 2."), "{same:?}");
        cells[2].runs[0].stopped_by = Some("mmer".into());
        cells[2].runs[0].budget = 1_000_000;
        cells[2].verdict = None;
        let other = disagreements(&cells);
        assert!(
            other.iter().any(|line| line.starts_with("1 result cannot be set beside the paper because a run stopped"))
        );
        assert!(other[0].starts_with("1 of 2 results are higher") && other[0].ends_with("0 lower."), "{other:?}");
    }
}
