//! Episodes of the Python package, version 1.0.7, replayed to the last step.
//!
//! `POPGYM_TRACES=/some/folder cargo test --release -p popgym-envs --test replay` replays every `*.jsonl.gz` of another
//! folder (one JSON object per line and episode) and says how much of each environment matched. A relative path starts
//! at the repository's root.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};

use flate2::read::GzDecoder;
use popgym_envs::Registry;
use serde_json::Value as Json;

#[path = "common/recording.rs"]
mod recording;

use recording::replay_line;

/// Replays every recording of a folder; gives episodes and steps by id.
fn replay_folder(registry: &Registry, folder: &Path) -> Result<BTreeMap<String, (usize, usize)>, String> {
    let unreadable = |error: std::io::Error| format!("{}: {error}", folder.display());
    let files: Result<Vec<PathBuf>, _> =
        std::fs::read_dir(folder).map_err(unreadable)?.map(|entry| entry.map(|entry| entry.path())).collect();
    let mut files = files.map_err(unreadable)?;
    files.retain(|path| path.to_string_lossy().ends_with(".jsonl.gz"));
    files.sort();
    if files.is_empty() {
        return Err(format!("{}: no *.jsonl.gz there", folder.display()));
    }
    let mut matched = BTreeMap::new();
    for path in files {
        let file = std::fs::File::open(&path).map_err(|error| format!("{}: {error}", path.display()))?;
        let mut episodes = 0;
        for line in BufReader::new(GzDecoder::new(file)).lines() {
            let at = |reason: String| format!("{}, line {}: {reason}", path.display(), episodes + 1);
            let line = line.map_err(|error| at(error.to_string()))?;
            let (id, steps) = replay_line(registry, episodes, &line).map_err(at)?;
            let sum: &mut (usize, usize) = matched.entry(id).or_default();
            *sum = (sum.0 + 1, sum.1 + steps);
            episodes += 1;
        }
        if episodes == 0 {
            return Err(format!("{}: no episode there", path.display()));
        }
    }
    Ok(matched)
}

fn own_recordings() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/traces")
}

#[test]
fn recorded_episodes_are_replayed() {
    let folder = std::env::var_os("POPGYM_TRACES")
        .map_or_else(own_recordings, |folder| Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(folder));
    let matched = replay_folder(&Registry::standard(), &folder).unwrap_or_else(|reason| panic!("{reason}"));
    let total = matched.values().fold((0, 0), |sum, part| (sum.0 + part.0, sum.1 + part.1));
    let row = |id: &str, episodes: &str, steps: &str| format!("{id:<46}{episodes:>10}{steps:>10}\n");
    let head = format!("\nreplayed from {}\n", folder.display());
    let table: String = [head, row("id", "episodes", "steps")]
        .into_iter()
        .chain(
            matched
                .iter()
                .chain([(&"all of them match".to_owned(), &total)])
                .map(|(id, (episodes, steps))| row(id, &episodes.to_string(), &steps.to_string())),
        )
        .collect();
    // Not `eprint!`, which the test harness keeps to itself.
    std::io::stderr().write_all(table.as_bytes()).unwrap();
}

/// The recordings that come with the crate leave no environment out.
#[test]
fn every_environment_has_a_recording() {
    let matched = replay_folder(&Registry::standard(), &own_recordings()).unwrap();
    for entry in &Registry::standard() {
        assert!(matched.contains_key(entry.id()), "{}", entry.id());
    }
}

/// The first recorded episode of an environment.
fn first_episode(id: &str) -> Json {
    let file = std::fs::File::open(own_recordings().join(format!("{id}.jsonl.gz"))).unwrap();
    serde_json::from_str(&BufReader::new(GzDecoder::new(file)).lines().next().unwrap().unwrap()).unwrap()
}

