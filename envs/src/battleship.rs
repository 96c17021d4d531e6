//! **Battleship**: sink hidden ships on a square board, told only whether the last shot was a hit.
//!
//! | | |
//! |---|---|
//! | observation | `Discrete(2)`: 1 if the last shot was a new hit, else 0; 0 at the start |
//! | action | `MultiDiscrete([n, n])`: row and column of the next shot |
//! | reward | `1 / 12` for a new hit, else `-1 / (n^2 - 12)` |
//! | end | terminates when all 12 cells of the ships were hit; truncates after `n^2` steps |
//! | state | `[n * n]` ships (0/1), `[n * n]` cells shot (0/1), both row-major; the last observation |
//!
//! Both flags can be set in the same step. Quirks kept: open water costs as much as a repeated shot (the paper's prose
//! says that it costs nothing), so the smallest return, `-n^2 / (n^2 - 12)`, is below -1; a second shot at a hit cell is
//! a miss; the observation does not tell where the shot went. Ships may touch.
//!
//! Source: Morad et al., ICLR 2023, the game environments; rules as in the Python package 1.0.7, which agrees with the
//! version behind the paper's numbers.

use serde::{Deserialize, Serialize};

use crate::board::draw_board;
use crate::canvas::{Canvas, Colour, Style, View};
use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step, parse_world, world_value};
use crate::rng::{EpisodeRng, below};
use crate::space::{Space, Value, ValueMut};

/// The size of a game.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Params {
    /// Rows, and columns, of the board.
    pub board: usize,
}

/// Easy, medium, hard.
pub const LEVELS: [Params; 3] = [Params { board: 8 }, Params { board: 10 }, Params { board: 12 }];

/// Lengths of the ships, in cells and in the order in which they are placed.
pub const SHIPS: [usize; 4] = [2, 3, 3, 4];
/// Cells of all ships.
pub const SHIP_CELLS: u32 = 12;

/// What a reset draws.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// `[n][n]`, row by row: 1 is a ship, 0 is water. A given world may have its twelve ship cells anywhere.
    pub ships: Vec<Vec<u8>>,
}

/// The bits of a cell.
const SHIP: u8 = 1;
const SHOT: u8 = 2;

/// The game.
#[derive(Clone, Debug)]
pub struct Battleship {
    spec: EnvSpec,
    board: usize,
    /// Rewards of a miss and of a hit.
    rewards: [f64; 2],
    /// `[n * n]`, each with its bits.
    cells: Vec<u8>,
    steps: u32,
    hits: u8,
    observed: u8,
    /// The last shot's cell, if there was one.
    last: Option<u16>,
}

impl Battleship {
    /// A game of the given size, under the id `id`.
    ///
    /// # Panics
    /// If the board is not from 5 to 256 cells wide (on a smaller one the ships might not fit).
    pub fn new(id: &str, Params { board }: Params) -> Self {
        assert!((5..=256).contains(&board), "the board is {board} wide, allowed is 5..=256");
        let count = board * board;
        let water = (count as u32 - SHIP_CELLS) as f64;
        let spec = EnvSpec {
            id: id.to_owned(),
            observation: Space::Discrete(2),
            action: Space::MultiDiscrete(vec![board as u16; 2]),
            state: Space::Tuple(vec![
                Space::MultiDiscrete(vec![2; count]),
                Space::MultiDiscrete(vec![2; count]),
                Space::Discrete(2),
            ]),
            max_steps: count as u32,
            return_range: (-(count as f64) / water, 1.0),
        };
        // Any 12 cells will do until the first world is drawn or set.
        let cells = (0..count as u32).map(|cell| u8::from(cell < SHIP_CELLS)).collect();
        let rewards = [-1.0 / water, 1.0 / f64::from(SHIP_CELLS)];
        Self { spec, board, rewards, cells, steps: 0, hits: 0, observed: 0, last: None }
    }

