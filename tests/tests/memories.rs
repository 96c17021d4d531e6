//! Every memory through the programs: listed, trained, evaluated, exported; and what becomes of a run that diverges.

use std::collections::BTreeMap;
use std::fs;

use popgym_tests::Scene;
use serde_json::Value;

fn listed(scene: &Scene) -> Vec<Value> {
    let json = scene.learner(&["list", "memories", "--json"]).expect(0).stdout;
    serde_json::from_str(&json).unwrap()
}

fn name(memory: &Value) -> &str {
    memory["name"].as_str().unwrap()
}

#[test]
fn every_memory_is_listed_with_its_sizes() {
    let scene = Scene::new();
    let memories = listed(&scene);
    let find = |wanted: &str| memories.iter().find(|memory| name(memory) == wanted).unwrap();
    // The reference's table 4.2.
    for (name, in_popgym, state, parameters) in [
        ("frame_stack", "Fr.Stack", 384, 139_840),
        ("gru", "GRU", 256, 296_448),
        ("dnc", "DNC", 1_200, 577_671),
        ("s4d", "S4D", 4_096, 177_408),
    ] {
        let memory = find(name);
        assert_eq!(memory["paper_name"], in_popgym);
        assert_eq!((&memory["state"], &memory["parameters"]), (&state.into(), &parameters.into()), "{memory}");
    }
    assert_eq!(memories.len(), 13);
    let table = scene.learner(&["list", "memories"]).expect(0).stdout;
    for memory in &memories {
        let line = table.lines().find(|line| line.split_whitespace().next() == Some(name(memory))).unwrap();
        for key in ["paper_name", "state", "parameters", "paper"] {
            let text = memory[key].as_str().map_or_else(|| memory[key].to_string(), str::to_owned);
            assert!(line.contains(&text), "{line}: no {text}");
        }
    }
}

#[test]
fn every_memory_trains_plays_and_is_exported() {
    let scene = Scene::new();
    for memory in listed(&scene) {
        let memory = name(&memory);
        let curve = scene.curve(memory, &["--memory", memory, "--steps", "1024", "--actors", "2"]);
        assert_eq!(curve.lines().count(), 3, "{memory}: {curve}");
        assert!(!curve.contains("NaN") && !curve.contains("inf"), "{memory}: {curve}");
        assert!(scene.log_prob_difference(memory) < 1e-4, "{memory}: actors and learner compute the same");
        scene.learner(&["eval", memory, "--episodes", "2"]).expect(0);
        let file = format!("{memory}.pt");
        scene.learner(&["export", memory, "--torchscript", &file]).expect(0);
        assert!(fs::metadata(scene.path(&file)).unwrap().len() > 10_000);
        let about = scene.json(&format!("{memory}.pt.json"));
        assert_eq!(about["memory"], memory);
        assert_eq!((&about["observation"], &about["action"]), (&"Discrete(4)".into(), &"Discrete(4)".into()));
        assert_eq!(about["weights"]["projection.weight"], serde_json::json!([128, 10]));
        assert!(about["state"].is_array());
        // The same is said of each checkpoint.
        let checkpoint = scene.checkpoints(memory).pop().unwrap();
        let manifest = scene.json(&format!("{memory}/checkpoints/{checkpoint}/manifest.json"));
        assert_eq!(manifest["about"]["weights"], about["weights"], "{memory}");
    }
}

/// A hundred times the learning rate: each memory keeps finite weights, or the run says what went bad and keeps what it had.
#[test]
fn nothing_explodes() {
    let scene = Scene::new();
    for memory in listed(&scene) {
        let memory = name(&memory);
        let flags = ["--memory", memory, "--learning-rate", "0.07", "--steps", "1536", "--checkpoint-epochs", "1"];
        let outcome = scene.train(memory, &flags).wait();
        match outcome.status.code() {
            Some(0) => {}
            Some(1) => assert!(outcome.stderr.contains("the update diverged: "), "{memory}: {}", outcome.stderr),
            _ => panic!("{memory}: {}", outcome.stderr),
        }
        if !scene.checkpoints(memory).is_empty() {
            scene.learner(&["eval", memory, "--episodes", "2", "--checkpoint", "last"]).expect(0);
        }
    }
}

