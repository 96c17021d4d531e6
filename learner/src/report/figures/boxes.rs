//! The normalised summary: how each memory does over all environments.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::{Figure, Section, WIDTH, behind, captioned, heading};
use crate::chart::{FINE, GRID, SvgArea, TEXT, short, svg};
use crate::report::cell::Cell;
use crate::report::compared::Compared;
use crate::statistics::{mean, quantile};

const NAMES: f64 = 78.0;
const RIGHT: f64 = 12.0;
const HEAD: f64 = 30.0;
const ROW: f64 = 24.0;
const AXIS: f64 = 24.0;
const BOX: RGBColor = RGBColor(120, 175, 225);
const MEAN: RGBColor = RGBColor(213, 94, 0);

/// A figure for each comparison.
pub(super) fn section(compared: &[Compared<'_>]) -> anyhow::Result<Section> {
    let figure = |(i, compared): (usize, &Compared<'_>)| {
        let rows = compared.standardised();
        let height = HEAD + ROW * rows.len() as f64 + AXIS;
        let cells: Vec<&Cell> = compared.cells().collect();
        Ok(Figure {
            name: format!("summary-{}", i + 1),
            title: format!("Standardised MMER, {}", compared.title()),
            caption: captioned(&compared.title(), &format!("{}.", behind(&cells, false))),
            svg: svg((WIDTH, height as u32), FINE, |area| draw(area, &compared.title(), &rows))?,
        })
    };
    // A box of one or two values says nothing.
    let many = compared.iter().filter(|compared| compared.tasks.len() > 2).enumerate();
    Ok(Section {
        title: "Normalised summary".into(),
        text: "The distribution over environments of the standardised MMER (mean over seeds): a box from the lower to the \
               upper quartile, a line at the median, a point at the mean, whiskers to the smallest and largest. Memories are \
               compared only over environments that all of them have."
            .into(),
        figures: many.map(figure).collect::<anyhow::Result<_>>()?,
    })
}

fn draw(area: &SvgArea<'_>, title: &str, rows: &[(String, Vec<f64>)]) -> anyhow::Result<()> {
    let pen = FINE;
    let anchored = |h| pen.text(11).pos(Pos::new(h, VPos::Center));
    let x = |value: f64| NAMES + value.clamp(0.0, 1.0) * (f64::from(WIDTH) - NAMES - RIGHT);
    let bottom = HEAD + ROW * rows.len() as f64;
    area.draw_text(&heading(title), &pen.text(13), pen.at(8.0, 8.0))?;
    for tick in super::bars::unit_ticks() {
        let line = vec![pen.at(x(tick), HEAD), pen.at(x(tick), bottom)];
        area.draw(&PathElement::new(line, GRID.stroke_width(pen.px(1))))?;
        area.draw_text(&short(tick), &anchored(HPos::Center), pen.at(x(tick), bottom + 10.0))?;
    }
    for (i, (name, values)) in rows.iter().enumerate() {
        let middle = HEAD + ROW * (i as f64 + 0.5);
        area.draw_text(name, &anchored(HPos::Right), pen.at(NAMES - 6.0, middle))?;
        let [least, lower, median, upper, most] = [0.0, 0.25, 0.5, 0.75, 1.0].map(|p| quantile(values, p));
        let (Some(least), Some(lower), Some(median), Some(upper), Some(most)) = (least, lower, median, upper, most)
        else {
            continue;
        };
        let whisker = vec![pen.at(x(least), middle), pen.at(x(most), middle)];
        area.draw(&PathElement::new(whisker, TEXT.stroke_width(pen.px(1))))?;
        let corners = [pen.at(x(lower), middle - 7.0), pen.at(x(upper), middle + 7.0)];
        area.draw(&Rectangle::new(corners, BOX.filled()))?;
        let line = vec![pen.at(x(median), middle - 7.0), pen.at(x(median), middle + 7.0)];
        area.draw(&PathElement::new(line, TEXT.stroke_width(pen.px(2))))?;
        let centre = pen.at(x(mean(values).unwrap_or(median)), middle);
        area.draw(&Circle::new(centre, pen.px(3), MEAN.filled()))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::super::samples::cells_of;
    use super::*;

    #[test]
    fn a_box_is_where_its_numbers_are() {
        let envs = ["RepeatFirstEasy", "RepeatPreviousEasy", "AutoencodeEasy"];
        let scores: [&[f64]; 3] = [&[-0.5], &[0.0], &[0.5]];
        let runs: Vec<(&str, &str, &[f64])> =
            envs.iter().zip(scores).flat_map(|(env, score)| [(*env, "gru", score), (*env, "mlp", score)]).collect();
        let cells = cells_of(&runs);
        let svg = &section(&Compared::all(&cells)).unwrap().figures[0].svg;
        // Of the return range -1 to 1 these are 0.25, 0.5 and 0.75, quartiles 0.375 and 0.625. 0 is at 78, 1 at 328, and all
        // is four times as large. Rows are 24 high and begin at 30.
        for expected in [
            "<rect x=\"687\" y=\"140\" width=\"250\" height=\"56\"",
            "points=\"562,168 1062,168 \"",
            "points=\"812,140 812,196 \"",
            "<circle cx=\"812\" cy=\"168\"",
        ] {
            assert!(svg.contains(expected), "no `{expected}` in {svg}");
        }
    }

    #[test]
    fn boxes_where_there_are_enough_environments() {
        let envs = ["RepeatFirstEasy", "RepeatPreviousEasy", "AutoencodeEasy"];
        let runs: Vec<(&str, &str, &[f64])> =
            envs.iter().flat_map(|env| [(*env, "gru", &[0.5][..]), (*env, "mlp", &[0.0][..])]).collect();
        let cells = cells_of(&runs);
        let found = section(&Compared::all(&cells)).unwrap().figures;
        assert_eq!(found.len(), 1);
        assert!(found[0].svg.contains("2 memories over 3 environments, quick"));
        let few = cells_of(&runs[..4]);
        assert!(section(&Compared::all(&few)).unwrap().figures.is_empty());
    }
}
