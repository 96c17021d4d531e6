//! The largest mean return so far, over environment steps.

use super::{Figure, Section, WIDTH, behind, captioned, colour, heading};
use crate::chart::{FINE, Lines, Series, svg};
use crate::report::cell::Cell;
use crate::report::run::Run;
use crate::statistics::{bootstrap_interval, mean};

/// Points of a curve, at most.
const POINTS: usize = 60;

/// A figure for each task.
pub(super) fn section(cells: &[Cell]) -> anyhow::Result<Section> {
    let tasks = cells.chunk_by(|a, b| a.task.key() == b.task.key());
    Ok(Section {
        title: "Learning curves".into(),
        text: "The largest mean return of an epoch so far, over environment steps: the mean over seeds, with its 95% \
               bootstrap interval where there are two seeds or more. A run that has come to its end keeps its last value; one that \
               was not finished counts as far as it went."
            .into(),
        figures: tasks.map(figure).collect::<anyhow::Result<_>>()?,
    })
}

fn figure(cells: &[Cell]) -> anyhow::Result<Figure> {
    let task = &cells[0].task;
    let title = format!("{}, {}", task.env, task.preset);
    let lines = Lines {
        title: heading(&title),
        x_desc: "environment steps".into(),
        y_desc: "return per episode".into(),
        series: cells.iter().map(series).collect(),
        columns: 4,
    };
    Ok(Figure {
        name: format!("curve-{}-{}", task.env, task.preset),
        title: format!("Largest mean return so far in {} by memory", task.env),
        caption: captioned(&title, &format!("{}.", behind(&cells.iter().collect::<Vec<_>>(), true))),
        svg: svg((WIDTH, lines.height()), FINE, |area| lines.draw(area, FINE))?,
    })
}

fn series(cell: &Cell) -> Series {
    let at: Vec<(f64, Vec<f64>)> = grid(&cell.runs)
        .into_iter()
        .map(|steps| (steps as f64, cell.runs.iter().filter_map(|run| value_at(run, steps)).collect()))
        .collect();
    let points = at.iter().filter_map(|(x, values)| Some((*x, mean(values)?))).collect();
    let band = at.iter().filter_map(|(x, values)| bootstrap_interval(values).map(|(low, high)| (*x, low, high)));
    Series { name: cell.paper_memory.clone(), colour: colour(&cell.paper_memory), points, band: band.collect() }
}

/// Steps at which the curves of `runs` are drawn: from where all have begun to the end of the longest.
fn grid(runs: &[Run]) -> Vec<u64> {
    let first = runs.iter().filter_map(|run| run.curve.first()).map(|point| point.0).max().unwrap_or(0);
    let last = runs.iter().map(|run| run.steps).max().unwrap_or(0);
    let part = |i: usize| first + (last.saturating_sub(first)) * i as u64 / (POINTS as u64 - 1);
    let mut grid: Vec<u64> = (0..POINTS).map(part).collect();
    grid.dedup();
    grid
}

/// The value of a run's curve after `steps` steps; none before its first epoch, nor after the last of a run that was not
/// finished.
fn value_at(run: &Run, steps: u64) -> Option<f64> {
    let after = run.curve.partition_point(|point| point.0 <= steps);
    let known = run.complete() || steps <= run.steps;
    Some(run.curve.get(after.checked_sub(1)?)?.1).filter(|_| known)
}

#[cfg(test)]
mod tests {
    use super::super::super::samples::{RunFiles, collected};
    use super::*;
    use crate::report::cell::cells;

    #[test]
    fn curves_are_steps_that_stay() {
        let root = tempfile::tempdir().unwrap();
        RunFiles::default().write(root.path(), &[(10, 10, 0.1), (10, 10, 0.2)]);
        let mut run = collected(&[root.path()]).unwrap().runs.remove(0);
        let at = |run: &Run| [9, 10, 19, 20, 99].map(|steps| value_at(run, steps));
        assert_eq!(at(&run), [None, Some(0.1), Some(0.1), Some(0.2), Some(0.2)]);
        // Killed: nobody knows how it would have gone on.
        run.stopped_by = None;
        assert_eq!(at(&run), [None, Some(0.1), Some(0.1), Some(0.2), None]);
    }

    #[test]
    fn seeds_are_joined_on_common_steps() {
        let root = tempfile::tempdir().unwrap();
        RunFiles::default().write(&root.path().join("0"), &[(100, 10, 0.0), (100, 10, 1.0)]);
        RunFiles { seed: 1, ..RunFiles::default() }.write(&root.path().join("1"), &[(141, 10, 0.5)]);
        let cells = cells(collected(&[root.path()]).unwrap().runs).unwrap();
        let series = series(&cells[0]);
        // From where both have begun, to where the longer ends.
        assert_eq!(series.points.first(), Some(&(141.0, 0.25)));
        assert_eq!(series.points.last(), Some(&(200.0, 0.75)));
        assert_eq!(series.band.last(), Some(&(200.0, 0.5, 1.0)));
        assert!(section(&cells).unwrap().figures[0].svg.contains("RepeatFirstEasy, quick"));
    }
}
