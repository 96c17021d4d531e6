//! Every cell beside the paper: our best block against its MMER.

use plotters::prelude::*;

use super::{Figure, Section, WIDTH, behind, captioned, colour, heading};
use crate::chart::{Axis, FINE, SvgArea, TEXT, axes, svg};
use crate::report::cell::Cell;

/// A figure for each group of environments and preset.
pub(super) fn section(cells: &[Cell]) -> anyhow::Result<Section> {
    let mut groups: Vec<(&str, &str)> = Vec::new();
    for cell in cells.iter().filter(|cell| cell.verdict.is_some()) {
        let group = (cell.task.group.as_str(), cell.task.preset.as_str());
        if !groups.contains(&group) {
            groups.push(group);
        }
    }
    let figures = groups.into_iter().map(|group| {
        let of = |cell: &&Cell| (cell.task.group.as_str(), cell.task.preset.as_str()) == group;
        let cells: Vec<&Cell> = cells.iter().filter(of).filter(|cell| cell.verdict.is_some()).collect();
        let title = format!("{} environments, {}", group.0, group.1);
        Ok(Figure {
            name: format!("paper-{}-{}", group.0, group.1),
            title: format!("Our MMER-65k against the paper's MMER, {title}"),
            caption: captioned(
                &title,
                &format!(
                    "{} environments and memories; paper 15M steps (DNC 10M); ours: {}.",
                    cells.len(),
                    behind(&cells, false)
                ),
            ),
            svg: svg((WIDTH, 320), FINE, |area| draw(area, &title, &cells))?,
        })
    });
    Ok(Section {
        title: "Against the paper".into(),
        text: "A point for each environment and memory, in the memory's colour of the curves above: on the line where both \
               agree, above it where ours is higher. Hollow points are those marked with an asterisk in the tables: the paper's \
               figure is of another model, or of other rules."
            .into(),
        figures: figures.collect::<anyhow::Result<_>>()?,
    })
}

fn draw(area: &SvgArea<'_>, title: &str, cells: &[&Cell]) -> anyhow::Result<()> {
    let px = |length| FINE.px(length);
    area.draw_text(&heading(title), &FINE.text(13), FINE.at(8.0, 8.0))?;
    let (_, plot) = area.split_vertically(px(26));
    let axis = |desc| Axis { range: -1.1..1.1, desc, labels: 5 };
    let mut chart = axes(&plot, FINE, axis("paper, MMER"), axis("here, MMER-65k"))?;
    chart.draw_series([PathElement::new(vec![(-1.1, -1.1), (1.1, 1.1)], TEXT.stroke_width(px(1)))])?;
    let point = |cell: &&Cell| Some(((cell.paper?.mean, cell.mmer_65k?.mean), style(cell)));
    let points = cells.iter().filter_map(point);
    chart.draw_series(points.map(|(place, style)| Circle::new(place, px(3), style)))?;
    Ok(())
}

/// Hollow where the paper's figure is of something else.
fn style(cell: &Cell) -> ShapeStyle {
    let colour = colour(&cell.paper_memory);
    if cell.marks().is_empty() { colour.mix(0.8).filled() } else { colour.stroke_width(FINE.px(1)) }
}

#[cfg(test)]
mod tests {
    use super::super::super::samples::cells_of;
    use super::*;

    /// The points of the only figure of these cells: place, and whether it is filled.
    fn points(cells: &[Cell]) -> Vec<(f64, f64, bool)> {
        let figures = section(cells).unwrap().figures;
        assert_eq!(figures.len(), 1);
        let point = |circle: &str| {
            let value = |name: &str| circle.split(&format!("{name}=\"")).nth(1).unwrap().split('"').next().unwrap();
            (value("cx").parse().unwrap(), value("cy").parse().unwrap(), value("fill") != "none")
        };
        figures[0].svg.split("<circle ").skip(1).map(point).collect()
    }

    #[test]
    fn the_paper_is_to_the_right_and_ours_upward() {
        // In the paper's AutoencodeEasy GRU has -0.283, FART -0.447; FART is marked.
        let cells = cells_of(&[("AutoencodeEasy", "fart", &[0.55]), ("AutoencodeEasy", "gru", &[0.99])]);
        let found = points(&cells);
        // -1.1 to 1.1 is from 60 to 340 - 16 to the right, and from 320 - 38 up to 26 + 4; all four times as large.
        let x = |value: f64| 4.0 * (60.0 + 264.0 * (value + 1.1) / 2.2);
        let y = |value: f64| 4.0 * (282.0 - 252.0 * (value + 1.1) / 2.2);
        for ((cx, cy, filled), (paper, ours, plain)) in found.iter().zip([(-0.447, 0.55, false), (-0.283, 0.99, true)])
        {
            assert!(
                (cx - x(paper)).abs() < 3.0 && (cy - y(ours)).abs() < 3.0,
                "{cx} {cy}, not {} {}",
                x(paper),
                y(ours)
            );
            assert_eq!(*filled, plain);
        }
        assert_eq!(found.len(), 2);
    }
}
