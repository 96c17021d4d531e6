//! The places of a picture that stand for actions, and a cursor over them.

use std::collections::BTreeMap;

use popgym_envs::{Canvas, Colour};

use super::key::Direction;

/// A row is about as high as this many columns are wide.
const ROW: f64 = 2.0;

/// Behind the place at which the cursor points.
const MARK: Colour = Colour::Yellow;

/// The middle of a place: rightwards and downwards, in columns.
type Point = (f64, f64);

/// Points at one of the places of a picture.
#[derive(Clone, Debug, Default)]
pub(crate) struct Cursor {
    places: BTreeMap<u16, Point>,
    at: Option<(u16, Point)>,
}

impl Cursor {
    /// Takes the places of `picture` that stand for one of `actions` actions. It stays where it was, or, if that place has
    /// gone, moves to the nearest one.
    pub(crate) fn see(&mut self, picture: &Canvas, actions: usize) {
        self.places = middles(picture);
        self.places.retain(|&action, _| usize::from(action) < actions);
        self.at = match self.at {
            Some((action, _)) if self.places.contains_key(&action) => Some(action),
            Some((_, from)) => self.nearest(|to| Some(distance(from, to))),
            None => self.places.keys().next().copied(),
        }
        .map(|action| (action, self.places[&action]));
    }

    /// The action that it points at, if there are places.
    pub(crate) fn action(&self) -> Option<u16> {
        self.at.map(|(action, _)| action)
    }

    /// Moves to the nearest place in a direction: one within 45 degrees of it, else any that is not behind. Says whether
    /// there is one.
    pub(crate) fn go(&mut self, direction: Direction) -> bool {
        let Some((_, from)) = self.at else { return false };
        let ahead = |to: Point| {
            let (right, down) = (to.0 - from.0, to.1 - from.1);
            match direction {
                Direction::Left => (-right, down.abs()),
                Direction::Right => (right, down.abs()),
                Direction::Up => (-down, right.abs()),
                Direction::Down => (down, right.abs()),
            }
        };
        // To swerve is worth a longer way.
        let cost = |(along, across): (f64, f64)| along + 2.0 * across;
        let straight =
            self.nearest(|to| Some(ahead(to)).filter(|&(along, across)| along > 0.0 && across <= along).map(cost));
        let found = straight.or_else(|| self.nearest(|to| Some(ahead(to)).filter(|&(along, _)| along > 0.0).map(cost)));
        if let Some(action) = found {
            self.at = Some((action, self.places[&action]));
        }
        found.is_some()
    }

    /// Shows it in the picture.
    pub(crate) fn mark(&self, picture: &mut Canvas) {
        let at = self.action();
        tint(picture, |action, _| (Some(action) == at).then_some(MARK));
    }

    fn nearest(&self, cost: impl Fn(Point) -> Option<f64>) -> Option<u16> {
        let costs = self.places.iter().filter_map(|(&action, &point)| cost(point).map(|cost| (cost, action)));
        costs.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, action)| action)
    }
}

/// Colours places of a picture from behind: `paper` is given an action and the colour that is behind its place now.
pub(crate) fn tint(picture: &mut Canvas, paper: impl Fn(u16, Colour) -> Option<Colour>) {
    for glyph in picture.rows_mut().iter_mut().flatten() {
        let Some(paper) = glyph.action.and_then(|action| paper(action, glyph.style.paper)) else { continue };
        // What is drawn there has to stay legible, and what is behind it visible.
        if glyph.style.ink == paper || glyph.style.ink == Colour::Default {
            glyph.style.ink = Colour::Black;
        }
        if glyph.symbol == '█' {
            glyph.symbol = '▒';
        }
        glyph.style = glyph.style.on(paper).bold();
    }
}

fn distance(a: Point, b: Point) -> f64 {
    (a.0 - b.0).hypot(a.1 - b.1)
}