/// Whatever is changed in a recording is found, and said where it is.
#[test]
fn differences_are_found() {
    let registry = Registry::standard();
    let battleship = first_episode("popgym-BattleshipEasy-v0");
    let noisy = first_episode("popgym-NoisyPositionOnlyCartPoleEasy-v0");
    let check = |base: &Json, expected: &str, change: &dyn Fn(&mut Json)| {
        let mut changed = base.clone();
        change(&mut changed);
        let reason = replay_line(&registry, 7, &changed.to_string()).expect_err(expected);
        assert!(reason.contains(expected), "{reason}");
    };
    let pop = |json: &mut Json| drop(json.as_array_mut().unwrap().pop());
    replay_line(&registry, 7, &noisy.to_string()).unwrap();
    let (length, ended) = (noisy["actions"].as_array().unwrap().len(), noisy["terminated"] == true);

    check(&noisy, "popgym-NoisyPositionOnlyCartPoleEasy-v0, episode 7, step 3, observation: expected", &|json| {
        json["obs"][3][1] = (json["obs"][3][1].as_f64().unwrap() + 2e-5).into();
    });
    check(&noisy, "step 4, state: expected", &|json| {
        json["states"][4][1] = (json["states"][4][1].as_f64().unwrap() - 2e-5).into();
    });
    check(&noisy, "step 5, reward: expected 0.00500001, found 0.005", &|json| {
        json["rewards"][4] = 0.005_000_01.into();
    });
    check(&noisy, "flags (terminated, truncated): expected", &|json| json["terminated"] = (!ended).into());
    check(&noisy, "the world holds fewer draws", &|json| {
        let noise = json["world"]["observation_noise"].as_array_mut().unwrap();
        noise.pop();
        // Without noise the last observation is the state itself.
        let state = json["states"][length].clone();
        json["obs"][length] = Json::Array(vec![state[0].clone(), state[2].clone()]);
    });
    check(&noisy, "the world holds 2 too many", &|json| {
        json["world"]["observation_noise"].as_array_mut().unwrap().push(serde_json::json!([0.1, 0.1]));
    });
    check(&noisy, "world: unknown field `wind`", &|json| json["world"]["wind"] = 1.into());
    check(&noisy, "missing field `rewards`", &|json| drop(json.as_object_mut().unwrap().remove("rewards")));
    check(&noisy, "unknown environment `popgym-Unheard-v0`", &|json| json["env"] = "popgym-Unheard-v0".into());
    check(&noisy, "step 2, observation: \"here\" where a number should be", &|json| json["obs"][2][0] = "here".into());

    check(&battleship, "step 2, observation: expected", &|json| {
        json["obs"][2] = (1 - json["obs"][2].as_i64().unwrap()).into();
    });
    check(&battleship, "step 2, observation: 2 where a class of 0..2 should be", &|json| json["obs"][2] = 2.into());
    check(&battleship, "step 1, action: 3 numbers where 2 should be", &|json| {
        json["actions"][0].as_array_mut().unwrap().push(0.into());
    });
    check(&battleship, "rewards with", &|json| pop(&mut json["rewards"]));
    check(&battleship, "flags", &|json| {
        // One step less than was played.
        for key in ["actions", "rewards", "obs", "states"] {
            pop(&mut json[key]);
        }
    });
    check(&battleship, "length: expected", &|json| {
        // One step more.
        for key in ["actions", "rewards", "obs", "states"] {
            let list = json[key].as_array_mut().unwrap();
            list.push(list.last().unwrap().clone());
        }
    });
}

#[test]
fn files_that_hold_no_episodes_are_failures() {
    let registry = Registry::standard();
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("replay-{}", std::process::id()));
    let write = |name: &str, text: &[u8]| {
        let mut gz = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        gz.write_all(text).unwrap();
        std::fs::write(folder.join(name), gz.finish().unwrap()).unwrap();
    };
    let failure = || replay_folder(&registry, &folder).unwrap_err();
    assert!(failure().contains("No such file"), "{}", failure());
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("notes.txt"), "no recording").unwrap();
    assert!(failure().contains("no *.jsonl.gz there"), "{}", failure());
    write("a.jsonl.gz", b"");
    assert!(failure().contains("a.jsonl.gz: no episode there"), "{}", failure());
    write("a.jsonl.gz", format!("{}\n{{\"env\": 3}}\n", first_episode("popgym-BattleshipEasy-v0")).as_bytes());
    assert!(failure().contains("a.jsonl.gz, line 2: invalid type"), "{}", failure());
    std::fs::write(folder.join("a.jsonl.gz"), "not compressed").unwrap();
    assert!(failure().contains("a.jsonl.gz, line 1: "), "{}", failure());
    std::fs::remove_dir_all(&folder).unwrap();
}
