//! The maze of the two labyrinth games: how it is drawn, walked in, seen and shown.
//!
//! A maze with `c` corridors a side is a grid of `2c + 1` by `2c + 1` cells. The cells with two odd coordinates, the
//! lattice, are rooms; hunt and kill opens them and the walls between them:
//!
//! 1. Open a uniformly random room.
//! 2. Walk: while the present room has unopened neighbours (two cells away), choose one of them uniformly, open it and
//!    the wall between, and go there.
//! 3. Hunt: `(2c + 1)^2` times choose a room uniformly; if it is open, walk from it.
//! 4. Choose a side uniformly for the start, in the outer wall, and a uniform room beside it; the end is on the opposite
//!    side, at a uniform room of its own.
//!
//! Every opened room but the first adds two free cells, itself and a wall, so that a finished maze is a tree of `2c^2 - 1`
//! free cells. If all hunts miss its neighbours, a room stays unopened, as in the package: some five times in 100,000
//! mazes of the three sizes.
//!
//! Coordinates are `[row, column]`, rows downwards.

use serde::{Deserialize, Serialize};

use crate::canvas::{Canvas, Colour, Style, View};
use crate::env::parse_world;
use crate::rng::{EpisodeRng, below};
use crate::space::Space;

/// The size of a game.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Params {
    /// Corridors a side, from 1 to 100: half of the package's `maze_dims`.
    pub corridors: usize,
}

/// Easy, medium, hard.
pub const LEVELS: [Params; 3] = [Params { corridors: 5 }, Params { corridors: 7 }, Params { corridors: 9 }];

/// No episode is longer, in steps.
pub const MAX_STEPS: u32 = 1023;
/// The reward of a step that finds nothing.
pub const PENALTY: f64 = -1.0 / 1024.0;

/// A cell that can be entered.
pub const FREE: u8 = 0;
/// A cell that cannot be entered.
pub const WALL: u8 = 1;
/// The cell where the agent starts.
pub const START: u8 = 2;
/// The cell to be found, in the game that has one.
pub const GOAL: u8 = 3;
/// A cell that was never visited, in the hidden state.
pub const HIDDEN: u8 = 4;

/// The actions: one cell left, right, up or down.
pub const ACTIONS: [&str; 4] = ["left", "right", "up", "down"];
/// What is observed in place of an action before the first one.
pub const NO_ACTION: u8 = 4;

/// What a reset draws.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// `[2c + 1][2c + 1]`, row by row: 0 free, 1 wall, 2 start, 3 goal. A given grid need not be a tree, nor its goal in
    /// reach.
    pub grid: Vec<Vec<u8>>,
    /// Row and column of the start.
    pub start: [usize; 2],
    /// Row and column of the end: the goal of the game that has one, otherwise a wall like any other.
    pub end: [usize; 2],
}

/// Cells of the window that the agent sees.
const WINDOW: usize = 9;

/// A maze and an agent in it.
#[derive(Clone, Debug)]
pub(crate) struct Maze {
    corridors: usize,
    /// Cells a side.
    side: usize,
    /// From a row of `cells` to the next: a power of two, so that an index is easily split.
    stride: usize,
    /// The grid with a ring of walls around it, so that every cell has neighbours.
    cells: Vec<u8>,
    /// 1 where the agent has been, else 0; as `cells`.
    visited: Vec<u8>,
    /// 1 where a room is open, else 0, with a ring of 1 around them: from there nothing is left to open.
    opened: Vec<u8>,
    start: [usize; 2],
    end: [usize; 2],
    /// What the end is: a goal or a wall.
    end_cell: u8,
    /// Number of free cells.
    free: usize,
    /// Where the agent is, as an index into `cells`.
    at: usize,
    /// The last action.
    last: u8,
}

/// What a move led to.
pub(crate) struct Arrival {
    /// What is there.
    pub(crate) cell: u8,
    /// Whether the agent had never been there.
    pub(crate) new: bool,
}

impl Maze {
    /// A maze without walls inside, until one is drawn or set. Its end is a goal or a wall.
    ///
    /// # Panics
    /// If the number of corridors is not from 1 to 100.
    pub(crate) fn new(Params { corridors }: Params, end_cell: u8) -> Self {
        assert!((1..=100).contains(&corridors), "there are {corridors} corridors, allowed is 1..=100");
        let side = 2 * corridors + 1;
        let stride = (side + 2).next_power_of_two();
        let mut maze = Self {
            corridors,
            side,
            stride,
            cells: vec![WALL; (side + 2) * stride],
            visited: vec![0; (side + 2) * stride],
            opened: vec![1; (corridors + 2) * (corridors + 2)],
            start: [0, 1],
            end: [side - 1, 1],
            end_cell,
            free: (side - 2) * (side - 2),
            at: 0,
            last: NO_ACTION,
        };
        for row in 1..side - 1 {
            let first = maze.index([row, 1]);
            maze.cells[first..][..side - 2].fill(FREE);
        }
        maze.mark_entrances();
        maze.begin();
        maze
    }

    /// The space of what is seen: the window, row by row, and the last action.
    pub(crate) fn observation_space() -> Space {
        Space::MultiDiscrete(vec![5; WINDOW + 1])
    }

