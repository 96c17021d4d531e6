//! The rules of the games on boards, and their pictures.

#![allow(clippy::float_cmp, reason = "rewards are compared to the last bit")]

mod common;

use common::{Episode, assert_observed_is_all_that_is_shown, discrete, picture, play};
use popgym_envs::battleship::{self, Battleship};
use popgym_envs::mine_sweeper::{self, MineSweeper};
use popgym_envs::{Canvas, Env, Purpose, Recorded, Registry, Slab, Step, View, stream};
use serde_json::{Value as Json, json};

fn assert_near(found: f64, expected: f64) {
    assert!((found - expected).abs() < 1e-9, "{found} is not {expected}");
}

/// The cells `[row, column]` of the present world that are 0 and 1 in the grid called `key`.
fn scout(env: &dyn Env, key: &str) -> [Vec<[u8; 2]>; 2] {
    let world = env.world();
    let mut cells = [vec![], vec![]];
    for (row, line) in world[key].as_array().unwrap().iter().enumerate() {
        for (column, cell) in line.as_array().unwrap().iter().enumerate() {
            cells[cell.as_u64().unwrap() as usize].push([row as u8, column as u8]);
        }
    }
    cells
}

/// Plays the present world with these cells as actions, which must be as many as the episode takes.
fn point_at(env: &mut dyn Env, cells: &[[u8; 2]]) -> Episode {
    let episode =
        play(env, &mut Recorded::default(), |t, _, action| action.set(0, discrete(cells.get(t).expect("has ended"))));
    assert_eq!(episode.steps.len(), cells.len());
    episode
}

fn set(env: &mut dyn Env, key: &str, grid: &[Vec<u8>]) {
    env.set_world(&json!({ key: grid })).unwrap();
}

/// `0` and `1` row by row, between spaces.
fn grid(text: &str) -> Vec<Vec<u8>> {
    text.split_whitespace().map(|row| row.bytes().map(|digit| digit - b'0').collect()).collect()
}

#[test]
fn battleship_by_shots() {
    for (index, level) in battleship::LEVELS.into_iter().enumerate() {
        let mut env = Battleship::new("game", level);
        env.draw_world(&mut stream(0, 0, index as u64, Purpose::TrainEnv));
        let [water, ships] = scout(&env, "ships");
        let (n2, miss) = (level.board.pow(2), -1.0 / (level.board.pow(2) - 12) as f64);
        assert_eq!((ships.len(), water.len()), (12, n2 - 12));

        let hits = point_at(&mut env, &ships);
        assert_near(hits.total(), 1.0);
        assert_eq!(hits.steps[11], Step { reward: 1.0 / 12.0, terminated: true, truncated: false });
        assert!(hits.observations.discrete[1..].iter().all(|&seen| seen == 1));

        let misses = point_at(&mut env, &vec![water[0]; n2]);
        assert_near(misses.total(), n2 as f64 * miss);
        assert_eq!(misses.steps[n2 - 1], Step { reward: miss, terminated: false, truncated: true });

        let all = point_at(&mut env, &[water.clone(), ships.clone()].concat());
        assert_near(all.total(), 0.0);
        assert_eq!(all.steps[n2 - 1], Step { reward: 1.0 / 12.0, terminated: true, truncated: true });

        // The second shot at a ship's cell is a miss, and seen as one.
        let twice = point_at(&mut env, &[vec![ships[0]], ships.clone()].concat());
        assert_eq!(twice.observations.discrete[..4], [0, 1, 0, 1]);
        assert_near(twice.total(), 1.0 + miss);

        // The state: all ships, then all shots, then what was seen.
        let state = twice.states.row(1).discrete;
        let at = usize::from(ships[0][0]) * level.board + usize::from(ships[0][1]);
        assert_eq!(state[..n2].iter().map(|&cell| usize::from(cell)).sum::<usize>(), 12);
        assert!((0..n2).all(|cell| state[n2 + cell] == u8::from(cell == at)));
        assert_eq!((state[at], state[2 * n2]), (1, 1));
    }
}

