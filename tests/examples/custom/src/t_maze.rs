//! **T-maze** (Bakker, "Reinforcement Learning with Long Short-Term Memory", 2002): a sign at the start of a corridor
//! says which way to turn at its end.
//!
//! | | |
//! |---|---|
//! | observation | `Discrete(4)`: 0 or 1 the sign (at the start), 2 the corridor, 3 the junction |
//! | action | `Discrete(3)`: forward, left, right |
//! | reward | 1 for the right turn, -1 for the wrong one; `-1 / length` for turning in the corridor |
//! | end | terminates with a turn at the junction; truncates after `2 length` steps |
//! | state | the sign, how far the junction is |

use popgym_envs::rng::below;
use popgym_envs::{
    Canvas, Draws, Env, EnvSpec, EpisodeRng, Space, Step, Style, Value, ValueMut, View, parse_world, world_value,
};
use serde::{Deserialize, Serialize};

/// What a reset draws.
#[derive(Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct World {
    /// 0: the junction is to be left leftwards, 1: rightwards.
    sign: u8,
}

/// The game.
pub(crate) struct TMaze {
    spec: EnvSpec,
    length: u8,
    world: World,
    position: u8,
    steps: u32,
}

impl TMaze {
    /// A corridor of `length` steps, under the id `id`.
    pub(crate) fn new(id: &str, length: u8) -> Self {
        let max_steps = 2 * u32::from(length);
        let spec = EnvSpec {
            id: id.to_owned(),
            observation: Space::Discrete(4),
            action: Space::Discrete(3),
            state: Space::MultiDiscrete(vec![2, u16::from(length) + 1]),
            max_steps,
            return_range: (-2.0, 1.0),
        };
        Self { spec, length, world: World { sign: 0 }, position: 0, steps: 0 }
    }

    fn seen(&self) -> u8 {
        match self.position {
            0 => self.world.sign,
            position if position < self.length => 2,
            _ => 3,
        }
    }
}

impl Env for TMaze {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn draw_world(&mut self, rng: &mut EpisodeRng) {
        self.world.sign = below(rng, 2) as u8;
    }

    fn set_world(&mut self, world: &serde_json::Value) -> Result<(), String> {
        let world: World = parse_world(world)?;
        if world.sign > 1 {
            return Err(format!("the sign is {}, allowed is 0 or 1", world.sign));
        }
        self.world = world;
        Ok(())
    }

    fn world(&self) -> serde_json::Value {
        world_value(&self.world)
    }

    fn begin(&mut self, _draws: &mut dyn Draws, observation: ValueMut<'_>) {
        (self.position, self.steps) = (0, 0);
        observation.discrete[0] = self.seen();
    }

    fn step(&mut self, action: Value<'_>, _draws: &mut dyn Draws, observation: ValueMut<'_>) -> Step {
        let (turn, at_junction) = (action.discrete[0].checked_sub(1), self.position == self.length);
        let reward = match turn {
            Some(turn) if at_junction => {
                if turn == self.world.sign {
                    1.0
                } else {
                    -1.0
                }
            }
            Some(_) => -1.0 / f64::from(self.length),
            None => 0.0,
        };
        self.position += u8::from(turn.is_none() && !at_junction);
        self.steps += 1;
        observation.discrete[0] = self.seen();
        Step { reward, terminated: turn.is_some() && at_junction, truncated: self.steps >= self.spec.max_steps }
    }

    fn state(&self, state: ValueMut<'_>) {
        state.discrete.copy_from_slice(&[self.world.sign, self.length - self.position]);
    }

    fn render(&self, view: View, canvas: &mut Canvas) {
        if view == View::Observed {
            // Where in the corridor it is, the agent must remember.
            let seen = ["←", "→", "corridor", "junction"][usize::from(self.seen())];
            canvas.put(0, 0, seen, Style::PLAIN.bold());
            return;
        }
        canvas.put(0, 0, ["←", "→"][usize::from(self.world.sign)], Style::PLAIN.bold());
        canvas.put(1, 0, &"·".repeat(usize::from(self.length) + 1), Style::PLAIN);
        canvas.put(1, usize::from(self.position), "@", Style::PLAIN.bold());
    }

    fn action_names(&self) -> &'static [&'static str] {
        &["forward", "left", "right"]
    }
}
