//! **LabyrinthEscape**: find the way out of a maze, seeing only the cells around.
//!
//! | | |
//! |---|---|
//! | observation | `MultiDiscrete([5; 10])`: the 3x3 window (0 free, 1 wall, 2 start, 3 goal), row by row, and the last action (4 at the start) |
//! | action | `Discrete(4)`: left, right, up, down |
//! | reward | `-1 / 1024` for every step, and 1 more for the one that reaches the goal |
//! | end | terminates on the goal; truncates after 1023 steps |
//! | state | `[(2c + 1)^2]`, row by row: the grid, with 4 for every cell that was not visited |
//!
//! The maze has `c` corridors a side; [`crate::maze`] says how it is drawn. The agent starts in the outer wall, and the
//! goal is in the wall opposite. Both flags can be set in the same step. Quirks kept: the window is not centred at the
//! upper and left borders: it is cut there and filled up with walls below and to the right; walking into a wall is a
//! step that stays; the window does not mark visited cells, and the hidden state does not tell where the agent is; the
//! reward is not as sparse as the paper's prose says, as every step costs.
//!
//! Source: Morad et al., ICLR 2023, the navigation environments; mazes by hunt and kill as in mazelib; rules as in the
//! Python package 1.0.7, which agrees with the version behind the paper's numbers.

use crate::canvas::{Canvas, View};
use crate::draws::Draws;
use crate::env::{Env, EnvSpec, Step, world_value};
use crate::maze::{ACTIONS, GOAL, MAX_STEPS, Maze, PENALTY};
use crate::rng::EpisodeRng;
use crate::space::{Space, Value, ValueMut};

pub use crate::maze::{LEVELS, Params, World};

/// The game.
#[derive(Clone, Debug)]
pub struct LabyrinthEscape {
    spec: EnvSpec,
    maze: Maze,
    steps: u32,
}

impl LabyrinthEscape {
    /// A game of the given size, under the id `id`.
    ///
    /// # Panics
    /// If the number of corridors is not from 1 to 100.
    pub fn new(id: &str, params: Params) -> Self {
        let maze = Maze::new(params, GOAL);
        let spec = EnvSpec {
            id: id.to_owned(),
            observation: Maze::observation_space(),
            action: Space::Discrete(ACTIONS.len() as u16),
            state: maze.state_space(),
            max_steps: MAX_STEPS,
            // From never arriving to a goal next to the start.
            return_range: (f64::from(MAX_STEPS) * PENALTY, 1.0 + PENALTY),
        };
        Self { spec, maze, steps: 0 }
    }
}

impl Env for LabyrinthEscape {
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
        self.steps = 0;
        self.maze.observe(observation.discrete);
    }

    #[inline]
    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let arrival = self.maze.advance(action.discrete[0]);
        self.steps += 1;
        self.maze.observe(observation.discrete);
        let terminated = arrival.cell == GOAL;
        Step {
            reward: if terminated { 1.0 + PENALTY } else { PENALTY },
            terminated,
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