/// Three ships along the left border, in rows 1 to 2, 3 to 5 and 6 to 8, and the one of four cells in the last row.
const FLEET: &str = "10000000 10000000 10000000 10000000 10000000 10000000 10000000 10001111";

#[test]
fn battleship_in_pictures() {
    let mut env = Battleship::new("game", battleship::LEVELS[0]);
    set(&mut env, "ships", &grid(FLEET));
    let mut observation = Slab::new(&env.spec().observation.clone(), 1);
    env.begin(&mut Recorded::default(), observation.row_mut(0));
    let water = "  A B C D E F G H\n1 · · · · · · · ·\n2 · · · · · · · ·\n3 · · · · · · · ·\n4 · · · · · · · ·\n\
                 5 · · · · · · · ·\n6 · · · · · · · ·\n7 · · · · · · · ·\n8 · · · · · · · ·\n";
    assert_eq!(picture(&env, View::Observed), water);
    for (shot, observed) in
        [([1, 0], "2 × · · · · · · ·"), ([0, 7], "1 · · · · · · · ○"), ([1, 0], "2 ○ · · · · · · ·")]
    {
        env.step(discrete(&shot), &mut Recorded::default(), observation.row_mut(0));
        let row = usize::from(shot[0]) + 1;
        let mut lines: Vec<&str> = water.lines().collect();
        lines[row] = observed;
        assert_eq!(picture(&env, View::Observed).lines().collect::<Vec<_>>(), lines);
    }
    assert_eq!(
        picture(&env, View::Revealed),
        "  A B C D E F G H\n1 █ · · · · · · ○\n2 × · · · · · · ·\n3 █ · · · · · · ·\n4 █ · · · · · · ·\n\
         5 █ · · · · · · ·\n6 █ · · · · · · ·\n7 █ · · · · · · ·\n8 █ · · · █ █ █ █\n"
    );
}

#[test]
fn boards_are_drawn_so_that_cells_can_be_pointed_at() {
    for name in ["BattleshipHard", "MineSweeperHard"] {
        let env = Registry::standard().make(name).unwrap();
        let n = if name == "BattleshipHard" { 12 } else { 8 };
        for view in [View::Observed, View::Revealed] {
            let mut canvas = Canvas::new();
            env.render(view, &mut canvas);
            let margin = n.to_string().len() + 1;
            assert_eq!((canvas.height(), canvas.width()), (n + 1, margin + 2 * n - 1));
            for (row, glyphs) in canvas.rows().iter().enumerate() {
                for (column, glyph) in glyphs.iter().enumerate() {
                    let cell = row > 0 && column >= margin && (column - margin).is_multiple_of(2);
                    let action = cell.then(|| ((row - 1) * n + (column - margin) / 2) as u16);
                    assert_eq!(glyph.action, action, "{name}, row {row}, column {column}");
                }
            }
        }
    }
    let hard = Registry::standard().make("BattleshipHard").unwrap();
    let text = picture(hard.as_ref(), View::Observed);
    assert_eq!(text.lines().next(), Some("   A B C D E F G H I J K L"));
    assert_eq!(text.lines().nth(9), Some(" 9 · · · · · · · · · · · ·"));
    assert_eq!(text.lines().nth(12), Some("12 · · · · · · · · · · · ·"));
}

#[test]
fn boards_show_what_is_observed_and_no_more() {
    for (name, episodes) in [("BattleshipEasy", 10), ("MineSweeperEasy", 60), ("MineSweeperHard", 500)] {
        assert_observed_is_all_that_is_shown(Registry::standard().make(name).unwrap().as_mut(), episodes);
    }
}

