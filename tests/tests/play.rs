//! `learner play` on a pseudo-terminal: keys in, the screen out.

use popgym_tests::terminal::keys;
use popgym_tests::{Scene, Terminal};
use rustix::process::Signal;

/// Columns and rows of a usual large terminal.
const LARGE: (u16, u16) = (140, 45);

fn play(scene: &Scene, env: &str, flags: &[&str]) -> Terminal {
    scene.on_terminal(LARGE, &[&["play", "--env", env], flags].concat())
}

#[test]
fn whoever_remembers_the_suits_scores_1() {
    let scene = Scene::new();
    let mut terminal = play(&scene, "RepeatPreviousEasy", &["--seed", "12"]);
    let names = ["spades", "diamonds", "clubs", "hearts"];
    let mut seen: Vec<String> = Vec::new();
    for step in 0..51_usize {
        terminal.has("step", &format!("{step} of 51"));
        if let Some(last) = step.checked_sub(1).map(|last| &seen[last.saturating_sub(3)]) {
            // What was pressed is what was done.
            terminal.has("last action", names[last.parse::<usize>().unwrap()]);
        }
        seen.push(terminal.value("observation"));
        // The first three answers do not count; in turn by its number and by its first letter.
        let answer = &seen[step.saturating_sub(3)];
        let letter = &names[answer.parse::<usize>().unwrap()][..1];
        terminal.press(if step % 2 == 0 { answer } else { letter });
    }
    terminal.shows("The episode is over");
    assert_eq!(terminal.value("score"), "1.0000");
    assert!(terminal.value("possible").starts_with("-1.0000 to 1.0000"));
    assert!(terminal.value("at random").starts_with("-0."));
    assert_eq!((terminal.is_taken(), terminal.is_cooked()), ((true, true), (false, false)));
    terminal.press(keys::ENTER);
    let text = terminal.expect(0, "--env popgym-RepeatPreviousEasy-v0 --seed 12");
    assert!(text.contains("score 1.0000, step 51 of 51"), "{text}");
    terminal.assert_restored();
}

#[test]
fn a_cursor_shoots_at_ships() {
    let scene = Scene::new();
    let mut terminal = play(&scene, "BattleshipEasy", &["--seed", "3", "--reveal"]);
    terminal.has("pointing at", "(0, 0)");
    terminal.press(keys::RIGHT);
    terminal.has("pointing at", "(0, 1)");
    terminal.press(&[keys::DOWN, keys::DOWN, keys::RIGHT, keys::UP, keys::LEFT].concat());
    terminal.has("pointing at", "(1, 1)");
    terminal.press(keys::ENTER);
    terminal.has("step", "1 of 64");
    terminal.has("last action", "(1, 1)");
    // Shots at every square, by number: what hits is seen, and is all that scores.
    let mut hits = u32::from(terminal.value("observation") == "1");
    let mut steps = 1;
    for square in (0..64).filter(|square| *square != 9) {
        terminal.press(&format!("{} {}{}", square / 8, square % 8, keys::ENTER));
        steps += 1;
        let over = terminal.until("the next step", |screen| {
            let counted = screen.contains(&format!("{steps} of 64"));
            counted.then(|| screen.contains("The episode is over"))
        });
        hits += u32::from(terminal.value("observation") == "1");
        if over {
            break;
        }
    }
    assert_eq!(hits, 12, "all ships");
    // 12 hits are worth 1, a miss costs 1/52.
    let expected = 1.0 - f64::from(steps - hits) / 52.0;
    let score: f64 = terminal.value("score").parse().unwrap();
    assert!((score - expected).abs() < 1e-4, "{score} is not {expected}");
    terminal.press("q");
    terminal.expect(0, "learner play");
    terminal.assert_restored();
}

#[test]
fn arrows_push_a_pendulum() {
    let scene = Scene::new();
    let mut terminal = play(&scene, "StatelessPendulumEasy", &["--seed", "5"]);
    for (step, (key, torque)) in
        [(keys::LEFT, "-2.0000"), (keys::RIGHT, "2.0000"), (keys::DOWN, "0.0000"), ("0", "-2.0000"), ("9", "2.0000")]
            .into_iter()
            .enumerate()
    {
        terminal.has("step", &format!("{step} of 200"));
        terminal.press(key);
        terminal.has("last action", torque);
    }
    terminal.press(keys::ESCAPE);
    let text = terminal.expect(0, "learner play");
    assert!(text.contains("score so far") && text.contains("step 5 of 200"), "{text}");
    terminal.assert_restored();
}

#[test]
fn the_screen_follows_the_terminal() {
    let scene = Scene::new();
    let mut terminal = play(&scene, "BattleshipEasy", &["--seed", "3"]);
    terminal.has("step", "0 of 64");
    terminal.resize(50, 5);
    terminal.shows("The terminal is 50 x 5");
    terminal.press(keys::ENTER);
    terminal.resize(LARGE.0, LARGE.1);
    terminal.has("step", "1 of 64");
    // Narrow, but high: the text goes below the picture.
    let beside = terminal.text().lines().position(|line| line.contains("seed 3")).unwrap();
    terminal.resize(60, 60);
    terminal.until("the text below", |screen| {
        screen.lines().position(|line| line.contains("seed 3")).filter(|&row| row > beside + 5)
    });
    terminal.press("q");
    terminal.expect(0, "learner play");
    terminal.assert_restored();
}

#[test]
fn however_it_ends_the_terminal_is_restored() {
    let scene = Scene::new();
    let start = |flags: &[&str]| {
        let mut terminal = play(&scene, "RepeatFirstEasy", flags);
        terminal.has("step", "0 of 51");
        assert_eq!((terminal.is_taken(), terminal.is_cooked()), ((true, true), (false, false)));
        terminal
    };
    let mut terminal = start(&["--seed", "1"]);
    terminal.press(keys::CTRL_C);
    terminal.expect(130, "score so far");
    terminal.assert_restored();
    for signal in [Signal::TERM, Signal::INT, Signal::HUP] {
        let mut terminal = start(&[]);
        terminal.signal(signal);
        terminal.expect(130, "score so far");
        terminal.assert_restored();
    }
    // A seed of the clock is told, so that the game can be played again.
    let mut terminal = start(&[]);
    let seed = terminal.until("the seed", |screen| {
        let rest = screen.split_once("seed ")?.1;
        Some(rest[..rest.find(',')?].to_owned())
    });
    let first = terminal.value("observation");
    terminal.press("q");
    terminal.expect(0, &format!("--seed {seed}"));
    assert_eq!(start(&["--seed", &seed]).value("observation"), first);
}