    /// Tries to place a ship of `length` cells.
    ///
    /// The package draws a cell and a direction until the ship is on the board. Each place on the board is then the
    /// outcome of two of these draws (one from either end), so all are equally likely: here one of them is drawn.
    fn try_place(&mut self, length: usize, rng: &mut EpisodeRng) -> bool {
        let n = self.board;
        let line = below(rng, 2 * n as u32) as usize;
        let offset = below(rng, (n - length + 1) as u32) as usize;
        let (first, stride) = if line < n { (line * n + offset, 1) } else { (offset * n + line - n, n) };
        let place = || (0..length).map(|i| first + i * stride);
        let free = place().all(|cell| self.cells[cell] == 0);
        if free {
            place().for_each(|cell| self.cells[cell] = SHIP);
        }
        free
    }
}

impl Env for Battleship {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn draw_world(&mut self, rng: &mut EpisodeRng) {
        self.cells.fill(0);
        for length in SHIPS {
            while !self.try_place(length, rng) {}
        }
    }

    fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String> {
        let World { ships } = parse_world(world)?;
        let n = self.board;
        if ships.len() != n || ships.iter().any(|row| row.len() != n) {
            return Err(format!("the ships are not {n} rows of {n} cells"));
        }
        let cells = ships.concat();
        if let Some(cell) = cells.iter().find(|&&cell| cell > 1) {
            return Err(format!("a cell of the ships is {cell}, allowed is 0 or 1"));
        }
        let count: u32 = cells.iter().map(|&cell| u32::from(cell)).sum();
        if count != SHIP_CELLS {
            return Err(format!("the ships cover {count} cells, expected {SHIP_CELLS}"));
        }
        self.cells = cells;
        Ok(())
    }

    fn world(&self) -> serde_json::Value {
        let row = |row: &[u8]| row.iter().map(|cell| cell & SHIP).collect();
        world_value(&World { ships: self.cells.chunks(self.board).map(row).collect() })
    }

    fn begin(&mut self, _draws: &mut dyn Draws, observation: ValueMut<'_>) {
        self.cells.iter_mut().for_each(|cell| *cell &= SHIP);
        (self.steps, self.hits, self.observed, self.last) = (0, 0, 0, None);
        observation.discrete[0] = 0;
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let shot = usize::from(action.discrete[0]) * self.board + usize::from(action.discrete[1]);
        let cell = &mut self.cells[shot];
        let hit = *cell == SHIP;
        *cell |= SHOT;
        self.hits += u8::from(hit);
        self.steps += 1;
        (self.observed, self.last) = (u8::from(hit), Some(shot as u16));
        observation.discrete[0] = self.observed;
        Step {
            reward: self.rewards[usize::from(hit)],
            terminated: u32::from(self.hits) == SHIP_CELLS,
            truncated: self.steps >= self.spec.max_steps,
        }
    }

    fn state(&self, state: ValueMut<'_>) {
        let (ships, rest) = state.discrete.split_at_mut(self.cells.len());
        let (shots, observed) = rest.split_at_mut(self.cells.len());
        for ((ship, shot), cell) in ships.iter_mut().zip(shots).zip(&self.cells) {
            (*ship, *shot) = (cell & SHIP, cell >> 1);
        }
        observed[0] = self.observed;
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        let hit = ('×', Style::ink(Colour::Red).bold());
        let miss = ('○', Style::ink(Colour::Cyan));
        let water = ('·', Style::ink(Colour::Blue));
        draw_board(canvas, self.board, |cell| {
            let last = self.last == Some(cell as u16);
            let (symbol, style) = match (view, self.cells[cell]) {
                (View::Observed, _) if last => [miss, hit][usize::from(self.observed)],
                (View::Observed, _) | (View::Revealed, 0) => water,
                (View::Revealed, SHIP) => ('█', Style::ink(Colour::White)),
                (View::Revealed, SHOT) => miss,
                (View::Revealed, _) => hit,
            };
            (symbol, if last { style.on(Colour::Grey) } else { style })
        });
    }
}
