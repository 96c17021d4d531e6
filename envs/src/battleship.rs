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

use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step, parse_world};
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
    /// `[n][n]`, row by row: 1 is a ship, 0 is water.
    pub ships: Vec<Vec<u8>>,
}

/// The game.
#[derive(Clone, Debug)]
pub struct Battleship {
    spec: EnvSpec,
    board: usize,
    /// Rewards of a miss and of a hit.
    rewards: [f64; 2],
    /// `[n * n]`, 0 or 1.
    ships: Vec<u8>,
    /// `[n * n]`, 0 or 1.
    shot: Vec<u8>,
    hits: u32,
    steps: u32,
    observed: u8,
}

impl Battleship {
    /// A game of the given size, under the id `id`.
    ///
    /// # Panics
    /// If the board is not from 5 to 256 cells wide (on a smaller one the ships might not fit).
    pub fn new(id: &str, Params { board }: Params) -> Self {
        assert!((5..=256).contains(&board), "the board is {board} wide, allowed is 5..=256");
        let cells = board * board;
        let water = (cells as u32 - SHIP_CELLS) as f64;
        let spec = EnvSpec {
            id: id.to_owned(),
            observation: Space::Discrete(2),
            action: Space::MultiDiscrete(vec![board as u16; 2]),
            state: Space::Tuple(vec![
                Space::MultiDiscrete(vec![2; cells]),
                Space::MultiDiscrete(vec![2; cells]),
                Space::Discrete(2),
            ]),
            max_steps: cells as u32,
            return_range: (-(cells as f64) / water, 1.0),
        };
        // Any 12 cells will do until the first world is drawn or set.
        let ships = (0..cells as u32).map(|cell| u8::from(cell < SHIP_CELLS)).collect();
        let rewards = [-1.0 / water, 1.0 / f64::from(SHIP_CELLS)];
        Self { spec, board, rewards, ships, shot: vec![0; cells], hits: 0, steps: 0, observed: 0 }
    }

    /// Tries to place a ship of `length` cells from a random cell in a random direction.
    fn try_place(&mut self, length: usize, rng: &mut EpisodeRng) -> bool {
        // One draw for row, column and one of four directions.
        let drawn = below(rng, 4 * (self.board * self.board) as u32) as usize;
        let (start, direction) = (drawn / 4, drawn % 4);
        let (row, column) = (start / self.board, start % self.board);
        let (place, stride) = if direction < 2 { (row, self.board) } else { (column, 1) };
        let reach = length - 1;
        let first = if direction % 2 == 0 && place + reach < self.board {
            start
        } else if direction % 2 == 1 && place >= reach {
            start - reach * stride
        } else {
            return false;
        };
        if (0..length).any(|i| self.ships[first + i * stride] == 1) {
            return false;
        }
        (0..length).for_each(|i| self.ships[first + i * stride] = 1);
        true
    }
}

impl Env for Battleship {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn draw_world(&mut self, rng: &mut EpisodeRng) {
        self.ships.fill(0);
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
        self.ships = cells;
        Ok(())
    }

    fn begin(&mut self, _draws: &mut dyn Draws, observation: ValueMut<'_>) {
        self.shot.fill(0);
        (self.hits, self.steps, self.observed) = (0, 0, 0);
        observation.discrete[0] = 0;
    }

    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let cell = usize::from(action.discrete[0]) * self.board + usize::from(action.discrete[1]);
        let hit = self.ships[cell] & (1 - self.shot[cell]);
        self.shot[cell] = 1;
        self.hits += u32::from(hit);
        self.steps += 1;
        self.observed = hit;
        observation.discrete[0] = hit;
        Step {
            reward: self.rewards[usize::from(hit)],
            terminated: self.hits == SHIP_CELLS,
            truncated: self.steps >= self.spec.max_steps,
        }
    }

    fn state(&self, state: ValueMut<'_>) {
        let cells = self.ships.len();
        state.discrete[..cells].copy_from_slice(&self.ships);
        state.discrete[cells..2 * cells].copy_from_slice(&self.shot);
        state.discrete[2 * cells] = self.observed;
    }
}
