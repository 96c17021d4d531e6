//! `learner watch`: a trained agent on a pseudo-terminal, and as an animated GIF.

use std::fs;

use popgym_tests::Scene;
use popgym_tests::terminal::keys;
use rustix::process::Signal;

/// Columns and rows of a usual large terminal.
const LARGE: (u16, u16) = (140, 45);

/// A scene with a run, trained for a moment.
fn trained(flags: &[&str]) -> Scene {
    let scene = Scene::new();
    scene.train("run", flags).expect(0);
    scene
}

/// The probabilities of the bars below `next action`.
fn probabilities(screen: &str) -> Option<Vec<f64>> {
    let mut lines = screen.lines().skip_while(|line| !line.contains("next action"));
    lines.next()?;
    let last = |line: &str| line.split_whitespace().next_back().filter(|word| word.contains('.'))?.parse().ok();
    Some(lines.map_while(last).collect())
}

#[test]
fn probabilities_value_and_keys() {
    let scene = trained(&["--env", "RepeatPreviousEasy", "--memory", "mlp", "--steps", "20000"]);
    let mut terminal = scene.on_terminal(LARGE, &["watch", "run", "--speed", "0.01", "--seed", "4"]);
    terminal.has("step", "0 of 51");
    for step in 0..3 {
        terminal.has("step", &format!("{step} of 51"));
        let found = terminal.until("probabilities", probabilities);
        assert_eq!(found.len(), 4, "{found:?}");
        assert!((found.iter().sum::<f64>() - 1.0).abs() < 0.003, "{found:?}");
        let entropy: f64 = -found.iter().filter(|&&p| p > 0.0).map(|p| p * p.ln()).sum::<f64>();
        let shown: f64 = terminal.value("entropy").parse().unwrap();
        assert!((shown - entropy).abs() < 0.02, "{shown}, of {found:?}");
        assert!(terminal.value("value").parse::<f64>().unwrap().abs() < 2.0);
        let next = terminal.value("next action");
        if step == 0 {
            // At this speed nothing happens by itself, paused or not.
            terminal.press(keys::RIGHT);
            terminal.press(" ");
            terminal.has("→", "one step");
            terminal.has("step", "0 of 51");
        }
        terminal.press(keys::RIGHT);
        terminal.has("step", &format!("{} of 51", step + 1));
        // What it was about to do it has done: the picture has the last action in brackets.
        let suits = [("spades", "♠"), ("diamonds", "♦"), ("clubs", "♣"), ("hearts", "♥")];
        let (_, symbol) = suits.iter().find(|(name, _)| *name == next).unwrap_or_else(|| panic!("{next}"));
        terminal.shows(&format!("[{symbol}]"));
    }
    terminal.press("+");
    terminal.shows("0.02 steps/s");
    terminal.press("-");
    terminal.shows("0.01 steps/s");
    terminal.press(&"+".repeat(20));
    terminal.shows("1000 steps/s");
    terminal.has("step", "3 of 51");
    terminal.press(" ");
    terminal.shows("The episode is over");
    terminal.has("step", "51 of 51");
    let score = terminal.value("score");
    assert_eq!((terminal.is_taken(), terminal.is_cooked()), ((true, true), (false, false)));
    terminal.press("q");
    let text = terminal.expect(0, "possible");
    assert!(text.contains(&format!("episode 1   return {score}, 51 steps")), "{text}");
    terminal.assert_restored();
    // Ctrl-C, in the middle.
    let mut terminal = scene.on_terminal(LARGE, &["watch", "run", "--observed", "--speed", "0.01"]);
    terminal.has("step", "0 of 51");
    terminal.press(keys::CTRL_C);
    terminal.expect(130, "return so far");
    terminal.assert_restored();
}

