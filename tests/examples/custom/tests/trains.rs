//! The example is what the README says: a trainer, with actors of its own.

use std::process::Command;

use popgym_tests::{Process, Scene};

fn custom(scene: &Scene, args: &[&str]) -> Process {
    let mut command = Command::new(env!("CARGO_BIN_EXE_custom"));
    command.args(args).current_dir(scene.path("."));
    Process::start("custom", command)
}

/// Always walking on and then guessing returns 0 on average. With a memory the sign is found out, unless the policy has settled on
/// never turning at all before: hence the entropy bonus.
fn learns(memory: &str) {
    let scene = Scene::new();
    let flags = "train --config tiny.toml --env TMaze --out run --steps 400000 --passes 4 --batch-steps 2048 \
                 --entropy-coef 0.05 --stop-at-mmer 0.9 --memory";
    let flags: Vec<&str> = flags.split_whitespace().chain([memory]).collect();
    custom(&scene, &flags).expect(0);
    let summary = scene.json("run/summary.json");
    assert_eq!((summary["env"].as_str(), summary["memory"].as_str()), (Some("TMaze"), Some(memory)));
    assert!(summary["mmer"].as_f64().unwrap() >= 0.9, "{summary}");
}

#[test]
fn an_environment_of_ones_own_is_learned() {
    learns("gru");
}

#[test]
fn a_memory_of_ones_own_learns() {
    learns("decay");
}

#[test]
fn its_names_stand_beside_the_others() {
    let scene = Scene::new();
    let listed = custom(&scene, &["list", "envs"]).expect(0).stdout;
    assert!(listed.contains("TMaze50") && listed.contains("RepeatPreviousEasy"), "{listed}");
    let listed = custom(&scene, &["list", "memories"]).expect(0).stdout;
    assert!(listed.contains("decay") && listed.contains("gru"), "{listed}");
    let unknown = custom(&scene, &["train", "--env", "TMaz"]).expect(2).stderr;
    assert!(unknown.contains("did you mean `TMaze`"), "{unknown}");
}
