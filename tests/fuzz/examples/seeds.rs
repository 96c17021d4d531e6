//! Writes the inputs that fuzzing starts from below a folder: `cargo run -p popgym-fuzz --example seeds -- FOLDER`. What they
//! come to, minimised, is `corpus/`.

use std::error::Error;
use std::io::{BufRead as _, BufReader};
use std::path::Path;

use bytes::Bytes;
use popgym_envs::{Leaf, Observability, Registry, Space};
use popgym_fuzz::{checkpoint_input, episode_specs, weights_example};
use popgym_learner::adam::AdamState;
use popgym_learner::checkpoint::{Checkpoint, Progress};
use popgym_learner::config::Config;
use popgym_models::memory;
use popgym_proto::{
    ActorMessage, Columns, Episode, EpisodeBatch, Hello, LearnerMessage, Leases, OpenEpoch, PROTOCOL_VERSION, RunSpec,
    WeightSet,
};
use prost::Message as _;
use tch::Tensor;
use toml::Table;

/// A recorded episode of each kind of world and action, the shortest that there is; of long ones, as many steps as matter.
const EPISODES: [(&str, usize); 13] = [
    ("MineSweeperEasy", usize::MAX),
    ("BattleshipEasy", usize::MAX),
    ("HigherLowerEasy", usize::MAX),
    ("CountRecallEasy", usize::MAX),
    ("RepeatFirstEasy", usize::MAX),
    ("RepeatPreviousEasy", usize::MAX),
    ("PositionOnlyCartPoleHard", usize::MAX),
    ("NoisyPositionOnlyCartPoleMedium", usize::MAX),
    ("NoisyPositionOnlyPendulumHard", 4),
    ("LabyrinthEscapeEasy", usize::MAX),
    ("LabyrinthExploreEasy", 2),
    ("ConcentrationEasy", 4),
    ("MultiarmedBanditEasy", 4),
];

type Result<T> = std::result::Result<T, Box<dyn Error>>;

fn main() -> Result<()> {
    let folder = std::env::args().nth(1).ok_or("usage: seeds FOLDER")?;
    let write = |target: &str, name: &str, bytes: &[u8]| -> Result<()> {
        let folder = Path::new(&folder).join(target);
        std::fs::create_dir_all(&folder)?;
        Ok(std::fs::write(folder.join(name), bytes)?)
    };
    for (message, number) in actor_messages().into_iter().zip(0..) {
        write("wire", &format!("actor-{number}"), &message.into_wire().encode_to_vec())?;
    }
    for (message, number) in learner_messages()?.into_iter().zip(0..) {
        write("wire", &format!("learner-{number}"), &message.into_wire().encode_to_vec())?;
    }
    write("weights", "whole", &weights_example())?;
    for (name, sampling) in [("sampling", &b"those before"[..]), ("weights", b"the newest")] {
        write("checkpoint", name, &checkpoint_input(&checkpoint(sampling)))?;
    }
    for (name, text) in configurations()? {
        write("configuration", &name, text.as_bytes())?;
    }
    for (name, text) in studies() {
        write("study", name, text.as_bytes())?;
    }
    for (name, steps) in EPISODES {
        write("recording", name, episode(name, steps)?.as_bytes())?;
    }
    Ok(())
}

fn actor_messages() -> Vec<ActorMessage> {
    let hello = Hello {
        protocol_version: PROTOCOL_VERSION,
        build: "0.1.0".to_owned(),
        actor: "actor-1".to_owned(),
        key: 7,
        incarnation: 2,
        slots: 128,
        run: Some("first".to_owned()),
    };
    let batches = episode_specs().map(|spec| {
        let episode = |index, steps| Episode {
            index,
            steps,
            observations: columns(&spec.observation, steps + 1),
            actions: columns(&spec.action, steps),
            rewards: vec![0.5; steps],
            log_probs: vec![-0.5; steps],
            terminated: index == 0,
            truncated: index > 0,
        };
        let last = spec.max_steps.min(3) as usize;
        ActorMessage::Episodes(EpisodeBatch { epoch: 2, version: 1, episodes: vec![episode(0, 1), episode(1, last)] })
    });
    let others = [ActorMessage::Hello(hello), ActorMessage::Ready([7; 32]), ActorMessage::Heartbeat];
    others.into_iter().chain(batches).collect()
}

/// Rows of the largest classes, and of ones.
fn columns(space: &Space, rows: usize) -> Columns {
    let mut columns = Columns { discrete: Bytes::new(), real: vec![1.0; rows * space.real_width()] };
    let classes = space.leaves().into_iter().filter_map(|leaf| match leaf {
        Leaf::Discrete { classes } => Some((classes - 1) as u8),
        Leaf::Real { .. } => None,
    });
    columns.discrete = classes.collect::<Vec<u8>>().repeat(rows).into();
    columns
}

