//! What a run leaves in its directory.

use std::collections::BTreeSet;
use std::fs;

use popgym_tests::Scene;

const COLUMNS: &str = "epoch,env_steps,episodes,mean_return,epoch_return,min_return,max_return,mean_length,mmer,policy_loss,\
    value_loss,kl,kl_coef,entropy,explained_variance,grad_norm,learning_rate,valid_fraction";

/// A table with its header, as numbers; none for what is no number.
struct Table {
    header: Vec<String>,
    rows: Vec<Vec<Option<f64>>>,
}

impl Table {
    fn parse(text: &str) -> Self {
        assert!(text.ends_with('\n'), "a torn last line");
        let mut lines = text.lines().map(|line| line.split(','));
        let header: Vec<String> = lines.next().unwrap().map(str::to_owned).collect();
        let rows: Vec<Vec<Option<f64>>> =
            lines.map(|line| line.map(|field| field.parse().ok().filter(|x: &f64| x.is_finite())).collect()).collect();
        assert!(rows.iter().all(|row| row.len() == header.len()), "{text}");
        Self { header, rows }
    }

    fn column(&self, name: &str) -> Vec<f64> {
        let index = self.header.iter().position(|column| column == name).unwrap_or_else(|| panic!("no column {name}"));
        self.rows.iter().map(|row| row[index].unwrap_or_else(|| panic!("{name}: not a finite number"))).collect()
    }
}

#[test]
fn the_tables() {
    let scene = Scene::new();
    let text = scene.curve("run", &[]);
    assert_eq!(text.lines().next(), Some(COLUMNS));
    let metrics = Table::parse(&text);
    assert_eq!(metrics.column("epoch"), (0..8).map(f64::from).collect::<Vec<_>>());
    for name in COLUMNS.split(',') {
        assert_eq!(metrics.column(name).len(), 8, "{name}");
    }
    // A batch is the shortest prefix that has 512 steps; an episode of RepeatPreviousEasy has 51.
    assert_eq!(metrics.column("env_steps"), (1..9).map(|epoch| f64::from(epoch * 561)).collect::<Vec<_>>());
    assert_eq!(metrics.column("episodes"), (1..9).map(|epoch| f64::from(epoch * 11)).collect::<Vec<_>>());
    assert_eq!(metrics.column("mean_length"), [51.0; 8]);
    let mut best = f64::NEG_INFINITY;
    for (mean, mmer) in metrics.column("mean_return").into_iter().zip(metrics.column("mmer")) {
        best = best.max(mean);
        assert!(mmer.to_bits() == best.to_bits(), "mmer is the largest mean so far: {mmer}, {best}");
    }
    for row in 0..8 {
        let [low, own, high] = ["min_return", "epoch_return", "max_return"].map(|name| metrics.column(name)[row]);
        assert!(-1.0 <= low && low <= own && own <= high && high <= 1.0);
        // Eight epochs of 11 episodes are within the mean's window of 100.
        let own = &metrics.column("epoch_return")[..=row];
        let mean = own.iter().sum::<f64>() / own.len() as f64;
        assert!((metrics.column("mean_return")[row] - mean).abs() < 1e-12);
    }
    let timing = Table::parse(&scene.read("run/timing.csv"));
    assert_eq!(timing.column("epoch"), metrics.column("epoch"));
    assert_eq!(timing.column("env_steps"), metrics.column("env_steps"));
    for name in ["wall_seconds", "steps_per_second", "collect_seconds", "learn_seconds", "wait_seconds"] {
        assert!(timing.column(name).iter().all(|&x| x >= 0.0), "{name}");
    }
    assert!(timing.column("wall_seconds").is_sorted());
    assert!(
        timing.column("log_prob_difference").iter().all(|&difference| difference < 1e-4),
        "same build, same numbers"
    );
}

#[test]
fn the_configuration_makes_the_same_run_again() {
    let scene = Scene::new();
    let first = scene.curve("run", &["--seed", "5", "--gamma", "0.9", "--lag", "1", "--actors", "2"]);
    scene.learner(&["train", "--config", "run/config.toml", "--out", "again"]).expect(0);
    assert_eq!(scene.metrics("again"), first);
    assert_eq!(scene.read("again/config.toml"), scene.read("run/config.toml"));
    let config: toml::Table = scene.read("run/config.toml").parse().unwrap();
    assert_eq!(config["env"].as_str(), Some("popgym-RepeatPreviousEasy-v0"), "resolved to the canonical id");
    assert_eq!(config["memory"]["hidden_size"].as_integer(), Some(16));
    assert_eq!(config["ppo"]["gamma"].as_float(), Some(0.9));
    assert_eq!(config["seed"].as_integer(), Some(5));
    assert_eq!(config["device"].as_str(), Some("cpu"), "auto is resolved");
    // Flags win over the file.
    let flags = ["train", "--config", "run/config.toml", "--out", "other", "--seed", "6"];
    scene.learner(&flags).expect(0);
    assert_ne!(scene.metrics("other"), first);
}

