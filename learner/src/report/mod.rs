//! Reports: what any set of runs came to, beside the paper.
//!
//! | module | holds |
//! |---|---|
//! | [`collect`], [`run`], [`blocks`], [`changes`] | run directories, found and read |
//! | [`cell`], [`compared`], [`findings`] | seeds joined; memories compared; what agrees with the paper |
//! | [`paper`] | the paper's figures, and what has to be known about them |
//! | [`tables`], [`parquet_table`], [`figures`], [`page`], [`words`] | what is written |
//! | [`comparison`], [`labels`] | single runs, one over the other |

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

use anyhow::Context as _;

use crate::files;

pub mod blocks;
pub mod cell;
pub mod changes;
pub mod collect;
pub mod compared;
pub mod comparison;
pub mod figures;
pub mod findings;
pub mod labels;
pub mod page;
pub mod paper;
pub mod parquet_table;
pub mod run;
#[cfg(test)]
mod samples;
pub mod tables;
pub mod text;
pub mod words;

use cell::Cell;
use collect::{Collection, Note};
use compared::Compared;
use figures::{Figure, Section, Throughput};

/// The files of a report, beside the figures.
pub const FILES: [&str; 5] = ["index.html", "mmer.md", "mmer.csv", "mmer.parquet", "runs.csv"];

/// Writes the report of `collection` into the directory `out`: [`FILES`], and the figures as `figures/NAME.svg`.
///
/// # Errors
/// What cannot be written.
pub fn write(collection: Collection, throughput: Option<&Throughput>, out: &Path) -> anyhow::Result<()> {
    let Collection { runs, notes } = collection;
    let cells = cell::cells(runs)?;
    let comparisons = Compared::all(&cells);
    let mut scores = scores(&comparisons)?;
    let mut sections = figures::sections(&cells, &comparisons)?;
    sections.extend(throughput.map(figures::throughput).transpose()?);
    let in_sections = sections.iter_mut().flat_map(|section| &mut section.figures);
    figures::make_names_plain(scores.iter_mut().chain(in_sections));
    write_tables(&cells, &notes, out)?;
    write_figures(&scores, &sections, &out.join("figures"))?;
    let page =
        page::Page { cells: &cells, left_out: &notes, comparisons: &comparisons, scores: &scores, sections: &sections };
    files::write(&out.join("index.html"), &page.html())
}

/// The single-value scores of every comparison, with and without the labyrinths.
fn scores(comparisons: &[Compared<'_>]) -> anyhow::Result<Vec<Figure>> {
    let mut figures = Vec::new();
    for (i, compared) in comparisons.iter().enumerate() {
        figures.push(figures::scores(&format!("scores-{}", i + 1), compared)?);
        if let Some(fewer) = compared.without_labyrinths() {
            let name = format!("scores-{}-without-labyrinths", i + 1);
            let mut figure = figures::scores(&name, &fewer)?;
            figure.caption = format!("Without the labyrinths. {}", figure.caption);
            figures.push(figure);
        }
    }
    Ok(figures)
}

fn write_tables(cells: &[Cell], notes: &[Note], out: &Path) -> anyhow::Result<()> {
    make(out)?;
    let path = |name: &str| -> PathBuf { out.join(name) };
    files::write(&path("mmer.md"), &tables::mmer_markdown(cells, notes))?;
    files::write(&path("mmer.csv"), &tables::mmer_csv(cells)?)?;
    files::write(&path("runs.csv"), &tables::runs_csv(cells)?)?;
    let rows: Vec<tables::Row> = cells.iter().map(tables::Row::from).collect();
    files::replace(&path("mmer.parquet"), |partial| parquet_table::write(File::create(partial)?, &rows))
}

fn write_figures(scores: &[Figure], sections: &[Section], out: &Path) -> anyhow::Result<()> {
    make(out)?;
    let mut written = BTreeSet::new();
    for figure in scores.iter().chain(sections.iter().flat_map(|section| &section.figures)) {
        let file = format!("{}.svg", figure.name);
        files::write(&out.join(&file), &figure.svg)?;
        written.insert(file);
    }
    remove_others(out, &written)
}

/// Removes the figures of an earlier report that are not `written` now.
fn remove_others(out: &Path, written: &BTreeSet<String>) -> anyhow::Result<()> {
    let entries = fs::read_dir(out).with_context(|| format!("cannot read {}", out.display()))?;
    for path in entries.filter_map(|entry| Some(entry.ok()?.path())) {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        if figures::is_figure(name) && !written.contains(name) {
            fs::remove_file(&path).with_context(|| format!("cannot remove {}", path.display()))?;
        }
    }
    Ok(())
}

fn make(dir: &Path) -> anyhow::Result<()> {
    fs::create_dir_all(dir).with_context(|| format!("cannot create {}", dir.display()))
}

#[cfg(test)]
mod tests {
    use super::samples::{RunFiles, collected};
    use super::*;

    #[test]
    fn a_report_is_complete_and_fetches_nothing() {
        let root = tempfile::tempdir().unwrap();
        for (i, env) in ["RepeatFirstEasy", "LabyrinthEscapeEasy", "CountRecallEasy"].into_iter().enumerate() {
            for (j, memory) in ["mlp", "gru", "fart"].into_iter().enumerate() {
                let files = RunFiles { env, memory, ..RunFiles::default() };
                let score = 0.1 * (i + j) as f64;
                files.write(&root.path().join(format!("{env}-{memory}")), &[(40_000, 300, 0.0), (40_000, 300, score)]);
            }
        }
        let odd = root.path().join("<b>odd & bad</b>");
        RunFiles { preset: "../x", memory: "lstm", stopped_by: "", budget: Some(1_000_000), ..RunFiles::default() }
            .write(&root.path().join("preset"), &[(80_000, 1, 0.0)]);
        RunFiles { env: "No<i>", ..RunFiles::default() }.write(&odd, &[(1, 1, 0.0)]);
        let out = root.path().join("report");
        fs::create_dir_all(out.join("figures")).unwrap();
        for name in ["bars-Earlier-quick.svg", "own.svg"] {
            fs::write(out.join("figures").join(name), "").unwrap();
        }
        write(collected(&[root.path()]).unwrap(), None, &out).unwrap();

        for name in FILES {
            assert!(fs::metadata(out.join(name)).unwrap().len() > 100, "{name}");
        }
        let figures = fs::read_dir(out.join("figures")).unwrap().count();
        // Bars and curves of three games and of the odd preset, a summary, three groups and presets against the paper, scores with and
        // without labyrinths.
        // And what somebody else has put there, but no earlier figures.
        assert_eq!(figures, 4 + 4 + 1 + 3 + 2 + 1);
        assert!(out.join("figures/own.svg").exists());
        assert!(out.join("figures/curve-RepeatFirstEasy-___x.svg").exists());
        let page = fs::read_to_string(out.join("index.html")).unwrap();
        let rest = page.replace("xmlns=\"http://www.w3.org/2000/svg\"", "");
        for fetched in ["http://", "https://", "src=", "@import", "url(", "<script", "<link"] {
            assert!(!rest.contains(fetched), "the page has `{fetched}`");
        }
        assert!(!page.contains("<b>odd") && page.contains("&lt;b&gt;odd &amp; bad&lt;/b&gt;"));
        assert!(page.contains("unknown environment `No&lt;i&gt;`"));
        for expected in
            ["name=\"viewport\"", "FART*", "CountRecallEasy*", "80k of 1M", "without the labyrinths", "Rank corr."]
        {
            assert!(page.contains(expected), "no `{expected}`");
        }
    }
}