/// The middle of all characters that stand for the same action.
fn middles(picture: &Canvas) -> BTreeMap<u16, Point> {
    let mut sums: BTreeMap<u16, (f64, f64, f64)> = BTreeMap::new();
    for (row, glyphs) in picture.rows().iter().enumerate() {
        for (column, action) in glyphs.iter().enumerate().filter_map(|(column, glyph)| Some((column, glyph.action?))) {
            let sum = sums.entry(action).or_default();
            *sum = (sum.0 + column as f64, sum.1 + row as f64 * ROW, sum.2 + 1.0);
        }
    }
    sums.into_iter().map(|(action, (x, y, count))| (action, (x / count, y / count))).collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use popgym_envs::Style;

    use super::*;

    /// `rows` rows of `columns` places, each `width` characters with a blank between; the last row has `last` places.
    fn board(rows: u16, columns: u16, last: u16, width: usize) -> Canvas {
        let mut canvas = Canvas::new();
        for row in 0..rows {
            for column in 0..if row + 1 == rows { last } else { columns } {
                let (y, x) = (1 + usize::from(row), 3 + usize::from(column) * (width + 1));
                canvas.put_action(y, x, &"x".repeat(width), Style::PLAIN, row * columns + column);
            }
        }
        canvas
    }

    fn cursor(canvas: &Canvas) -> Cursor {
        let mut cursor = Cursor::default();
        cursor.see(canvas, usize::MAX);
        cursor
    }

    #[test]
    fn a_board_is_walked_square_by_square() {
        for width in 1..4 {
            let mut cursor = cursor(&board(8, 8, 8, width));
            assert_eq!(cursor.action(), Some(0));
            for (direction, expected) in [
                (Direction::Right, 1),
                (Direction::Right, 2),
                (Direction::Down, 10),
                (Direction::Left, 9),
                (Direction::Up, 1),
            ] {
                assert!(cursor.go(direction));
                assert_eq!(cursor.action(), Some(expected), "{width} {direction:?}");
            }
            assert!(!cursor.go(Direction::Up), "the upper edge");
            (0..7).for_each(|_| assert!(cursor.go(Direction::Down)));
            assert!(!cursor.go(Direction::Down), "the lower edge");
            assert_eq!(cursor.action(), Some(57));
        }
    }

    #[test]
    fn every_place_can_be_reached() {
        for canvas in [board(8, 8, 8, 1), board(4, 13, 13, 3), board(3, 13, 1, 2), board(1, 4, 4, 1), board(5, 1, 1, 4)]
        {
            let start = cursor(&canvas);
            let (mut reached, mut open) = (BTreeSet::from([start.action()]), vec![start.clone()]);
            while let Some(from) = open.pop() {
                for direction in Direction::ALL {
                    let mut next = from.clone();
                    if next.go(direction) && reached.insert(next.action()) {
                        open.push(next);
                    }
                }
            }
            assert_eq!(reached.len(), start.places.len());
        }
    }

    #[test]
    fn it_stays_or_moves_to_the_nearest() {
        let mut cursor = cursor(&board(3, 3, 3, 1));
        cursor.go(Direction::Right);
        cursor.go(Direction::Down);
        assert_eq!(cursor.action(), Some(4));
        cursor.see(&board(3, 3, 3, 1), 9);
        assert_eq!(cursor.action(), Some(4), "the same picture");
        let mut picture = board(3, 3, 3, 1);
        for glyph in picture.rows_mut().iter_mut().flatten().filter(|glyph| glyph.action == Some(4)) {
            glyph.action = None;
        }
        cursor.see(&picture, 9);
        assert_eq!(cursor.action(), Some(1), "the first of those that are as near");
        cursor.see(&Canvas::new(), 9);
        assert_eq!((cursor.action(), cursor.go(Direction::Left)), (None, false));
    }

    #[test]
    fn actions_that_do_not_exist_are_no_places() {
        let mut cursor = Cursor::default();
        cursor.see(&board(1, 4, 4, 1), 2);
        assert!(cursor.go(Direction::Right) && !cursor.go(Direction::Right));
        assert_eq!(cursor.action(), Some(1));
    }

    #[test]
    fn the_mark_is_on_the_whole_place_and_on_no_other() {
        let mut canvas = board(2, 2, 2, 3);
        let mut cursor = cursor(&canvas);
        cursor.go(Direction::Right);
        cursor.mark(&mut canvas);
        let marked: Vec<_> = canvas.rows().iter().flatten().filter(|glyph| glyph.style.paper == MARK).collect();
        assert_eq!(marked.len(), 3);
        assert!(marked.iter().all(|glyph| glyph.action == Some(1)));
    }

    #[test]
    fn what_is_tinted_stays_legible() {
        let mut canvas = Canvas::new();
        for (action, (text, ink)) in
            [("x", Colour::Yellow), ("x", Colour::Default), ("x", Colour::Red), ("█", Colour::White)]
                .into_iter()
                .enumerate()
        {
            canvas.put_action(0, action, text, Style::ink(ink), action as u16);
        }
        canvas.put(1, 0, "y", Style::PLAIN);
        tint(&mut canvas, |_, _| Some(Colour::Yellow));
        let glyphs = &canvas.rows()[0];
        assert!(glyphs.iter().all(|glyph| glyph.style.paper == Colour::Yellow && glyph.style.ink != Colour::Yellow));
        assert_eq!(glyphs[2].style.ink, Colour::Red);
        assert_eq!(canvas.to_text(), "xxx▒\ny\n");
        assert_eq!(canvas.rows()[1][0].style, Style::PLAIN, "no place");
    }
}
