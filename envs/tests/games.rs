//! The rules of each game, one small story each.

#![allow(clippy::float_cmp, reason = "rewards and recorded numbers are compared to the last bit")]

mod common;

use common::{discrete, play, play_drawn};
use popgym_envs::battleship::{self, Battleship};
use popgym_envs::cart_pole::{self, PositionOnlyCartPole};
use popgym_envs::pendulum::{self, PositionOnlyPendulum};
use popgym_envs::repeat_first::{self, RepeatFirst};
use popgym_envs::repeat_previous::{self, RepeatPrevious};
use popgym_envs::{Env, Purpose, Recorded, Slab, Step, stream};
use serde_json::json;

fn assert_near(found: f64, expected: f64) {
    assert!((found - expected).abs() < 1e-9, "{found} is not {expected}");
}

#[test]
fn repeat_previous_pays_for_the_card_k_ago() {
    let levels = repeat_previous::LEVELS.map(|level| (level.decks, level.k));
    for (decks, k) in levels.into_iter().chain([(1, 1), (1, 2), (1, 16), (1, 51)]) {
        let mut env = RepeatPrevious::new("game", repeat_previous::Params { decks, k });
        let n = 52 * decks;
        // `shift` 0 answers rightly, any other wrongly.
        for (shift, expected) in [(0, 1.0), (1, -1.0)] {
            let episode = play_drawn(&mut env, 0, 0, |t, seen, action| {
                let target = t.checked_sub(k - 1).map_or(0, |target| seen.row(target).discrete[0]);
                action.discrete[0] = (target + shift) % 4;
            });
            assert_eq!(episode.steps.len(), n - 1);
            assert_near(episode.total(), expected);
            assert!(episode.steps[..k - 1].iter().all(|step| step.reward == 0.0));
            assert!(episode.steps[k - 1..].iter().all(|step| step.reward == expected / (n - k) as f64));
            assert_eq!(*episode.steps.last().unwrap(), Step { terminated: true, ..episode.steps[n - 2] });
        }
    }
}

#[test]
fn repeat_first_pays_for_the_first_card() {
    for level in repeat_first::LEVELS {
        let mut env = RepeatFirst::new("game", level);
        for (shift, expected) in [(0, 1.0), (2, -1.0)] {
            let episode = play_drawn(&mut env, 0, 1, |_, seen, action| {
                action.discrete[0] = (seen.row(0).discrete[0] + shift) % 4;
            });
            assert_eq!(episode.steps.len(), 52 * level.decks - 1);
            assert_near(episode.total(), expected);
            assert!(episode.steps.last().unwrap().terminated);
        }
    }
}

/// Cards are shown from the end of the array, and all of them are shown.
#[test]
fn cards_come_from_the_end_of_the_deck() {
    let deck: Vec<u16> = (0..52).map(|i| (i * 5 + 3) % 52).collect();
    let suits: Vec<u8> = deck.iter().rev().map(|card| (card % 4) as u8).collect();
    let [first, previous] = [repeat_first::LEVELS[0].decks, repeat_previous::LEVELS[0].decks];
    assert_eq!((first, previous), (1, 1));
    let games: [Box<dyn Env>; 2] = [
        Box::new(RepeatFirst::new("game", repeat_first::LEVELS[0])),
        Box::new(RepeatPrevious::new("game", repeat_previous::LEVELS[0])),
    ];
    for mut env in games {
        env.set_world(&json!({ "deck": deck })).unwrap();
        let episode = play(env.as_mut(), &mut Recorded::default(), |_, _, _| {});
        assert_eq!(episode.observations.discrete, suits);
        assert_eq!(episode.states.row(51).real, [0.0; 4], "no card is left");
    }
}

/// Ship cells and water cells of the drawn world, as `[row, column]`.
fn scout(env: &mut Battleship) -> [Vec<[u8; 2]>; 2] {
    let spec = env.spec().clone();
    let (mut observation, mut state) = (Slab::new(&spec.observation, 1), Slab::new(&spec.state, 1));
    env.begin(&mut Recorded::default(), observation.row_mut(0));
    env.state(state.row_mut(0));
    let cells = spec.max_steps as usize;
    let n = cells.isqrt();
    let (ships, water) = (0..cells).partition(|&cell| state.discrete[cell] == 1);
    [ships, water].map(|cells: Vec<usize>| cells.iter().map(|cell| [(cell / n) as u8, (cell % n) as u8]).collect())
}

