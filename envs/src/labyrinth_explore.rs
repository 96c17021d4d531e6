//! **LabyrinthExplore**: visit every free cell of a maze, seeing only the cells around.
//!
//! | | |
//! |---|---|
//! | observation | `MultiDiscrete([5; 10])`: the 3x3 window (0 free, 1 wall, 2 start), row by row, and the last action (4 at the start) |
//! | action | `Discrete(4)`: left, right, up, down |
//! | reward | `1 / free` for a step to a free cell never visited before, else `-1 / 1024` |
//! | end | terminates when all free cells were visited; truncates after 1023 steps |
//! | state | `[(2c + 1)^2]`, row by row: the grid, with 4 for every cell that was not visited |
//!
//! The maze has `c` corridors a side, and so `free = 2c^2 - 1`, without the start; [`crate::maze`] says how it is drawn.
//! The agent starts in the outer wall. Both flags can be set in the same step. Quirks kept: the end of the maze, opposite
//! the start, stays a wall; a step to a new cell does not cost what other steps cost; the window is not centred at the
//! upper and left borders: it is cut there and filled up with walls below and to the right; walking into a wall is a step
//! that stays; the window does not mark visited cells, and the hidden state does not tell where the agent is.
//!
//! Source: Morad et al., ICLR 2023, the navigation environments; mazes by hunt and kill as in mazelib; rules as in the
//! Python package 1.0.7, which agrees with the version behind the paper's numbers.

use crate::canvas::{Canvas, View};
use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step, world_value};
use crate::maze::{ACTIONS, MAX_STEPS, Maze, PENALTY, WALL};
use crate::rng::EpisodeRng;
use crate::space::{Space, Value, ValueMut};

pub use crate::maze::{LEVELS, Params, World};

/// The game.
#[derive(Clone, Debug)]
pub struct LabyrinthExplore {
    spec: EnvSpec,
    maze: Maze,
    steps: u32,
    /// Free cells not yet visited.
    left: usize,
    /// The reward of a new cell.
    unit: f64,
}

impl LabyrinthExplore {
    /// A game of the given size, under the id `id`.
    ///
    /// # Panics
    /// If the number of corridors is not from 1 to 100.
    pub fn new(id: &str, params: Params) -> Self {
        let maze = Maze::new(params, WALL);
        let spec = EnvSpec {
            id: id.to_owned(),
            observation: Maze::observation_space(),
            action: Space::Discrete(ACTIONS.len() as u16),
            state: maze.state_space(),
            max_steps: MAX_STEPS,
            return_range: (f64::from(MAX_STEPS) * PENALTY, 1.0),
        };
        Self { spec, maze, steps: 0, left: 0, unit: 0.0 }
    }
}

impl Env for LabyrinthExplore {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn draw_world(&mut self, rng: &mut EpisodeRng) {
        self.maze.draw(rng);
    }

    fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String> {
        self.maze.set(world)
    }

    fn world(&self) -> serde_json::Value {
        world_value(&self.maze.world())
    }

    fn begin(&mut self, _draws: &mut dyn Draws, observation: ValueMut<'_>) {
        self.maze.begin();
        (self.steps, self.left) = (0, self.maze.free());
        self.unit = 1.0 / self.left as f64;
        self.maze.observe(observation.discrete);
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let new = self.maze.advance(action.discrete[0]).new;
        self.left -= usize::from(new);
        self.steps += 1;
        self.maze.observe(observation.discrete);
        Step {
            reward: [PENALTY, self.unit][usize::from(new)],
            terminated: self.left == 0,
            truncated: self.steps >= MAX_STEPS,
        }
    }

    fn state(&self, state: ValueMut<'_>) {
        self.maze.state(state.discrete);
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        self.maze.render(view, canvas);
    }

    fn action_names(&self) -> &'static [&'static str] {
        &ACTIONS
    }
}
