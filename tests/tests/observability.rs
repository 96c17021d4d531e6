//! The same agent on the task as it is, and on the hidden state.

use popgym_tests::Scene;

/// The suit of three steps ago is no part of the observation, so an agent without memory cannot do better than one guess in
/// four (a return of -0.5), however long it learns. It is part of the hidden state.
#[test]
fn without_memory_the_hidden_state_is_what_it_takes() {
    let scene = Scene::new();
    let train = |level: &str| {
        let flags = [
            "train",
            "--memory",
            "mlp",
            "--steps",
            "100000",
            "--stop-at-mmer",
            "0.5",
            "--observability",
            level,
            "--out",
        ];
        scene.learner(&[&flags[..], &[level]].concat()).expect(0);
        assert!(scene.read(&format!("{level}/config.toml")).contains(&format!("observability = \"{level}\"")));
        scene.json(&format!("{level}/summary.json"))["mmer"].as_f64().unwrap()
    };
    for level in ["full", "full-and-partial"] {
        assert!(train(level) >= 0.5, "{level}");
    }
    assert!(train("partial") < -0.3);

    let report = scene.learner(&["eval", "full", "--episodes", "20", "--json"]).expect(0).stdout;
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    assert!(report["mean_return"].as_f64().unwrap() > 0.3, "{report}");
}

/// What stands in the info is nothing that the agent sees: the curves are the same.
#[test]
fn the_info_is_not_for_the_agent() {
    let scene = Scene::new();
    assert_eq!(scene.curve("info", &["--observability", "full-in-info"]), scene.curve("partial", &[]));
    assert_ne!(scene.curve("full", &["--observability", "full"]), scene.metrics("partial"));
    let refused = scene.train("full", &["--continue", "--observability", "partial"]).expect(2).stderr;
    assert!(refused.contains("observability"), "{refused}");
}