#[test]
fn mine_sweeper_by_clicks() {
    for (index, level) in mine_sweeper::LEVELS.into_iter().enumerate() {
        let mut env = MineSweeper::new("game", level);
        env.draw_world(&mut stream(0, 0, index as u64, Purpose::TrainEnv));
        let [clear, mines] = scout(&env, "mines");
        let s = level.board.pow(2) - level.mines;
        assert_eq!((clear.len(), mines.len()), (s, level.mines));
        let (new, again, mine) = (1.0 / s as f64, -0.5 / (s - 2) as f64, -0.5 - 1.0 / s as f64);

        let all = point_at(&mut env, &clear);
        assert_near(all.total(), 1.0);
        assert_eq!(all.steps[s - 1], Step { reward: new, terminated: true, truncated: false });
        // Seen cells are 2 in the state, mines stay 1.
        let mut state: Vec<u8> = vec![2; level.board.pow(2)];
        for [row, column] in &mines {
            state[usize::from(*row) * level.board + usize::from(*column)] = 1;
        }
        assert_eq!(all.states.row(s).discrete, state);

        // As slowly as possible: the last allowed step is a mine, which is no truncation.
        let mut slow = vec![clear[0]; s - 1];
        slow.push(mines[0]);
        let worst = point_at(&mut env, &slow);
        assert_near(worst.total(), -1.0);
        assert_eq!(worst.steps[1].reward, again);
        assert_eq!(worst.steps[s - 1], Step { reward: mine, terminated: true, truncated: false });
        assert_eq!(worst.states.row(s), worst.states.row(1), "neither a mine nor a seen cell changes");

        slow[s - 1] = clear[0];
        let idle = point_at(&mut env, &slow);
        assert_near(idle.total(), new + (s - 1) as f64 * again);
        assert_eq!(idle.steps[s - 1], Step { reward: again, terminated: false, truncated: true });

        // One new cell too few.
        let late = point_at(&mut env, &[vec![clear[0]], clear[..s - 1].to_vec()].concat());
        assert_eq!(late.steps[s - 1], Step { reward: new, terminated: false, truncated: true });

        let unlucky = point_at(&mut env, &mines[..1]);
        assert_eq!(unlucky.steps[0], Step { reward: mine, terminated: true, truncated: false });
    }
}

/// Counted by hand; a mine counts itself.
#[test]
fn mine_sweeper_counts() {
    let small = ("1000 0100 0000 0000", "2210 2210 1110 0000", 4, 2);
    let large = (
        "00000000 00000000 00000000 00000000 00000111 00000111 00000111 10000000",
        "00000000 00000000 00000000 00001232 00002464 00003696 11002464 11001232",
        8,
        10,
    );
    for (mines, counts, board, count) in [small, large] {
        let mut env = MineSweeper::new("game", mine_sweeper::Params { board, mines: count });
        set(&mut env, "mines", &grid(mines));
        let mut observation = Slab::new(&env.spec().observation.clone(), 1);
        for (row, counts) in grid(counts).into_iter().enumerate() {
            for (column, count) in counts.into_iter().enumerate() {
                env.begin(&mut Recorded::default(), observation.row_mut(0));
                assert_eq!(observation.discrete, [0]);
                env.step(discrete(&[row as u8, column as u8]), &mut Recorded::default(), observation.row_mut(0));
                assert_eq!(observation.discrete, [count], "cell {row}, {column}");
            }
        }
    }
}