#[test]
fn a_board_and_a_bar() {
    let scene = trained(&["--env", "BattleshipEasy", "--steps", "512"]);
    let mut terminal = scene.on_terminal(LARGE, &["watch", "run", "--speed", "0.01"]);
    terminal.shows("the likeliest 8 of 64");
    let found = terminal.until("probabilities", probabilities);
    assert_eq!(found.len(), 8);
    assert!(found.is_sorted_by(|a, b| a >= b), "{found:?}");
    terminal.press("q");
    terminal.expect(0, "possible");
    let scene = trained(&["--env", "StatelessPendulumEasy", "--steps", "512"]);
    let mut terminal = scene.on_terminal(LARGE, &["watch", "run", "--speed", "0.01", "--greedy"]);
    let spread = terminal.value("mean +- std");
    let (mean, std) = spread.split_once(" +- ").unwrap();
    assert!(std.parse::<f64>().unwrap() > 0.0);
    // Greedy: the mean, clipped.
    let expected = mean.parse::<f64>().unwrap().clamp(-2.0, 2.0);
    assert!((terminal.value("next action").parse::<f64>().unwrap() - expected).abs() < 1e-3, "{spread}");
    terminal.press("q");
    terminal.expect(0, "possible");
}

#[test]
fn an_interrupted_animation_leaves_nothing() {
    let scene = trained(&["--env", "RepeatPreviousEasy", "--steps", "512"]);
    scene.write("a.gif", "what was there before");
    let mut learner = scene.learner(&["watch", "run", "--gif", "a.gif", "--episodes", "1000000"]);
    let partial = scene.path(".partial-a.gif");
    learner.until("the beginning", |_| partial.exists().then_some(()));
    learner.signal(Signal::INT);
    learner.expect(130);
    assert!(!partial.exists());
    assert_eq!(scene.read("a.gif"), "what was there before");
}

/// The returns that a summary tells.
fn returns(text: &str) -> Vec<f64> {
    let values = text.lines().filter_map(|line| line.split_once("   return ").map(|(_, rest)| rest));
    values.map(|rest| rest.split(',').next().unwrap().trim().parse().unwrap()).collect()
}

#[test]
fn the_episodes_are_those_of_eval() {
    let scene = trained(&["--env", "RepeatPreviousEasy", "--observability", "full", "--steps", "4096"]);
    let flags = ["run", "--episodes", "3", "--seed", "5", "--checkpoint", "last"];
    let report = scene.learner(&[&["eval", "--json"], &flags[..]].concat()).expect(0).stdout;
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    let text = scene.learner(&[&["watch", "--gif", "a.gif"], &flags[..]].concat()).expect(0).stdout;
    let returns = returns(&text);
    assert_eq!(returns.len(), 3, "{text}");
    let mean = returns.iter().sum::<f64>() / 3.0;
    assert!((mean - report["mean_return"].as_f64().unwrap()).abs() < 1e-4, "{text}{report}");
}

#[test]
fn an_animation_needs_no_terminal() {
    let scene = trained(&["--env", "RepeatPreviousEasy", "--steps", "512"]);
    scene.write("episode.gif", "what was there before");
    let flags = ["watch", "run", "--gif", "episode.gif", "--speed", "8", "--episodes", "2"];
    let outcome = scene.learner(&flags).expect(0);
    assert_eq!(outcome.stdout.lines().next_back(), Some("episode.gif"));
    let bytes = fs::read(scene.path("episode.gif")).unwrap();
    let mut decoder = gif::DecodeOptions::new().read_info(&bytes[..]).unwrap();
    let (width, height) = (decoder.width(), decoder.height());
    let (mut delays, mut sizes) = (Vec::new(), Vec::new());
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        delays.push(frame.delay);
        sizes.push((frame.width, frame.height));
        assert!(frame.left + frame.width <= width && frame.top + frame.height <= height);
    }
    assert_eq!(decoder.repeat(), gif::Repeat::Infinite);
    // Two episodes of 51 steps, each with its beginning; the ends stay for two seconds.
    let episode = [&[12; 51][..], &[200]].concat();
    assert_eq!(delays, [&episode[..], &episode].concat());
    assert_eq!(sizes[0], (width, height));
    assert!(sizes[1..].iter().all(|&size| size != (width, height)), "only what has changed");
    assert!(bytes.len() < 8000 * delays.len(), "{} bytes", bytes.len());
    // The same again, byte for byte, and nothing temporary is left.
    scene.learner(&flags).expect(0);
    assert_eq!(fs::read(scene.path("episode.gif")).unwrap(), bytes);
    let names = fs::read_dir(scene.path(".")).unwrap().map(|entry| entry.unwrap().file_name());
    assert!(names.into_iter().all(|name| !name.to_string_lossy().contains("partial")));
}