#[test]
fn battleship_by_shots() {
    for (index, level) in battleship::LEVELS.into_iter().enumerate() {
        let mut env = Battleship::new("game", level);
        env.draw_world(&mut stream(0, 0, index as u64, Purpose::TrainEnv));
        let [ships, water] = scout(&mut env);
        let (n2, miss) = (level.board.pow(2), -1.0 / (level.board.pow(2) - 12) as f64);
        assert_eq!((ships.len(), water.len()), (12, n2 - 12));
        let mut shoot = |shots: Vec<[u8; 2]>| {
            play(&mut env, &mut Recorded::default(), |t, _, action| action.set(0, discrete(&shots[t])))
        };

        let hits = shoot(ships.clone());
        assert_near(hits.total(), 1.0);
        assert_eq!(hits.steps.len(), 12);
        assert_eq!(hits.steps[11], Step { reward: 1.0 / 12.0, terminated: true, truncated: false });
        assert!(hits.observations.discrete[1..].iter().all(|&seen| seen == 1));

        let misses = shoot(vec![water[0]; n2]);
        assert_near(misses.total(), n2 as f64 * miss);
        assert_eq!(misses.steps.len(), n2);
        assert_eq!(misses.steps[n2 - 1], Step { reward: miss, terminated: false, truncated: true });

        let all = shoot([water.clone(), ships.clone()].concat());
        assert_near(all.total(), 0.0);
        assert_eq!(all.steps.len(), n2);
        assert_eq!(all.steps[n2 - 1], Step { reward: 1.0 / 12.0, terminated: true, truncated: true });

        // The second shot at a ship's cell is a miss, and seen as one.
        let twice = shoot([vec![ships[0]], ships.clone()].concat());
        assert_eq!(twice.observations.discrete[..4], [0, 1, 0, 1]);
        assert_near(twice.total(), 1.0 + miss);
        assert_eq!(twice.steps.len(), 13);
    }
}

/// The drawn boards are spread as by the package's own procedure, written out here word by word.
#[test]
fn battleship_boards_have_the_right_distribution() {
    const BOARDS: usize = 20_000;
    let n = 8_i64;
    let mut rng = stream(3, 0, 0, Purpose::TrainEnv);
    let mut pick = |m: u32| i64::from(popgym_envs::rng::below(&mut rng, m));
    let mut expected = [0.0_f64; 64];
    for _ in 0..BOARDS {
        let mut board = [false; 64];
        for size in [2, 3, 3, 4] {
            loop {
                let start = [pick(8), pick(8)];
                let (axis, sign) = (pick(2) as usize, 2 * pick(2) - 1);
                let cells: Vec<[i64; 2]> = (0..size)
                    .map(|i| {
                        let mut cell = start;
                        cell[axis] += sign * i;
                        cell
                    })
                    .collect();
                let free = |&[row, column]: &[i64; 2]| {
                    (0..n).contains(&row) && (0..n).contains(&column) && !board[(row * n + column) as usize]
                };
                if cells.iter().all(free) {
                    for [row, column] in cells {
                        board[(row * n + column) as usize] = true;
                    }
                    break;
                }
            }
        }
        board.iter().zip(&mut expected).for_each(|(&ship, sum)| *sum += f64::from(u8::from(ship)));
    }
    let mut env = Battleship::new("game", battleship::LEVELS[0]);
    let mut found = [0.0_f64; 64];
    let mut rng = stream(4, 0, 0, Purpose::TrainEnv);
    for _ in 0..BOARDS {
        env.draw_world(&mut rng);
        for [row, column] in &scout(&mut env)[0] {
            found[usize::from(*row) * 8 + usize::from(*column)] += 1.0;
        }
    }
    for (a, b) in found.iter().zip(expected) {
        let p = (a + b) / (2 * BOARDS) as f64;
        let error = (2.0 * p * (1.0 - p) / BOARDS as f64).sqrt();
        assert!((a - b).abs() / (BOARDS as f64) < 5.0 * error, "{found:?} is not {expected:?}");
    }
}

#[test]
fn cart_pole_pays_for_standing() {
    for level in cart_pole::LEVELS {
        let mut env = PositionOnlyCartPole::new("game", level);
        // Velocities are differences of the last two observations.
        let episode = play_drawn(&mut env, 0, 2, |t, seen, action| {
            let (now, before) = (seen.row(t).real, seen.row(t.saturating_sub(1)).real);
            let lean =
                0.3 * now[0] + 0.7 * (now[0] - before[0]) / 0.02 + 10.0 * now[1] + 2.0 * (now[1] - before[1]) / 0.02;
            action.discrete[0] = u8::from(lean > 0.0);
        });
        assert_eq!(episode.steps.len(), level.max_steps as usize);
        assert_near(episode.total(), 1.0);
        let last = episode.steps.last().unwrap();
        assert!(last.truncated && !last.terminated);
    }
}