#[test]
fn mine_sweeper_in_pictures() {
    let mut env = MineSweeper::new("game", mine_sweeper::LEVELS[0]);
    set(&mut env, "mines", &grid("1000 0100 0000 0000"));
    let mut observation = Slab::new(&env.spec().observation.clone(), 1);
    env.begin(&mut Recorded::default(), observation.row_mut(0));
    let header = "  A B C D\n";
    assert_eq!(picture(&env, View::Observed), format!("{header}1 · · · ·\n2 · · · ·\n3 · · · ·\n4 · · · ·\n"));
    assert_eq!(picture(&env, View::Revealed), format!("{header}1 ● · · ·\n2 · ● · ·\n3 · · · ·\n4 · · · ·\n"));
    for (click, observed, revealed) in [
        ([1, 2], "1 · · · ·\n2 · · 1 ·\n3 · · · ·\n4 · · · ·\n", "1 ● · · ·\n2 · ● 1 ·\n3 · · · ·\n4 · · · ·\n"),
        ([3, 3], "1 · · · ·\n2 · · · ·\n3 · · · ·\n4 · · · 0\n", "1 ● · · ·\n2 · ● 1 ·\n3 · · · ·\n4 · · · 0\n"),
        ([1, 1], "1 · · · ·\n2 · 2 · ·\n3 · · · ·\n4 · · · ·\n", "1 ● · · ·\n2 · × 1 ·\n3 · · · ·\n4 · · · 0\n"),
    ] {
        env.step(discrete(&click), &mut Recorded::default(), observation.row_mut(0));
        assert_eq!(picture(&env, View::Observed), format!("{header}{observed}"));
        assert_eq!(picture(&env, View::Revealed), format!("{header}{revealed}"));
    }
}

#[test]
fn bad_boards_are_errors_and_change_nothing() {
    let fleet = grid(FLEET);
    let mut extra = fleet.clone();
    extra[0][7] = 1;
    let mut cell = fleet.clone();
    cell[0][7] = 2;
    let mut narrow = fleet.clone();
    narrow[3].pop();
    let cases: [(&str, Json, &str); 14] = [
        ("BattleshipEasy", json!({ "ships": extra }), "13 cells, expected 12"),
        ("BattleshipEasy", json!({ "ships": cell }), "is 2, allowed is 0 or 1"),
        ("BattleshipEasy", json!({ "ships": fleet[1..] }), "8 rows of 8"),
        ("BattleshipEasy", json!({ "ships": narrow }), "8 rows of 8"),
        ("BattleshipMedium", json!({ "ships": fleet }), "10 rows of 10"),
        ("BattleshipEasy", json!({ "mines": fleet }), "unknown field `mines`"),
        ("MineSweeperEasy", json!({}), "missing field `mines`"),
        ("MineSweeperEasy", json!({ "mines": grid("1000 0100 0000") }), "4 rows of 4"),
        ("MineSweeperEasy", json!({ "mines": grid("1000 0100 000 0000") }), "4 rows of 4"),
        ("MineSweeperEasy", json!({ "mines": grid("2000 0100 0000 0000") }), "is 2, allowed is 0 or 1"),
        ("MineSweeperEasy", json!({ "mines": grid("0000 0100 0000 0000") }), "1 mines, expected 2"),
        ("MineSweeperEasy", json!({ "mines": grid("1100 0100 0000 0000") }), "3 mines, expected 2"),
        ("MineSweeperEasy", json!({ "mines": [[-1]] }), "-1"),
        ("MineSweeperHard", json!({ "mines": fleet }), "12 mines, expected 10"),
    ];
    let registry = Registry::standard();
    for (name, world, reason) in cases {
        let mut env = registry.make(name).unwrap();
        env.draw_world(&mut stream(0, 0, 0, Purpose::TrainEnv));
        let before = env.world();
        let error = env.set_world(&world).expect_err(name);
        assert!(error.contains(reason), "{name}: {error}");
        assert_eq!(env.world(), before);
    }
    registry.make("BattleshipEasy").unwrap().set_world(&json!({ "ships": fleet })).unwrap();
}

#[test]
#[should_panic(expected = "the board is 9 wide, allowed is 2..=8")]
fn mine_sweeper_has_its_largest_board() {
    MineSweeper::new("game", mine_sweeper::Params { board: 9, mines: 10 });
}

#[test]
#[should_panic(expected = "there are 14 mines, allowed is 1..=13")]
fn mine_sweeper_needs_clear_cells() {
    MineSweeper::new("game", mine_sweeper::Params { board: 4, mines: 14 });
}