    /// The space of the hidden state: the visited part of the grid, row by row.
    pub(crate) fn state_space(&self) -> Space {
        Space::MultiDiscrete(vec![5; self.side * self.side])
    }

    /// Number of free cells.
    pub(crate) fn free(&self) -> usize {
        self.free
    }

    fn index(&self, [row, column]: [usize; 2]) -> usize {
        (row + 1) * self.stride + column + 1
    }

    fn mark_entrances(&mut self) {
        let (start, end) = (self.index(self.start), self.index(self.end));
        (self.cells[start], self.cells[end]) = (START, self.end_cell);
    }

    /// Draws a maze.
    pub(crate) fn draw(&mut self, rng: &mut EpisodeRng) {
        self.carve(rng);
        let wall = below(rng, 4);
        let [a, b] = [(); 2].map(|()| 2 * below(rng, self.corridors as u32) as usize + 1);
        let (near, far) = if wall & 1 == 0 { (0, self.side - 1) } else { (self.side - 1, 0) };
        [self.start, self.end] = if wall < 2 { [[near, a], [far, b]] } else { [[a, near], [b, far]] };
        self.mark_entrances();
    }

    fn carve(&mut self, rng: &mut EpisodeRng) {
        let rooms = self.corridors;
        self.cells.fill(WALL);
        for row in self.opened.chunks_exact_mut(rooms + 2).skip(1).take(rooms) {
            row[1..=rooms].fill(0);
        }
        let mut unopened = rooms * rooms - 1;
        let first = self.draw_room(rng);
        let (room, cell) = (self.room(first), self.index(first.map(|i| 2 * i + 1)));
        (self.opened[room], self.cells[cell]) = (1, FREE);
        unopened -= self.walk(first, rng);
        for _ in 0..self.side * self.side {
            // What is left of the hunts would open nothing, and nothing else depends on their draws.
            if unopened == 0 {
                break;
            }
            let hunted = self.draw_room(rng);
            if self.opened[self.room(hunted)] == 1 {
                unopened -= self.walk(hunted, rng);
            }
        }
        self.free = 2 * (rooms * rooms - unopened) - 1;
    }

    fn draw_room(&self, rng: &mut EpisodeRng) -> [usize; 2] {
        [(); 2].map(|()| below(rng, self.corridors as u32) as usize)
    }

    /// The index of a room in `opened`.
    fn room(&self, [row, column]: [usize; 2]) -> usize {
        (row + 1) * (self.corridors + 2) + column + 1
    }

    /// Walks from the room `from` as long as there are unopened neighbours; returns how many rooms it opened.
    fn walk(&mut self, from: [usize; 2], rng: &mut EpisodeRng) -> usize {
        let (mut room, mut cell) = (self.room(from), self.index(from.map(|i| 2 * i + 1)));
        let (to_room, to_cell) = (directions(self.corridors + 2), directions(self.stride));
        let mut count = 0;
        loop {
            // Without branches: which neighbours are left is anything but predictable.
            let (mut choices, mut left) = ([0; 4], 0);
            for (direction, &step) in to_room.iter().enumerate() {
                choices[left] = direction;
                left += usize::from(self.opened[room.wrapping_add(step)] == 0);
            }
            if left == 0 {
                return count;
            }
            let direction = choices[below(rng, left as u32) as usize];
            room = room.wrapping_add(to_room[direction]);
            self.opened[room] = 1;
            for _ in 0..2 {
                cell = cell.wrapping_add(to_cell[direction]);
                self.cells[cell] = FREE;
            }
            count += 1;
        }
    }

    /// Takes a recorded maze.
    ///
    /// # Errors
    /// What is wrong with it; the maze is then as before.
    pub(crate) fn set(&mut self, world: &serde_json::Value) -> Result<(), String> {
        let World { grid, start, end } = parse_world(world)?;
        let n = self.side;
        if grid.len() != n || grid.iter().any(|row| row.len() != n) {
            return Err(format!("the grid is not {n} rows of {n} cells"));
        }
        let entrances = [("start", start, START), ("end", end, self.end_cell)];
        for (name, [row, column], expected) in entrances {
            if row >= n || column >= n {
                return Err(format!("the {name} is [{row}, {column}], allowed is 0..{n} for each"));
            }
            let found = grid[row][column];
            if found != expected {
                return Err(format!("the {name}, cell [{row}, {column}] of the grid, is {found}, expected {expected}"));
            }
        }
        for (row, cells) in grid.iter().enumerate() {
            for (column, &cell) in cells.iter().enumerate() {
                let at = [row, column];
                if cell > WALL && !entrances.contains(&("start", at, cell)) && !entrances.contains(&("end", at, cell)) {
                    return Err(format!(
                        "cell [{row}, {column}] of the grid is {cell}, allowed is 0 or 1 (2 and 3 only where the start \
                         and the goal are)"
                    ));
                }
            }
        }
        let free = grid.iter().flatten().filter(|&&cell| cell == FREE).count();
        if free == 0 {
            return Err("the grid has no free cell".to_owned());
        }
        (self.start, self.end, self.free) = (start, end, free);
        for (row, cells) in grid.iter().enumerate() {
            let first = self.index([row, 0]);
            self.cells[first..][..n].copy_from_slice(cells);
        }
        Ok(())
    }