/// Pushing one way makes the pole fall; the falling step is paid too, and can be the last step allowed.
#[test]
fn cart_pole_falls() {
    let push = |_: usize, _: &Slab, action: &mut Slab| action.discrete[0] = 1;
    let max_steps = 200;
    let long = play_drawn(&mut PositionOnlyCartPole::new("game", cart_pole::Params { max_steps }), 0, 3, push);
    let steps = long.steps.len() as u32;
    assert!((8..=12).contains(&steps), "{steps}");
    assert_eq!(*long.steps.last().unwrap(), Step { reward: 0.005, terminated: true, truncated: false });
    assert_near(long.total(), f64::from(steps) / f64::from(max_steps));
    let short = play_drawn(&mut PositionOnlyCartPole::new("game", cart_pole::Params { max_steps: steps }), 0, 3, push);
    assert_eq!(short.observations, long.observations);
    assert!(short.steps.last().unwrap().terminated && short.steps.last().unwrap().truncated);
}

#[test]
fn pendulum_pays_between_the_bounds() {
    for level in pendulum::LEVELS {
        let mut env = PositionOnlyPendulum::new("game", level);
        env.set_world(&json!({ "theta": 0.0, "theta_dot": 0.0 })).unwrap();
        let upright = play(&mut env, &mut Recorded::default(), |_, _, _| {});
        assert_eq!(upright.steps.len(), level.max_steps as usize);
        assert_near(upright.total(), 1.0);
        let last = upright.steps.last().unwrap();
        assert!(last.truncated && !last.terminated);

        // Hanging, at full speed, with full torque; a larger torque is clipped.
        env.set_world(&json!({ "theta": std::f64::consts::PI, "theta_dot": 8.0 })).unwrap();
        let [full, beyond] =
            [2.0, 7.0].map(|torque| play(&mut env, &mut Recorded::default(), |_, _, action| action.real[0] = torque));
        assert!((full.steps[0].reward + 1.0 / f64::from(level.max_steps)).abs() < 1e-9);
        assert_eq!(full.steps, beyond.steps);
        assert_eq!(full.observations, beyond.observations);
    }
}

#[test]
fn bad_worlds_are_errors() {
    let deck: Vec<u16> = (0..52).collect();
    let mut twice = deck.clone();
    twice[7] = 8;
    let mut beyond = deck.clone();
    beyond[7] = 52;
    let mut ships = vec![vec![0; 8]; 8];
    ships[0] = vec![1; 8];
    let eight = ships.clone();
    ships[1][..4].fill(1);
    let mut cell = ships.clone();
    cell[7][7] = 2;
    let cases = [
        ("RepeatFirstEasy", json!({ "deck": deck[1..] }), "51 cards"),
        ("RepeatFirstEasy", json!({ "deck": twice }), "card 8 is twice"),
        ("RepeatPreviousEasy", json!({ "deck": beyond }), "card 52"),
        ("RepeatPreviousMedium", json!({ "deck": deck }), "expected 104"),
        ("RepeatPreviousEasy", json!({ "deck": deck, "k": 4 }), "unknown field `k`"),
        ("RepeatPreviousEasy", json!({}), "missing field `deck`"),
        ("BattleshipEasy", json!({ "ships": eight }), "8 cells, expected 12"),
        ("BattleshipEasy", json!({ "ships": cell }), "is 2"),
        ("BattleshipEasy", json!({ "ships": ships[1..] }), "8 rows"),
        ("BattleshipMedium", json!({ "ships": ships }), "10 rows"),
        ("StatelessCartPoleEasy", json!({ "state": [0.0, 0.0, 0.0] }), "length 3"),
        ("StatelessCartPoleEasy", json!({ "state": [0.0, null, 0.0, 0.0] }), "null"),
        ("StatelessCartPoleEasy", json!({ "state": [2.5, 0.0, 0.0, 0.0] }), "a fall already"),
        ("StatelessPendulumEasy", json!({ "theta": 0.0, "theta_dot": 9.0 }), "theta_dot is 9"),
        ("StatelessPendulumEasy", json!({ "theta": 0.0 }), "theta_dot"),
    ];
    let registry = popgym_envs::Registry::standard();
    for (name, world, reason) in cases {
        let mut env = registry.make(name).unwrap();
        let error = env.set_world(&world).expect_err(name);
        assert!(error.contains(reason), "{name}: {error}");
    }
    registry.make("BattleshipEasy").unwrap().set_world(&json!({ "ships": ships })).unwrap();
    registry.make("RepeatFirstEasy").unwrap().set_world(&json!({ "deck": deck })).unwrap();
}
