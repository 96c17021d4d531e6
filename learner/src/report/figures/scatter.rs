//! Every cell beside the paper: our best block against its MMER.

use plotters::prelude::*;

use super::{Figure, Section, WIDTH, behind, colour};
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
            caption: format!(
                "{} environments and memories; paper 15M steps (DNC 10M); ours: {}.",
                cells.len(),
                behind(&cells, false)
            ),
            svg: svg((WIDTH, 320), FINE, |area| draw(area, &title, &cells))?,
        })
    });
    Ok(Section {
        title: "Against the paper".into(),
        text: "A point for each environment and memory, in the memory's colour of the curves above: on the line where both \
               agree, above it where ours is higher."
            .into(),
        figures: figures.collect::<anyhow::Result<_>>()?,
    })
}

fn draw(area: &SvgArea<'_>, title: &str, cells: &[&Cell]) -> anyhow::Result<()> {
    let px = |length| FINE.px(length);
    area.draw_text(title, &FINE.text(13), FINE.at(8.0, 8.0))?;
    let (_, plot) = area.split_vertically(px(26));
    let axis = |desc| Axis { range: -1.1..1.1, desc, labels: 5 };
    let mut chart = axes(&plot, FINE, axis("paper, MMER"), axis("here, MMER-65k"))?;
    chart.draw_series([PathElement::new(vec![(-1.1, -1.1), (1.1, 1.1)], TEXT.stroke_width(px(1)))])?;
    let point = |cell: &&Cell| Some((cell.paper?.mean, cell.mmer_65k?.mean, colour(&cell.paper_memory)));
    let points = cells.iter().filter_map(point);
    chart.draw_series(points.map(|(x, y, colour)| Circle::new((x, y), px(3), colour.mix(0.8).filled())))?;
    Ok(())
}