    /// The present maze, as `set` takes it.
    pub(crate) fn world(&self) -> World {
        let row = |row: usize| self.cells[self.index([row, 0])..][..self.side].to_vec();
        World { grid: (0..self.side).map(row).collect(), start: self.start, end: self.end }
    }

    /// Puts the agent on the start; nothing else is visited.
    pub(crate) fn begin(&mut self) {
        self.visited.fill(0);
        (self.at, self.last) = (self.index(self.start), NO_ACTION);
        self.visited[self.at] = 1;
    }

    /// Moves the agent, unless a wall is in the way.
    #[inline]
    pub(crate) fn advance(&mut self, action: u8) -> Arrival {
        let target = self.at.wrapping_add(directions(self.stride)[usize::from(action)]);
        self.at = if self.cells[target] == WALL { self.at } else { target };
        self.last = action;
        let new = self.visited[self.at] == 0;
        self.visited[self.at] = 1;
        Arrival { cell: self.cells[self.at], new }
    }

    /// Writes what the agent sees.
    ///
    /// The package cuts the 3x3 cells around the agent at the border of the grid and then pads what is left with walls
    /// below and to the right. So a window at the upper or left border is not centred.
    #[inline]
    pub(crate) fn observe(&self, out: &mut [u8]) {
        let (window, last) = out.split_at_mut(WINDOW);
        last[0] = self.last;
        // The first row and column of the grid are those with the index 1 here.
        if self.at >= 2 * self.stride && self.at & (self.stride - 1) >= 2 {
            let first = self.at - self.stride - 1;
            for (i, out) in window.chunks_exact_mut(3).enumerate() {
                out.copy_from_slice(&self.cells[first + i * self.stride..][..3]);
            }
        } else {
            self.observe_at_border(window);
        }
    }

    #[cold]
    fn observe_at_border(&self, window: &mut [u8]) {
        let [row, column] = self.position();
        for (i, out) in window.iter_mut().enumerate() {
            let at = [row.saturating_sub(1) + i / 3, column.saturating_sub(1) + i % 3];
            *out = if at[0] <= row + 1 && at[1] <= column + 1 { self.cells[self.index(at)] } else { WALL };
        }
    }

    fn position(&self) -> [usize; 2] {
        [self.at / self.stride - 1, self.at % self.stride - 1]
    }

    /// Writes the hidden state.
    pub(crate) fn state(&self, out: &mut [u8]) {
        for (row, out) in out.chunks_exact_mut(self.side).enumerate() {
            let first = self.index([row, 0]);
            let cells = self.cells[first..].iter().zip(&self.visited[first..]);
            for (out, (&cell, &visited)) in out.iter_mut().zip(cells) {
                *out = if visited == 1 { cell } else { HIDDEN };
            }
        }
    }

    /// Draws what the agent sees and its last action, or the whole maze and where the agent has been.
    pub(crate) fn render(&self, view: View, canvas: &mut Canvas) {
        if view == View::Revealed {
            for row in 0..self.side {
                for column in 0..self.side {
                    let at = self.index([row, column]);
                    let (text, style) = match self.cells[at] {
                        _ if at == self.at => ("()", Style::ink(Colour::Black).on(Colour::Yellow).bold()),
                        FREE if self.visited[at] == 1 => ("··", Style::ink(Colour::Yellow)),
                        cell => look(cell),
                    };
                    canvas.put(row, 2 * column, text, style);
                }
            }
            return;
        }
        // A frame, as a free cell is blank.
        let frame = Style::ink(Colour::Grey);
        canvas.put(0, 0, "┌──────┐", frame);
        (1..=3).for_each(|row| canvas.put(row, 0, "│      │", frame));
        canvas.put(4, 0, "└──────┘", frame);
        let mut seen = [0; WINDOW + 1];
        self.observe(&mut seen);
        for (i, &cell) in seen[..WINDOW].iter().enumerate() {
            let (text, style) = look(cell);
            canvas.put(1 + i / 3, 1 + 2 * (i % 3), text, style);
        }
        let arrow = ["←", "→", "↑", "↓", "-"][usize::from(seen[WINDOW])];
        canvas.put(5, 1, &format!("last {arrow}"), frame);
    }
}

/// How a cell looks, two characters wide so that it is about square.
fn look(cell: u8) -> (&'static str, Style) {
    match cell {
        WALL => ("██", Style::ink(Colour::White)),
        START => ("S ", Style::ink(Colour::Black).on(Colour::Cyan).bold()),
        GOAL => ("G ", Style::ink(Colour::Black).on(Colour::Green).bold()),
        _ => ("  ", Style::PLAIN),
    }
}

/// From a cell to the one on its left, right, upper and lower side, where rows are `stride` cells apart; added with wrap.
#[inline]
fn directions(stride: usize) -> [usize; 4] {
    [usize::MAX, 1, stride.wrapping_neg(), stride]
}
