//! `index.html`: the whole report on one page that needs nothing else.

use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::cell::{Cell, seeds, steps};
use super::collect::{Note, by_text};
use super::compared::Compared;
use super::figures::{Figure, Section};
use super::findings::{Ranking, largest_differences};
use super::{paper, tables, text, words};

/// Rows of the table of the largest differences.
const DIFFERENCES: usize = 12;

/// Text of more characters than this may stand in several lines of a table.
const LONG: usize = 40;

/// The column that is left out of all tables where all runs have the same preset.
const PRESET: &str = "Preset";

/// What the page shows.
pub struct Page<'a> {
    /// The table's cells.
    pub cells: &'a [Cell],
    /// What is not in the figures.
    pub left_out: &'a [Note],
    /// The comparisons that the cells allow.
    pub comparisons: &'a [Compared<'a>],
    /// The single-value scores: with and, where there are any, without the labyrinths.
    pub scores: &'a [Figure],
    /// All other figures.
    pub sections: &'a [Section],
}

impl Page<'_> {
    /// The page.
    pub fn html(&self) -> String {
        document("MMER beside the paper", &self.body()).into_string()
    }

    fn body(&self) -> Markup {
        html! {
            h1 { "MMER beside the paper" }
            (self.head())
            (self.contents())
            (self.winners())
            (self.scores())
            (self.tables())
            @for (i, section) in self.sections.iter().enumerate() { (figures(&format!("figures-{i}"), section)) }
            (methods())
            (self.notes())
        }
    }

    fn head(&self) -> Markup {
        let list = |lines: Vec<String>| html! { ul { @for line in lines { li { (line) } } } };
        let other = words::disagreements(self.cells);
        html! {
            section #summary {
                h2 { "What was run" } (list(words::what_was_run(self.cells, self.left_out)))
                h2 { "What agrees with the paper" } (list(words::agreements(self.cells, self.comparisons)))
                @if !other.is_empty() { h2 { "What does not" } (list(other)) }
            }
        }
    }

    fn contents(&self) -> Markup {
        html! {
            nav aria-label="Contents" {
                a href="#winners" { "Who wins" } " " a href="#scores" { "Scores" } " " a href="#tables" { "Tables" }
                @for (i, section) in self.sections.iter().enumerate() { " " a href={ "#figures-" (i) } { (section.title) } }
                " " a href="#methods" { "Methods" } " " a href="#notes" { "Notes" }
            }
        }
    }

    fn winners(&self) -> Markup {
        let rankings = Ranking::all(self.cells);
        let correlation =
            |value: Option<f64>| value.map_or_else(|| text::NONE.to_owned(), |value| format!("{value:+.2}"));
        let row = |ranking: &Ranking<'_>| {
            let (here, there) = (ranking.winner(), ranking.paper_winner());
            let missing =
                if ranking.missing > 0 { format!(" ({} more not compared)", ranking.missing) } else { String::new() };
            vec![
                here.marked_env(),
                here.task.preset.clone(),
                format!("{}{missing}", ranking.cells.len()),
                format!("{} {}", here.marked_memory(), text::sample(here.mmer_65k.as_ref())),
                text::steps_of(here),
                format!("{} {}", there.marked_memory(), text::number(there.paper.map(|score| score.mean))),
                there.paper_steps().map_or_else(String::new, text::steps),
                if ranking.agrees() { "yes" } else { "no" }.to_owned(),
                correlation(ranking.correlation),
                correlation(ranking.unmarked_correlation),
            ]
        };
        let head = [
            "Environment",
            PRESET,
            "Memories",
            "Best here",
            "Steps",
            "Best in paper",
            "Steps",
            "Same",
            "Rank corr.",
            "Without *",
        ];
        let largest = largest_differences(self.cells, DIFFERENCES);
        let largest: Vec<Vec<String>> = largest.into_iter().map(|cell| tables::beside_paper(cell).to_vec()).collect();
        html! {
            section #winners {
                h2 { "Who wins" }
                p { "By MMER-65k, among memories that can be set beside the paper; of equals any counts. Environments in which \
                     a run stopped at its target are left out. The rank correlation (Spearman) is over these memories, where \
                     there are three or more, and again over those without an asterisk. An asterisk: the paper's figure is of \
                     another model, or of other rules (see " a href="#methods" { "Methods" } ")." }
                (self.table(&head, &rankings.iter().map(row).collect::<Vec<_>>()))
                h3 { "Largest differences" }
                (self.table(&tables::BESIDE_PAPER, &largest))
            }
        }
    }

    fn scores(&self) -> Markup {
        let head = ["Memory", "MMER", "MMER-65k", "Paper"];
        let rows = |compared: &Compared<'_>| {
            let scores = compared.scores().into_iter();
            let row = |s: super::compared::Scores| {
                vec![s.marked_memory(), text::number(s.mmer), text::number(s.mmer_65k), text::number(s.paper)]
            };
            scores.map(row).collect::<Vec<_>>()
        };
        html! {
            section #scores {
                h2 { "Single-value scores" }
                p { "The plain mean of MMER over environments, as in the paper; only over environments that all the memories \
                     have. MMER-65k and the paper are over those of them in which every memory can be set beside the paper. An \
                     asterisk: the paper's figures are of another model." }
                (grid(self.scores))
                @for compared in self.comparisons {
                    @let fewer = compared.without_labyrinths();
                    h3 { (compared.title()) }
                    (extent(compared))
                    (table(&head, &rows(compared)))
                    @if let Some(fewer) = fewer {
                        h3 { (fewer.title()) ", without the labyrinths" }
                        (extent(&fewer))
                        (table(&head, &rows(&fewer)))
                    }
                }
                @if self.comparisons.is_empty() { p { "No environment has runs of two memories or more." } }
            }
        }
    }

    fn tables(&self) -> Markup {
        let matrix = tables::matrix(self.cells);
        let head: Vec<&str> = matrix[0].iter().map(String::as_str).collect();
        let mut by_group: Vec<(&str, Vec<&Cell>)> = Vec::new();
        for cell in self.cells {
            match by_group.iter_mut().find(|(group, _)| *group == cell.task.group) {
                Some((_, cells)) => cells.push(cell),
                None => by_group.push((&cell.task.group, vec![cell])),
            }
        }
        let mut beside = tables::BESIDE_PAPER.to_vec();
        beside.push("Notes");
        let row = |cell: &&Cell| {
            let mut row = tables::beside_paper(cell).to_vec();
            row.push(text::notes(cell));
            row
        };
        html! {
            section #tables {
                h2 { "MMER by environment and memory" }
                p { "Mean ± sample standard deviation over seeds, then environment steps." }
                div.matrix { (self.table(&head, &matrix[1..])) }
                h2 { "Beside the paper" }
                p { "An asterisk: the paper's figure is of something else; the last column says why." }
                @for (group, cells) in by_group {
                    details open {
                        summary { (group) ", " (text::plural(cells.len(), "result")) }
                        (self.table(&beside, &cells.iter().map(row).collect::<Vec<_>>()))
                    }
                }
            }
        }
    }

    /// A table, without the presets if all runs have the same: the head of the page says which.
    fn table(&self, head: &[&str], rows: &[Vec<String>]) -> Markup {
        let several = self.cells.windows(2).any(|pair| pair[0].task.preset != pair[1].task.preset);
        let kept = |i: usize| several || head[i] != PRESET;
        let short: Vec<&str> = (0..head.len()).filter(|i| kept(*i)).map(|i| head[i]).collect();
        let row = |row: &Vec<String>| (0..row.len()).filter(|i| kept(*i)).map(|i| row[i].clone()).collect();
        table(&short, &rows.iter().map(row).collect::<Vec<_>>())
    }

    fn notes(&self) -> Markup {
        html! {
            section #notes {
                h2 { "Notes" }
                @if self.left_out.is_empty() { p { "Every run that was found is in the figures, and none failed." } }
                @for (text, dirs) in by_text(self.left_out) {
                    p { (text::plural(dirs.len(), "run")) " " (text) ":" }
                    ul { @for dir in dirs { li { code { (dir.display()) } } } }
                }
            }
        }
    }
}

