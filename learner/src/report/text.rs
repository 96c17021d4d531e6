//! Numbers in words and tables.

use super::cell::Cell;
use crate::statistics::Sample;

/// What stands where there is no number.
pub const NONE: &str = "–";

/// A count of steps with three digits: 164220 is 164k.
pub fn steps(count: u64) -> String {
    let (value, unit) = match count {
        // What rounds to 1000k is 1M.
        999_500.. => (count as f64 / 1e6, "M"),
        1_000.. => (count as f64 / 1e3, "k"),
        _ => (count as f64, ""),
    };
    let places = if value < 10.0 { 2 } else { usize::from(value < 100.0) };
    let text = format!("{value:.places$}");
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    format!("{text}{unit}")
}

/// One count, or the range between two.
pub fn span((least, most): (u64, u64)) -> String {
    let (least, most) = (steps(least), steps(most));
    if least == most { least } else { format!("{least}–{most}") }
}

/// How many steps a cell's runs did, and of how many, if they did not all do as many as they should.
pub fn steps_of(cell: &Cell) -> String {
    let done = cell.runs.iter().all(|run| run.steps >= run.budget);
    if done { span(cell.steps()) } else { format!("{} of {}", span(cell.steps()), span(cell.budgets())) }
}

/// Three places; a dash for none.
pub fn number(value: Option<f64>) -> String {
    // No negative zero.
    value.map_or_else(|| NONE.to_owned(), |value| format!("{:.3}", (value * 1e3).round() / 1e3 + 0.0))
}

/// Three places and a sign; a dash for none.
pub fn signed(value: Option<f64>) -> String {
    value.map_or_else(|| NONE.to_owned(), |value| format!("{value:+.3}"))
}

/// Mean and, if there is one, standard deviation.
pub fn sample(sample: Option<&Sample>) -> String {
    let Some(Sample { mean, std, .. }) = sample else { return NONE.to_owned() };
    let std = std.map_or_else(String::new, |std| format!(" ± {std:.3}"));
    format!("{}{std}", number(Some(*mean)))
}

/// Mean and standard deviation of the best blocks, and of how many seeds they are if not all have one.
pub fn best_blocks(cell: &Cell) -> String {
    let (seeds, all) = (cell.mmer_65k.map_or(0, |sample| sample.n), cell.runs.len());
    let part = if seeds > 0 && seeds < all { format!(" ({seeds} of {all} seeds)") } else { String::new() };
    format!("{}{part}", sample(cell.mmer_65k.as_ref()))
}

/// Whether ours is within two standard errors of the paper's.
pub fn within(cell: &Cell) -> &'static str {
    match cell.verdict {
        None if cell.paper.is_some() && cell.lower_bound() => "lower bound: stopped at its target",
        None => NONE,
        Some(verdict) if verdict.within() => "yes",
        Some(verdict) if verdict.difference > 0.0 => "no, higher",
        Some(_) => "no, lower",
    }
}

/// The marks and notes of a cell, in one line.
pub fn notes(cell: &Cell) -> String {
    let marks = cell.marks().into_iter().map(str::to_owned);
    marks.chain(cell.notes.iter().cloned()).collect::<Vec<_>>().join("; ")
}

/// `count` and the noun, in the plural unless there is one.
pub fn plural(count: usize, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}

/// Rows with columns as wide as their widest cell; the first column stands left, all others right.
pub fn aligned(rows: &[Vec<String>]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns)
        .map(|i| rows.iter().filter_map(|row| row.get(i)).map(|c| c.chars().count()).max().unwrap_or(0))
        .collect();
    let line = |row: &Vec<String>| {
        let cells = row.iter().zip(&widths).enumerate();
        let cells = cells.map(|(i, (c, &width))| if i == 0 { format!("{c:<width$}") } else { format!("{c:>width$}") });
        cells.collect::<Vec<_>>().join("  ").trim_end().to_owned()
    };
    rows.iter().map(line).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::super::cell::cells;
    use super::super::samples::{RunFiles, cells_of, collected};
    use super::*;

    #[test]
    fn counts_of_steps() {
        let found =
            [0, 999, 1000, 65_536, 164_220, 999_499, 999_500, 999_999, 1_000_000, 1_003_520, 15_000_000].map(steps);
        assert_eq!(found, ["0", "999", "1k", "65.5k", "164k", "999k", "1M", "1M", "1M", "1M", "15M"]);
        assert_eq!(span((500_000, 1_001_000)), "500k–1M");
        assert_eq!(span((1_000_001, 1_000_900)), "1M");
    }

    #[test]
    fn numbers() {
        assert_eq!([Some(0.5), Some(-0.0004), None].map(number), ["0.500", "0.000", "–"]);
        assert_eq!([Some(0.5), Some(-0.25), None].map(signed), ["+0.500", "-0.250", "–"]);
        assert_eq!(sample(Some(&Sample { n: 2, mean: 0.5, std: Some(0.25) })), "0.500 ± 0.250");
        assert_eq!(sample(Some(&Sample { n: 1, mean: 0.5, std: None })), "0.500");
        assert_eq!((plural(1, "run"), plural(2, "run")), ("1 run".to_owned(), "2 runs".to_owned()));
    }

    #[test]
    fn columns_are_aligned() {
        let rows = [["a", "steps"], ["long", "–"]].map(|row| row.map(str::to_owned).to_vec());
        assert_eq!(aligned(&rows), "a     steps\nlong      –");
    }

    #[test]
    fn a_cell_in_words() {
        let cells = cells_of(&[("CountRecallEasy", "fart", &[1.0])]);
        assert_eq!((steps_of(&cells[0]), best_blocks(&cells[0])), ("70k".to_owned(), "1.000".to_owned()));
        assert_eq!(within(&cells[0]), "no, higher");
        let notes = notes(&cells[0]);
        assert!(notes.starts_with("the paper's FART") && notes.contains("largest count"), "{notes}");
        assert!(notes.ends_with("; one seed: only the paper's error is known"));
    }

    #[test]
    fn a_cell_that_stopped_at_its_target() {
        let root = tempfile::tempdir().unwrap();
        RunFiles { stopped_by: "mmer", budget: Some(1_000_000), ..RunFiles::default() }
            .write(&root.path().join("0"), &[(60_000, 200, 0.98)]);
        RunFiles { seed: 1, ..RunFiles::default() }.write(&root.path().join("1"), &[(70_000, 200, 0.5)]);
        let cell = &cells(collected(&[root.path()]).unwrap().runs).unwrap()[0];
        assert_eq!(within(cell), "lower bound: stopped at its target");
        assert_eq!(best_blocks(cell), "0.500 (1 of 2 seeds)");
        assert_eq!(steps_of(cell), "60k–70k of 70k–1M");
    }
}
