//! **MineSweeper**: click every cell without a mine, told only how many mines are around the last click.
//!
//! | | |
//! |---|---|
//! | observation | `Discrete(min(mines + 1, 10))`: mines in the 3x3 cells around the last click; 0 at the start |
//! | action | `MultiDiscrete([n, n])`: row and column of the next click |
//! | reward | `1 / clear` for a new clear cell, `-0.5 / (clear - 2)` for one clicked before, `-0.5 - 1 / clear` for a mine |
//! | end | terminates on a mine, or when all clear cells were clicked; else truncates after `clear` steps |
//! | state | `[n * n]`, row-major: 0 a clear cell, 1 a mine, 2 a clear cell that was clicked |
//!
//! `clear = n^2 - mines` is the number of cells without a mine. The two flags are never set together. Quirks kept: the
//! count includes the clicked cell itself, so that a clicked mine counts at least 1; the first click may be a mine; a
//! count of 0 opens nothing else; the observation does not tell where the click went.
//!
//! Source: Morad et al., ICLR 2023, the game environments; rules as in the Python package 1.0.7. The version behind the
//! paper's numbers allowed one more step.

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
    /// Rows, and columns, of the board, from 2 to 8.
    pub board: usize,
    /// Number of mines; at least 3 cells are without one.
    pub mines: usize,
}

/// Easy, medium, hard.
pub const LEVELS: [Params; 3] =
    [Params { board: 4, mines: 2 }, Params { board: 6, mines: 6 }, Params { board: 8, mines: 10 }];

/// Cells of the largest board: a set of cells is one `u64`, bit `row * n + column`.
const MAX_CELLS: usize = 64;

/// What a reset draws.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct World {
    /// `[n][n]`, row by row: 1 is a mine, 0 is clear.
    pub mines: Vec<Vec<u8>>,
}

/// The game.
#[derive(Clone, Debug)]
pub struct MineSweeper {
    spec: EnvSpec,
    board: usize,
    mine_count: u32,
    /// Rewards of a new cell, of one clicked before, and of a mine.
    rewards: [f64; 3],
    /// For each cell, those around it and itself.
    around: [u64; MAX_CELLS],
    all: u64,
    mines: u64,
    clicked: u64,
    steps: u32,
    observed: u8,
    /// The last click's cell, if there was one.
    last: Option<u8>,
}

impl MineSweeper {
    /// A game of the given size, under the id `id`.
    ///
    /// # Panics
    /// If the board is not from 2 to 8 cells wide, if there is no mine, or if fewer than 3 cells are without one.
    pub fn new(id: &str, Params { board, mines }: Params) -> Self {
        assert!((2..=8).contains(&board), "the board is {board} wide, allowed is 2..=8");
        let cells = board * board;
        assert!((1..=cells - 3).contains(&mines), "there are {mines} mines, allowed is 1..={}", cells - 3);
        let clear = (cells - mines) as f64;
        let spec = EnvSpec {
            id: id.to_owned(),
            observation: Space::Discrete((mines + 1).min(10) as u16),
            action: Space::MultiDiscrete(vec![board as u16; 2]),
            state: Space::MultiDiscrete(vec![3; cells]),
            max_steps: (cells - mines) as u32,
            return_range: (-1.0, 1.0),
        };
        let near = |a: usize, b: usize| a.abs_diff(b) <= 1;
        let mut around = [0; MAX_CELLS];
        for (cell, around) in around[..cells].iter_mut().enumerate() {
            *around = (0..cells)
                .filter(|other| near(cell / board, other / board) && near(cell % board, other % board))
                .fold(0, |set, other| set | 1 << other);
        }
        Self {
            spec,
            board,
            mine_count: mines as u32,
            rewards: [1.0 / clear, -0.5 / (clear - 2.0), -0.5 - 1.0 / clear],
            around,
            all: u64::MAX >> (MAX_CELLS - cells),
            // Any will do until the first world is drawn or set.
            mines: (1 << mines) - 1,
            clicked: 0,
            steps: 0,
            observed: 0,
            last: None,
        }
    }