/// Names and bytes of all files of a run's checkpoints.
fn checkpoint_files(scene: &Scene, run: &str) -> BTreeMap<String, Vec<u8>> {
    let files = |checkpoint: String| {
        let dir = scene.path(run).join("checkpoints").join(&checkpoint);
        let read = move |entry: fs::DirEntry| {
            let name = format!("{checkpoint}/{}", entry.file_name().display());
            (name, fs::read(entry.path()).unwrap())
        };
        fs::read_dir(dir).unwrap().flatten().map(read)
    };
    scene.checkpoints(run).into_iter().flat_map(files).collect()
}

#[test]
fn a_divergence_names_the_tensor_and_leaves_the_checkpoint() {
    let scene = Scene::new();
    scene.curve("run", &["--steps", "1024"]);
    let before = checkpoint_files(&scene, "run");
    assert!(!before.is_empty());
    let config = scene.read("run/config.toml");
    let line = config.lines().find(|line| line.starts_with("learning_rate =")).unwrap();
    scene.write("run/config.toml", &config.replace(line, "learning_rate = 1e30"));
    let stderr = scene.resume("run", &["--steps", "4096"]).expect(1).stderr;
    let told = stderr.split_once("error: the update diverged: ").unwrap_or_else(|| panic!("{stderr}")).1;
    let (tensor, place) = told.split_once("` is not finite in minibatch ").unwrap_or_else(|| panic!("{told}"));
    let (_, tensor) = tensor.split_once('`').unwrap_or_else(|| panic!("{told}"));
    assert!(place.contains(" of pass 1; nothing of this update is kept"), "{told}");
    let manifest = format!("run/checkpoints/{}/manifest.json", scene.checkpoints("run").pop().unwrap());
    assert!(!scene.json(&manifest)["about"]["weights"][tensor].is_null(), "{tensor}");
    assert!(checkpoint_files(&scene, "run") == before, "the last good checkpoint is as it was");
    scene.learner(&["eval", "run", "--episodes", "2"]).expect(0);
}

#[test]
fn a_memorys_options_are_checked() {
    let scene = Scene::new();
    for (memory, option, told) in [
        ("lmu", "theta = 0", "`theta` is 0, allowed is 1..=65536"),
        ("dnc", "read_heads = 0", "`read_heads` is 0, allowed is 1..=64"),
        ("tcn", "kernel = 4", "unknown key `memory.kernel`; did you mean"),
        ("s4d", "state_size = 3", "`state_size` is 3, allowed is an even number of 2..=1024"),
    ] {
        scene.write("memory.toml", &format!("[memory]\nname = \"{memory}\"\n{option}\n"));
        let stderr = scene.learner(&["train", "--config", "memory.toml", "--out", "run"]).expect(2).stderr;
        assert!(stderr.contains(told), "{memory}: {stderr}");
        assert!(!scene.path("run").exists());
    }
}

#[test]
fn export_says_what_is_wrong() {
    let scene = Scene::new();
    let stderr = scene.learner(&["export", "nowhere", "--torchscript", "x.pt"]).expect(2).stderr;
    assert_eq!(stderr, "error: nowhere holds no run (no config.toml)\n");
    scene.curve("run", &["--steps", "512"]);
    let stderr = scene.learner(&["export", "run", "--torchscript", "none/x.pt"]).expect(2).stderr;
    assert!(stderr.contains("cannot write none/x.pt"), "{stderr}");
    fs::remove_dir_all(scene.path("run/checkpoints")).unwrap();
    let stderr = scene.learner(&["export", "run", "--torchscript", "x.pt"]).expect(2).stderr;
    assert_eq!(stderr, "error: run holds no checkpoint yet\n");
    assert!(!scene.path("x.pt").exists());
}
