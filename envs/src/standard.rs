//! The benchmark's own environments: 16 games, each at three difficulties.

use crate::autoencode::{self, Autoencode};
use crate::battleship::{self, Battleship};
use crate::cart_pole::{self, PositionOnlyCartPole};
use crate::concentration::{self, Concentration};
use crate::count_recall::{self, CountRecall};
use crate::env::{Difficulty, Env};
use crate::higher_lower::{self, HigherLower};
use crate::labyrinth_escape::{self, LabyrinthEscape};
use crate::labyrinth_explore::{self, LabyrinthExplore};
use crate::mine_sweeper::{self, MineSweeper};
use crate::multiarmed_bandit::{self, MultiarmedBandit};
use crate::noisy_cart_pole::{self, NoisyPositionOnlyCartPole};
use crate::noisy_pendulum::{self, NoisyPositionOnlyPendulum};
use crate::pendulum::{self, PositionOnlyPendulum};
use crate::registry::Registry;
use crate::repeat_first::{self, RepeatFirst};
use crate::repeat_previous::{self, RepeatPrevious};
use crate::velocity_only_cart_pole::{self, VelocityOnlyCartPole};

/// What the paper calls a game.
#[derive(Clone, Copy)]
enum Paper {
    /// As the package does.
    Same,
    /// Otherwise.
    Name(&'static str),
    /// It is not in the paper.
    Absent,
}

impl Registry {
    /// The environments of this crate, group by group and game by game, each from easy to hard.
    pub fn standard() -> Self {
        use Paper::{Absent, Name, Same};
        let mut r = Self::new();
        r.levels("diagnostic", "RepeatFirst", Same, repeat_first::LEVELS, RepeatFirst::new);
        r.levels("diagnostic", "RepeatPrevious", Same, repeat_previous::LEVELS, RepeatPrevious::new);
        r.levels("diagnostic", "Autoencode", Same, autoencode::LEVELS, Autoencode::new);
        r.levels("diagnostic", "CountRecall", Same, count_recall::LEVELS, CountRecall::new);
        let (cart_pole, pendulum) = (Name("StatelessCartPole"), Name("StatelessPendulum"));
        r.levels("control", "PositionOnlyCartPole", cart_pole, cart_pole::LEVELS, PositionOnlyCartPole::new);
        r.levels("control", "PositionOnlyPendulum", pendulum, pendulum::LEVELS, PositionOnlyPendulum::new);
        let velocity = velocity_only_cart_pole::LEVELS;
        r.levels("control", "VelocityOnlyCartPole", Absent, velocity, VelocityOnlyCartPole::new);
        let (cart_pole, pendulum) = (Name("NoisyStatelessCartPole"), Name("NoisyStatelessPendulum"));
        let noisy = noisy_cart_pole::LEVELS;
        r.levels("noisy", "NoisyPositionOnlyCartPole", cart_pole, noisy, NoisyPositionOnlyCartPole::new);
        let noisy = noisy_pendulum::LEVELS;
        r.levels("noisy", "NoisyPositionOnlyPendulum", pendulum, noisy, NoisyPositionOnlyPendulum::new);
        r.levels("noisy", "MultiarmedBandit", Same, multiarmed_bandit::LEVELS, MultiarmedBandit::new);
        r.levels("game", "Battleship", Same, battleship::LEVELS, Battleship::new);
        r.levels("game", "Concentration", Same, concentration::LEVELS, Concentration::new);
        r.levels("game", "HigherLower", Same, higher_lower::LEVELS, HigherLower::new);
        r.levels("game", "MineSweeper", Same, mine_sweeper::LEVELS, MineSweeper::new);
        r.levels("navigation", "LabyrinthEscape", Same, labyrinth_escape::LEVELS, LabyrinthEscape::new);
        r.levels("navigation", "LabyrinthExplore", Same, labyrinth_explore::LEVELS, LabyrinthExplore::new);
        r
    }

    /// Registers the three difficulties of a game that the package calls `class`.
    fn levels<P, E>(&mut self, group: &str, class: &str, paper: Paper, levels: [P; 3], new: fn(&str, P) -> E)
    where
        P: Copy + Send + Sync + 'static,
        E: Env + 'static,
    {
        for (difficulty, level) in Difficulty::ALL.into_iter().zip(levels) {
            let name = format!("{class}{difficulty}");
            // The only id that the Python package spells unlike its class.
            let id = format!("popgym-{}-v0", name.replace("VelocityOnlyCartPole", "VelocityOnlyCartpole"));
            let paper_name = match paper {
                Paper::Same => Some(name.clone()),
                Paper::Name(paper) => Some(format!("{paper}{difficulty}")),
                Paper::Absent => None,
            };
            let aliases: Vec<&str> = paper_name.as_deref().filter(|&paper| paper != name).into_iter().collect();
            self.register(&name, &aliases, group, move || new(&id, level))
                .expect("this crate's own names differ and its specs are valid, which its tests check");
            self.set_paper_name(paper_name);
        }
    }
}