fn learner_messages() -> Result<Vec<LearnerMessage>> {
    let spec = RunSpec {
        run: "first".to_owned(),
        env: "popgym-RepeatPreviousEasy-v0".to_owned(),
        observability: Observability::FullAndPartial,
        max_episode_steps: 64,
        memory: "gru".to_owned(),
        memory_options: "hidden_size = 256".parse()?,
        policy_options: "log_std_max = inf\nlog_std_min = -3.0".parse()?,
        seed: 3,
        lag: 1,
        rows: 128,
        evaluation: true,
        greedy: true,
    };
    let weights = WeightSet::new(3, weights_example().into())?;
    Ok(vec![
        LearnerMessage::Welcome(spec),
        LearnerMessage::Epoch(OpenEpoch { epoch: 4, version: 3, weights: Some(weights) }),
        LearnerMessage::Epoch(OpenEpoch { epoch: 4, version: 3, weights: None }),
        LearnerMessage::Leases(Leases { epoch: 4, episodes: vec![0, 1, 300] }),
        LearnerMessage::Closed { epoch: 4 },
        LearnerMessage::Stop { reason: "the run is complete".to_owned() },
        LearnerMessage::Heartbeat,
    ])
}

fn checkpoint(sampling: &'static [u8]) -> Checkpoint {
    let moment = |value: f32| Tensor::from_slice(&[value; 3]);
    Checkpoint {
        progress: Progress {
            epoch: 12,
            env_steps: 98_304,
            episodes: 1_927,
            kl_coef: 0.2,
            mmer: Some(0.25),
            mean_return: None,
            recent_returns: vec![0.1, -1.0 / 3.0],
            wall_seconds: 61.5,
        },
        weights: Bytes::from_static(b"the newest"),
        sampling: Bytes::from_static(sampling),
        optimizer: AdamState { first_moment: moment(0.5), second_moment: moment(2e-9), steps: 288 },
    }
}

/// All keys, and each memory with small sizes.
fn configurations() -> Result<Vec<(String, String)>> {
    let (envs, memories) = (Registry::standard(), memory::Registry::standard());
    let resolve = |text: &str| Config::resolve(&text.parse::<Table>()?, &Table::new(), &envs, &memories)?.to_toml();
    let mut texts = vec![
        ("paper".to_owned(), resolve("preset = 'paper'\nstop_at_mmer = 0.9\nmemory.hidden_size = 8")?),
        (
            "control".to_owned(),
            resolve("env = 'PositionOnlyPendulumEasy'\nobservability = 'full'\nmemory.name = 'mlp'")?,
        ),
        ("listens".to_owned(), "service.listen = '[::1]:5'\nservice.metrics_listen = '127.0.0.1:9'".to_owned()),
    ];
    for entry in memories.entries() {
        let mut options = entry.resolve(&Table::new())?;
        for (_, value) in &mut options {
            if let toml::Value::Integer(size) = value {
                *size = (*size).min(8);
            }
        }
        options.insert("name".to_owned(), entry.name.into());
        let memory = Table::from_iter([("memory".to_owned(), options.into())]);
        texts.push((entry.name.to_owned(), memory.to_string()));
    }
    Ok(texts)
}

fn studies() -> [(&'static str, &'static str); 3] {
    [
        ("quick", include_str!("../../../learner/studies/quick.toml")),
        (
            "overrides",
            "[run]\npreset = 'paper'\nsteps = 1_000\nstop_at_mmer = 0.9\nmemory.hidden_size = 8\nppo.gamma = 0.5\n\n\
             [[product]]\nenvs = ['RepeatFirst', 'StatelessCartPoleEasy']\nmemories = ['lmu', 'mlp']\nseeds = [0, 7]\n\n\
             [[override]]\nenvs = ['diagnostic']\nrun = { steps = 3_000, service = { actors = 3 } }\n\n\
             [[override]]\nmemories = ['lmu']\nrun = { memory = { theta = 9.0, memory_size = 4 } }\n",
        ),
        ("largest", "[[product]]\nenvs = ['all']\nmemories = ['mlp', 'gru']\nseeds = [1, 2, 3, 4, 5, 6, 7, 8, 9]\n"),
    ]
}

/// The shortest recorded episode of an environment, or its first `steps` steps.
fn episode(env: &str, steps: usize) -> Result<String> {
    let path = format!("{}/../../envs/tests/traces/popgym-{env}-v0.jsonl.gz", env!("CARGO_MANIFEST_DIR"));
    let lines = BufReader::new(flate2::read::GzDecoder::new(std::fs::File::open(path)?)).lines();
    let lines = lines.collect::<std::io::Result<Vec<String>>>()?;
    let shortest = lines.iter().min_by_key(|line| line.len()).ok_or("there is no episode")?;
    let mut episode: serde_json::Value = serde_json::from_str(shortest)?;
    for (key, rows) in
        [("actions", steps), ("rewards", steps), ("obs", steps.saturating_add(1)), ("states", steps.saturating_add(1))]
    {
        episode[key].as_array_mut().ok_or("a recording holds lists")?.truncate(rows);
    }
    Ok(episode.to_string())
}