fn extent(compared: &Compared<'_>) -> Markup {
    html! {
        p { "MMER over " (compared.tasks.len()) ", MMER-65k and the paper over " (compared.beside_paper()) " environments; "
            (seeds(compared.cells())) ", " (text::span(steps(compared.cells()))) " steps here, 15M (DNC 10M) in the paper." }
    }
}

fn methods() -> Markup {
    let marked = paper::MEMORIES.iter().filter_map(|memory| Some((*memory, paper::memory_mark(memory)?)));
    let games = ["CountRecall", "MineSweeper"].into_iter().filter_map(|game| Some((game, paper::game_mark(game)?)));
    html! {
        section #methods {
            h2 { "Methods" }
            dl {
                dt { "MMER" }
                dd { "The maximum over epochs of the mean return of the epoch's episodes, or of the last 100 episodes if it has \
                      fewer." }
                dt { "MMER-65k" }
                dd { "A maximum over many small epochs is biased upward. So consecutive epochs are joined into blocks of at least \
                      65,536 environment steps, the paper's batch; a block's value is the mean return of its episodes, or, of \
                      fewer than 100, the mean of the last 100; MMER-65k is the maximum over complete blocks. A run that ended \
                      before the first block has none: –. A run that stops at its target mostly has its best part in an \
                      incomplete block: its MMER-65k is a lower bound, and is not compared with the paper." }
                dt { "Within 2 s.e." }
                dd { "|d| ≤ 2 √(s₁²/n₁ + s₂²/n₂) + 0.0005, with d our MMER-65k minus the paper's mean, s the sample standard deviations, n \
                      the numbers of seeds (the paper's: 3), and half a unit of the last place that the paper prints. With \
                      one seed of ours only the paper's error is known, and the first term is left out." }
                dt { "Intervals" }
                dd { "95% percentile bootstrap of the mean over seeds, 2000 resamples, always the same. None of one seed." }
                dt { "Steps" }
                dd { "Environment steps done, “of” the budget where a run has not reached it. The paper: 15M, DNC 10M." }
                dt { "Presets" }
                dd { "After a preset's name stands what the runs changed of its hyper-parameters: other values are another thing." }
                dt { "Names" }
                dd { "What is PositionOnly… here is Stateless… in the paper." }
                @for (name, mark) in marked.chain(games) { dt { (name) "*" } dd { (mark) } }
            }
        }
    }
}