#[test]
fn the_summary() {
    let scene = Scene::new();
    let metrics = Table::parse(&scene.curve("run", &["--seed", "3", "--lag", "1"]));
    let summary = scene.json("run/summary.json");
    let keys: BTreeSet<&str> = summary.as_object().unwrap().keys().map(String::as_str).collect();
    let expected =
        "env memory preset seed lag epochs env_steps episodes mmer final_mean_return wall_seconds stopped_by";
    assert_eq!(keys, expected.split(' ').collect());
    assert_eq!(summary["env"], "popgym-RepeatPreviousEasy-v0");
    for (key, value) in [("memory", "gru"), ("preset", "quick"), ("stopped_by", "steps")] {
        assert_eq!(summary[key], value);
    }
    for (key, value) in [("seed", 3), ("lag", 1), ("epochs", 8), ("env_steps", 8 * 561), ("episodes", 88)] {
        assert_eq!(summary[key], value, "{key}");
    }
    let means = metrics.column("mean_return");
    assert_eq!(summary["mmer"].as_f64(), means.iter().copied().reduce(f64::max), "the maximum over epochs");
    assert_eq!(summary["final_mean_return"].as_f64(), means.last().copied());
    assert!(summary["wall_seconds"].as_f64().unwrap() > 0.0);
}

#[test]
fn a_run_stops_at_the_mmer_asked_for() {
    let scene = Scene::new();
    scene.curve("run", &["--stop-at-mmer", "-1"]);
    assert_eq!(scene.rows("run"), 1);
    assert_eq!(scene.json("run/summary.json")["stopped_by"], "mmer");
    // Reached, so there is nothing to resume, whatever the steps.
    let outcome = scene.resume("run", &["--steps", "8192"]).expect(0);
    assert!(outcome.stdout.contains("already complete"), "{}", outcome.stdout);
    assert_eq!(scene.rows("run"), 1);
}

#[test]
fn checkpoints_the_last_few_and_the_best() {
    let scene = Scene::new();
    let flags = ["--checkpoint-epochs", "1", "--keep-checkpoints", "2", "--learning-rate", "0.02"];
    let metrics = Table::parse(&scene.curve("run", &flags));
    let means = metrics.column("mean_return");
    // Of equals the newest; names count completed epochs.
    let best = 1 + (0..8).rev().max_by(|&a, &b| means[a].total_cmp(&means[b]).then(a.cmp(&b))).unwrap();
    let expected: BTreeSet<String> = [best, 7, 8].iter().map(|epoch| format!("epoch-{epoch:06}")).collect();
    assert_eq!(scene.checkpoints("run"), expected.into_iter().collect::<Vec<_>>(), "{means:?}");
    for name in scene.checkpoints("run") {
        let dir = scene.path("run/checkpoints").join(&name);
        let manifest = scene.json(&format!("run/checkpoints/{name}/manifest.json"));
        let files = manifest["files"].as_object().unwrap();
        assert!(files.contains_key("weights.safetensors") && files.contains_key("optimizer.safetensors"), "{manifest}");
        let there: BTreeSet<String> =
            fs::read_dir(&dir).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        let named: BTreeSet<String> = files.keys().cloned().chain(["manifest.json".to_owned()]).collect();
        assert_eq!(there, named, "nothing else, nothing temporary");
        assert_eq!(format!("epoch-{:06}", manifest["progress"]["epoch"].as_u64().unwrap()), name);
        // Safetensors: the length of a JSON header, the header, the numbers.
        let bytes = fs::read(dir.join("weights.safetensors")).unwrap();
        let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        let header: serde_json::Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
        assert!(header.as_object().unwrap().len() > 4, "{header}");
    }
}

#[test]
fn pictures_events_and_nothing_else() {
    let scene = Scene::new();
    scene.curve("run", &["--actors", "2"]);
    let svg = scene.read("run/curve.svg");
    assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"), "{svg}");
    let png = fs::read(scene.path("run/curve.png")).unwrap();
    assert!(png.starts_with(b"\x89PNG\r\n\x1a\n") && png[png.len() - 8..].starts_with(b"IEND"));
    let events: Vec<_> = fs::read_dir(scene.path("run/tensorboard")).unwrap().map(Result::unwrap).collect();
    assert_eq!(events.len(), 1);
    assert!(events[0].file_name().into_string().unwrap().starts_with("events.out.tfevents."));
    let bytes = fs::read(events[0].path()).unwrap();
    // A record: its length, a checksum, and then the first event, which names the format.
    assert!(bytes.windows(13).any(|window| window == b"brain.Event:2"));
    assert!(bytes.windows(4).any(|window| window == b"mmer"));
    let names: BTreeSet<String> = fs::read_dir(scene.path("run"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    let expected = "checkpoints config.toml curve.png curve.svg events.jsonl lock metrics.csv run.json summary.json tensorboard timing.csv";
    assert_eq!(names, expected.split(' ').map(str::to_owned).collect());
}

#[test]
fn without_a_directory_a_fresh_one_below_runs() {
    let scene = Scene::new();
    let train = || scene.learner(&["train", "--config", "tiny.toml", "--steps", "512", "--seed", "9"]).expect(0);
    let (first, second) = (train(), train());
    let names: BTreeSet<String> = fs::read_dir(scene.path("runs"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    assert_eq!(names.len(), 2, "{names:?}");
    for (outcome, name) in [first, second].iter().zip(&names) {
        assert!(name.starts_with("RepeatPreviousEasy-gru-quick-seed9-"), "{name}");
        // The closing summary names the curve, the table and the checkpoint.
        for file in ["curve.svg", "metrics.csv", "checkpoints/epoch-000001"] {
            let path = format!("runs/{name}/{file}");
            assert!(outcome.stdout.contains(&path), "{}", outcome.stdout);
        }
    }
    assert_eq!(scene.metrics(&format!("runs/{}", names.first().unwrap())).lines().count(), 2);
}
