//! What the paper printed (Morad et al., ICLR 2023, appendix), and what has to be known to set it beside other results.

use std::collections::BTreeMap;

use anyhow::Context as _;
use popgym_envs::Difficulty;
use serde::Deserialize;

/// Trials behind each of the paper's figures.
pub const TRIALS: usize = 3;

/// The paper prints three places: its figures are as exact as this.
pub const ROUNDING: f64 = 0.0005;

/// The memories in the order of the paper's tables, by the names there.
pub const MEMORIES: [&str; 13] =
    ["MLP", "PosMLP", "FWP", "FART", "S4D", "TCN", "Fr.Stack", "LMU", "IndRNN", "Elman", "GRU", "LSTM", "DNC"];

/// The place of `memory` in the paper's tables; memories that are not there come last.
pub fn place(memory: &str) -> usize {
    MEMORIES.iter().position(|known| *known == memory).unwrap_or(usize::MAX)
}

/// MMER of the paper, over [`TRIALS`] trials.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Score {
    /// Mean.
    pub mean: f64,
    /// Standard deviation.
    pub std: f64,
}

/// The paper's table.
pub struct Paper(BTreeMap<(String, String, String), Score>);

#[derive(Deserialize)]
struct Row {
    env: String,
    difficulty: String,
    model: String,
    mmer_mean: f64,
    mmer_std: f64,
}

impl Paper {
    /// The table that is part of this program.
    ///
    /// # Errors
    /// None that can be caused from outside.
    pub fn embedded() -> anyhow::Result<Self> {
        let mut reader = csv::Reader::from_reader(include_str!("paper-mmer.csv").as_bytes());
        let rows = reader.deserialize().map(|row: Result<Row, _>| {
            let row = row?;
            Ok(((row.env, row.difficulty, row.model), Score { mean: row.mmer_mean, std: row.mmer_std }))
        });
        Ok(Self(rows.collect::<Result<_, csv::Error>>().context("the paper's table")?))
    }

    /// The score of `memory` in `game`, both by the paper's names.
    pub fn score(&self, game: &str, difficulty: Difficulty, memory: &str) -> Option<Score> {
        self.0.get(&(game.to_owned(), difficulty.to_string(), memory.to_owned())).copied()
    }
}

/// Environment steps of the paper's runs of `memory`.
pub fn steps(memory: &str) -> u64 {
    if memory == "DNC" { 10_000_000 } else { 15_000_000 }
}

/// Why the paper's figures of `memory` are of another model than its equations describe, if they are.
pub fn memory_mark(memory: &str) -> Option<&'static str> {
    match memory {
        "FART" => Some("the paper's FART had a wrong denominator, and neither residual nor feed-forward layer"),
        "FWP" => Some("the paper's FWP had a wrong contraction, and neither residual nor feed-forward layer"),
        "S4D" => Some("the paper's S4D kept its first discretisation while its parameters changed"),
        "DNC" => Some(
            "the paper's DNC was not trained (the optimiser did not have its parameters), nor was the critic; \
             10M steps, on older environments without previous action",
        ),
        "IndRNN" => Some("the paper's IndRNN ignored its activation and began with biases in (0, 1)"),
        _ => None,
    }
}

/// `name`, with an asterisk if there is a mark.
pub fn marked(name: &str, mark: Option<&str>) -> String {
    format!("{name}{}", if mark.is_some() { "*" } else { "" })
}

/// What changed in the rules of `game` after the paper, if anything did.
pub fn game_mark(game: &str) -> Option<&'static str> {
    match game {
        "CountRecall" => Some("in the paper the largest count could not be answered"),
        "MineSweeper" => Some("in the paper an episode had one more step"),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use popgym_envs::Registry;

    use super::*;

    #[test]
    fn every_memory_has_a_score_in_every_environment() {
        let paper = Paper::embedded().unwrap();
        assert_eq!(paper.0.len(), 585);
        let envs = Registry::standard();
        let names: Vec<&str> = envs.iter().filter_map(|entry| entry.paper_name.as_deref()).collect();
        assert_eq!(names.len(), 45);
        for name in names {
            let difficulty = Difficulty::ALL.into_iter().find(|level| name.ends_with(&level.to_string())).unwrap();
            let game = name.strip_suffix(&difficulty.to_string()).unwrap();
            assert!(MEMORIES.iter().all(|memory| paper.score(game, difficulty, memory).is_some()), "{name}");
        }
        let known = popgym_models::memory::Registry::standard();
        assert!(known.entries().iter().all(|entry| MEMORIES.contains(&entry.paper_name)));
        let score = paper.score("Autoencode", Difficulty::Easy, "Elman");
        assert_eq!(score, Some(Score { mean: -0.306, std: 0.022 }));
        assert_eq!(paper.score("Autoencode", Difficulty::Easy, "elman"), None);
    }
}