    fn cells(&self) -> usize {
        self.board * self.board
    }

    /// Whether `set` holds `cell`.
    fn has(set: u64, cell: usize) -> bool {
        set >> cell & 1 == 1
    }

    fn count(&self, cell: usize) -> u8 {
        (self.mines & self.around[cell]).count_ones() as u8
    }
}

impl Env for MineSweeper {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    /// Floyd's algorithm (Bentley and Floyd, "A Sample of Brilliance", 1987): one draw a mine, all sets equally likely.
    fn draw_world(&mut self, rng: &mut EpisodeRng) {
        let cells = self.cells() as u32;
        self.mines = 0;
        for last in cells - self.mine_count..cells {
            let drawn = below(rng, last + 1);
            self.mines |= 1 << if Self::has(self.mines, drawn as usize) { last } else { drawn };
        }
    }

    fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String> {
        let World { mines } = parse_world(world)?;
        let n = self.board;
        if mines.len() != n || mines.iter().any(|row| row.len() != n) {
            return Err(format!("the mines are not {n} rows of {n} cells"));
        }
        let cells = mines.concat();
        if let Some(cell) = cells.iter().find(|&&cell| cell > 1) {
            return Err(format!("a cell of the mines is {cell}, allowed is 0 or 1"));
        }
        let set = cells.iter().rev().fold(0, |set, &cell| set << 1 | u64::from(cell));
        if set.count_ones() != self.mine_count {
            return Err(format!("there are {} mines, expected {}", set.count_ones(), self.mine_count));
        }
        self.mines = set;
        Ok(())
    }

    fn world(&self) -> serde_json::Value {
        let n = self.board;
        let row = |row: usize| (0..n).map(|column| u8::from(Self::has(self.mines, row * n + column))).collect();
        world_value(&World { mines: (0..n).map(row).collect() })
    }

    fn begin(&mut self, _draws: &mut dyn Draws, observation: ValueMut<'_>) {
        (self.clicked, self.steps, self.observed, self.last) = (0, 0, 0, None);
        observation.discrete[0] = 0;
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let cell = usize::from(action.discrete[0]) * self.board + usize::from(action.discrete[1]);
        let (mine, before) = (Self::has(self.mines, cell), Self::has(self.clicked, cell));
        self.clicked |= 1 << cell & !self.mines;
        self.steps += 1;
        (self.observed, self.last) = (self.count(cell), Some(cell as u8));
        observation.discrete[0] = self.observed;
        let terminated = mine || self.clicked | self.mines == self.all;
        Step {
            // A mine is never among the clicked cells.
            reward: self.rewards[usize::from(before) + 2 * usize::from(mine)],
            terminated,
            truncated: self.steps >= self.spec.max_steps && !terminated,
        }
    }

    fn state(&self, state: ValueMut<'_>) {
        for (cell, out) in state.discrete.iter_mut().enumerate() {
            *out = if Self::has(self.mines, cell) { 1 } else { 2 * u8::from(Self::has(self.clicked, cell)) };
        }
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        let unknown = ('·', Style::ink(Colour::Grey));
        // Counts in the colours that the game usually has, as far as a terminal has them.
        let counted = |count: u8| {
            let ink = match count {
                0 => Colour::Grey,
                1 => Colour::Blue,
                2 => Colour::Green,
                3 => Colour::Red,
                _ => Colour::Magenta,
            };
            (char::from(b'0' + count), Style::ink(ink).bold())
        };
        draw_board(canvas, self.board, |cell| {
            let last = self.last == Some(cell as u8);
            let (symbol, style) = match view {
                View::Observed if last => counted(self.observed),
                View::Revealed if Self::has(self.mines, cell) => {
                    (if last { '×' } else { '●' }, Style::ink(Colour::Red).bold())
                }
                View::Revealed if Self::has(self.clicked, cell) => counted(self.count(cell)),
                View::Observed | View::Revealed => unknown,
            };
            (symbol, if last { style.on(Colour::White) } else { style })
        });
    }
}