fn figures(id: &str, section: &Section) -> Markup {
    html! { section id=(id) { h2 { (section.title) } p { (section.text) } (grid(&section.figures)) } }
}

/// Figures beside one another, as many as there is room for.
pub fn grid(figures: &[Figure]) -> Markup {
    html! {
        div.grid {
            @for figure in figures {
                figure id=(figure.name) {
                    div role="img" aria-label=(figure.title) { (PreEscaped(&figure.svg)) }
                    figcaption { (figure.caption) }
                }
            }
        }
    }
}

/// A table that scrolls in its own box where it is too wide; without rows, a sentence.
pub fn table(head: &[&str], rows: &[Vec<String>]) -> Markup {
    if rows.is_empty() {
        return html! { p { "There are none." } };
    }
    // Numbers stand right, text left, and long text has room for several lines.
    let class = |cell: &str| {
        let number = cell.starts_with(|c: char| c.is_ascii_digit() || "+-–".contains(c));
        if cell.chars().count() > LONG { Some("w") } else { number.then_some("n") }
    };
    html! {
        div.box tabindex="0" role="region" aria-label=(head.join(", ")) {
            table {
                thead { tr { @for name in head { th scope="col" { (name) } } } }
                tbody {
                    @for row in rows {
                        tr {
                            @for (i, cell) in row.iter().enumerate() {
                                @if i == 0 { th scope="row" { (cell) } } @else { td class=[class(cell)] { (cell) } }
                            }
                        }
                    }
                }
            }
        }
    }
}

/// A page that fetches nothing.
pub fn document(title: &str, body: &Markup) -> Markup {
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (title) }
                style { (PreEscaped(include_str!("page.css"))) }
            }
            body { main { (body) } }
        }
    }
}
