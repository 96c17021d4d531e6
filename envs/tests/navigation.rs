//! The rules of the labyrinths, and their pictures.
#![allow(clippy::float_cmp, reason = "rewards are compared to the last bit")]

mod common;
#[path = "common/grid.rs"]
mod grid;

use common::{Episode, assert_observed_is_all_that_is_shown, picture, play};
use grid::{maze, path, target, tour, world};
use popgym_envs::labyrinth_escape::{self, LabyrinthEscape};
use popgym_envs::labyrinth_explore::{self, LabyrinthExplore};
use popgym_envs::maze::{ACTIONS, HIDDEN, Params, WALL, World};
use popgym_envs::{Canvas, Env, Purpose, Recorded, Registry, Step, View, stream};
use serde_json::{Value as Json, json};

const LEFT: u8 = 0;
const RIGHT: u8 = 1;
const UP: u8 = 2;
const DOWN: u8 = 3;
const COST: f64 = -1.0 / 1024.0;

fn assert_near(found: f64, expected: f64) {
    assert!((found - expected).abs() < 1e-9, "{found} is not {expected}");
}

/// Plays the present world with these actions, and the last of them for the rest of the episode.
fn walk(env: &mut dyn Env, actions: &[u8]) -> Episode {
    play(env, &mut Recorded::default(), |t, _, action| action.discrete[0] = actions[t.min(actions.len() - 1)])
}

fn drawn(env: &mut dyn Env, seed: u64) -> World {
    env.draw_world(&mut stream(seed, 0, 0, Purpose::TrainEnv));
    world(env)
}

/// An action that stays on the start, which is in the outer wall.
fn idle(world: &World) -> u8 {
    (0..4).find(|&action| target(&world.grid, world.start, usize::from(action)).is_none()).unwrap()
}

#[test]
fn the_shortest_way_out_returns_one_minus_its_length() {
    for level in labyrinth_escape::LEVELS {
        let mut env = LabyrinthEscape::new("game", level);
        for seed in 0..20 {
            let world = drawn(&mut env, seed);
            let way = path(&world.grid, world.start, world.end).unwrap();
            let episode = walk(&mut env, &way);
            assert_eq!(episode.steps.len(), way.len());
            assert_near(episode.total(), 1.0 - way.len() as f64 / 1024.0);
            let last = Step { reward: 1.0 + COST, terminated: true, truncated: false };
            assert_eq!(episode.steps[way.len() - 1], last);
            assert!(
                episode.steps[..way.len() - 1].iter().all(|step| *step == Step { reward: COST, ..Step::default() })
            );
        }
    }
}

/// The goal still counts on the last step, which is then both.
#[test]
fn the_way_out_can_take_all_the_time_and_no_more() {
    for level in labyrinth_escape::LEVELS {
        let mut env = LabyrinthEscape::new("game", level);
        let world = drawn(&mut env, 100);
        let way = path(&world.grid, world.start, world.end).unwrap();
        let late = |spare: usize| [vec![idle(&world); 1023 - way.len() + spare], way.clone()].concat();

        let just = walk(&mut env, &late(0));
        assert_eq!(just.steps.len(), 1023);
        assert_eq!(just.steps[1022], Step { reward: 1.0 + COST, terminated: true, truncated: true });
        assert_near(just.total(), 1.0 / 1024.0);

        let never = walk(&mut env, &late(1));
        assert_eq!(never.steps.len(), 1023);
        assert_eq!(never.steps[1022], Step { reward: COST, terminated: false, truncated: true });
        assert_near(never.total(), -1023.0 / 1024.0);
    }
}

#[test]
fn exploring_pays_for_new_cells_and_costs_for_others() {
    for level in labyrinth_explore::LEVELS {
        let mut env = LabyrinthExplore::new("game", level);
        // The closed form of a finished maze: 49, 97 and 161 free cells.
        let free = 2 * level.corridors.pow(2) - 1;
        for seed in 0..20 {
            let world = drawn(&mut env, seed);
            let way = tour(&world);
            let again = way.len() - free;
            let episode = walk(&mut env, &way);
            assert_eq!(episode.steps.len(), way.len());
            assert_near(episode.total(), 1.0 - again as f64 / 1024.0);
            let last = Step { reward: 1.0 / free as f64, terminated: true, truncated: false };
            assert_eq!(episode.steps[way.len() - 1], last);
            assert_eq!(episode.steps.iter().filter(|step| step.reward == COST).count(), again);
            // Only the walls, of which the end is one, are not in the hidden state at last.
            let seen = episode.states.row(way.len()).discrete;
            assert!(
                world
                    .grid
                    .concat()
                    .iter()
                    .zip(seen)
                    .all(|(&cell, &seen)| seen == [cell, HIDDEN][usize::from(cell == WALL)])
            );
        }
        let world = drawn(&mut env, 100);
        let way = tour(&world);
        let late = |spare: usize| [vec![idle(&world); 1023 - way.len() + spare], way.clone()].concat();
        let just = walk(&mut env, &late(0));
        assert_eq!(just.steps[1022], Step { reward: 1.0 / free as f64, terminated: true, truncated: true });
        assert_near(just.total(), 1.0 - (1023 - free) as f64 / 1024.0);
        let short = walk(&mut env, &late(1));
        assert_eq!(short.steps.len(), 1023);
        assert!(short.steps[1022].truncated && !short.steps[1022].terminated);
        assert_near(short.total(), (free - 1) as f64 / free as f64 - (1024 - free) as f64 / 1024.0);

        let nothing = walk(&mut env, &[idle(&world)]);
        assert_eq!(nothing.steps.len(), 1023);
        assert_near(nothing.total(), -1023.0 / 1024.0);
    }
}

/// A way through a small maze, with a dead end and a step back.
#[test]
fn a_small_labyrinth_by_hand() {
    let text = "11111 20011 10111 10003 11111";
    let mut escape = LabyrinthEscape::new("game", Params { corridors: 2 });
    escape.set_world(&json!(maze(text, [0, 0]))).unwrap();
    let way = [RIGHT, RIGHT, LEFT, DOWN, DOWN, UP, DOWN, RIGHT, RIGHT, RIGHT];
    let episode = walk(&mut escape, &way);
    assert_eq!(episode.steps.len(), 10);
    assert_near(episode.total(), 1.0 - 10.0 / 1024.0);
    #[rustfmt::skip]
    let states = [
        [4, 4, 4, 4, 4,  2, 4, 4, 4, 4,  4, 4, 4, 4, 4,  4, 4, 4, 4, 4,  4, 4, 4, 4, 4],
        [4, 4, 4, 4, 4,  2, 0, 4, 4, 4,  4, 4, 4, 4, 4,  4, 4, 4, 4, 4,  4, 4, 4, 4, 4],
        [4, 4, 4, 4, 4,  2, 0, 0, 4, 4,  4, 4, 4, 4, 4,  4, 4, 4, 4, 4,  4, 4, 4, 4, 4],
        [4, 4, 4, 4, 4,  2, 0, 0, 4, 4,  4, 4, 4, 4, 4,  4, 4, 4, 4, 4,  4, 4, 4, 4, 4],
        [4, 4, 4, 4, 4,  2, 0, 0, 4, 4,  4, 0, 4, 4, 4,  4, 4, 4, 4, 4,  4, 4, 4, 4, 4],
    ];
    for (t, state) in states.iter().enumerate() {
        assert_eq!(episode.states.row(t).discrete, state);
    }
    assert_eq!(episode.states.row(10).discrete[15..20], [4, 0, 0, 0, 3]);
    assert_eq!(episode.observations.row(9).discrete, [1, 1, 1, 0, 0, 3, 1, 1, 1, RIGHT], "the goal is seen");

    // The same without a goal ends with the last of the six free cells.
    let mut explore = LabyrinthExplore::new("game", Params { corridors: 2 });
    explore.set_world(&json!(maze("11111 20011 10111 10001 11111", [3, 4]))).unwrap();
    let episode = walk(&mut explore, &way);
    let rewards: Vec<f64> = episode.steps.iter().map(|step| step.reward).collect();
    let unit = 1.0 / 6.0;
    assert_eq!(rewards, [unit, unit, COST, unit, unit, COST, COST, unit, unit]);
    assert!(episode.steps[8].terminated);
}

/// The window is cut at the border of the grid and filled up below and to the right: by hand, at every border.
#[test]
fn windows_at_the_borders() {
    let world = maze("00010 01000 00200 10001 00100", [0, 3]);
    let mut env = LabyrinthExplore::new("game", Params { corridors: 2 });
    env.set_world(&json!(world)).unwrap();
    for (to, window) in [
        ([2, 2], [1, 0, 0, 0, 2, 0, 0, 0, 0]),
        ([1, 2], [0, 0, 1, 1, 0, 0, 0, 2, 0]),
        ([0, 0], [0, 0, 1, 0, 1, 1, 1, 1, 1]),
        ([0, 2], [0, 0, 1, 1, 0, 0, 1, 1, 1]),
        ([0, 4], [1, 0, 1, 0, 0, 1, 1, 1, 1]),
        ([2, 0], [0, 1, 1, 0, 0, 1, 1, 0, 1]),
        ([2, 4], [0, 0, 1, 0, 0, 1, 0, 1, 1]),
        ([4, 0], [1, 0, 1, 0, 0, 1, 1, 1, 1]),
        ([4, 1], [1, 0, 0, 0, 0, 1, 1, 1, 1]),
        ([4, 3], [0, 0, 1, 1, 0, 0, 1, 1, 1]),
        ([4, 4], [0, 1, 1, 0, 0, 1, 1, 1, 1]),
    ] {
        let way = path(&world.grid, world.start, to).unwrap();
        let episode = walk(&mut env, if way.is_empty() { &[UP] } else { &way });
        let seen = episode.observations.row(way.len()).discrete;
        assert_eq!(seen[..9], window, "at {to:?}");
        assert_eq!(seen[9], way.last().copied().unwrap_or(4));
    }
}

/// Out of the grid there is no way, and into walls neither: the agent stays, and both cost.
#[test]
fn walls_and_borders_stop() {
    let mut env = LabyrinthEscape::new("game", Params { corridors: 1 });
    for (text, out, into) in [
        ("121 101 131", UP, LEFT),
        ("131 101 121", DOWN, RIGHT),
        ("111 203 111", LEFT, UP),
        ("111 302 111", RIGHT, DOWN),
    ] {
        env.set_world(&json!(maze(text, [0, 0]))).unwrap();
        let forth = [DOWN, UP, RIGHT, LEFT][[UP, DOWN, LEFT, RIGHT].iter().position(|&side| side == out).unwrap()];
        let episode = walk(&mut env, &[out, into, out, forth, into, forth]);
        assert_eq!(episode.steps.len(), 6);
        assert_near(episode.total(), 1.0 - 6.0 / 1024.0);
        for t in 1..=3 {
            assert_eq!(episode.states.row(t), episode.states.row(0));
            assert_eq!(episode.observations.row(t).discrete[..9], episode.observations.row(0).discrete[..9]);
        }
        assert_ne!(episode.states.row(4), episode.states.row(0));
    }
}

/// Whatever is done, the agent is where a walk on the plain grid leads to.
#[test]
fn random_walks_are_those_of_the_plain_grid() {
    let mut env = LabyrinthEscape::new("game", labyrinth_escape::LEVELS[1]);
    for seed in 0..20 {
        let world = drawn(&mut env, seed);
        let side = world.grid.len();
        let mut policy = stream(seed, 0, 0, Purpose::TrainAction);
        let episode = play(&mut env, &mut Recorded::default(), |_, _, action| {
            action.discrete[0] = popgym_envs::rng::below(&mut policy, 4) as u8;
        });
        let (mut at, mut last) = (world.start, 4);
        let mut state = vec![HIDDEN; side * side];
        for t in 0..=episode.steps.len() {
            if t > 0 {
                last = episode.actions.row(t - 1).discrete[0];
                at = target(&world.grid, at, usize::from(last)).unwrap_or(at);
            }
            state[at[0] * side + at[1]] = world.grid[at[0]][at[1]];
            assert_eq!(episode.states.row(t).discrete, state);
            // As numpy cuts: `grid[max(y - 1, 0):y + 2, max(x - 1, 0):x + 2]`, then padded at the end of both axes.
            let cut = |i: usize| (i.saturating_sub(1)..(i + 2).min(side)).map(Some).chain([None; 3]).take(3);
            let window = cut(at[0]).flat_map(|row| cut(at[1]).map(move |column| Some([row?, column?])));
            let window = window.map(|cell| cell.map_or(WALL, |[row, column]| world.grid[row][column]));
            assert_eq!(episode.observations.row(t).discrete, window.chain([last]).collect::<Vec<_>>());
        }
    }
}

#[test]
fn labyrinths_in_pictures() {
    let mut env = LabyrinthEscape::new("game", Params { corridors: 1 });
    env.set_world(&json!(maze("121 101 131", [0, 0]))).unwrap();
    let mut observation = popgym_envs::Slab::new(&env.spec().observation.clone(), 1);
    env.begin(&mut Recorded::default(), observation.row_mut(0));
    let mut found = vec![[View::Observed, View::Revealed].map(|view| picture(&env, view))];
    for action in [LEFT, DOWN, DOWN] {
        env.step(common::discrete(&[action]), &mut Recorded::default(), observation.row_mut(0));
        found.push([View::Observed, View::Revealed].map(|view| picture(&env, view)));
    }
    let framed = |rows: [&str; 3], last: &str| {
        let [a, b, c] = rows.map(|row| format!("│{row}│\n"));
        format!("┌──────┐\n{a}{b}{c}└──────┘\n last {last}\n")
    };
    let (start, below, wall) = ("██S ██", "██  ██", "██████");
    let expected = [
        [framed([start, below, wall], "-"), "██()██\n██  ██\n██G ██\n".to_owned()],
        [framed([start, below, wall], "←"), "██()██\n██  ██\n██G ██\n".to_owned()],
        [framed([start, below, "██G ██"], "↓"), "██S ██\n██()██\n██G ██\n".to_owned()],
        [framed([below, "██G ██", wall], "↓"), "██S ██\n██··██\n██()██\n".to_owned()],
    ];
    assert_eq!(found, expected);
    assert_eq!(env.action_names(), ACTIONS);
    assert_eq!(ACTIONS, ["left", "right", "up", "down"]);
}

#[test]
fn labyrinths_show_what_is_observed_and_no_more() {
    for name in ["LabyrinthEscapeEasy", "LabyrinthExploreEasy"] {
        assert_observed_is_all_that_is_shown(Registry::standard().make(name).unwrap().as_mut(), 6);
    }
    // Two mazes that differ in a cell out of sight.
    let pictures = ["11111 20001 11101 10001 11311", "11111 20001 11101 11001 11311"].map(|text| {
        let mut env = LabyrinthEscape::new("game", Params { corridors: 2 });
        env.set_world(&json!(maze(text, [0, 0]))).unwrap();
        env.begin(&mut Recorded::default(), popgym_envs::Slab::new(&env.spec().observation.clone(), 1).row_mut(0));
        [View::Observed, View::Revealed].map(|view| {
            let mut canvas = Canvas::new();
            env.render(view, &mut canvas);
            canvas
        })
    });
    assert_eq!(pictures[0][0], pictures[1][0]);
    assert_ne!(pictures[0][1], pictures[1][1]);
}

#[test]
fn bad_mazes_are_errors_and_change_nothing() {
    let good = json!(maze("11111 20011 10111 10003 11111", [0, 0]));
    let with = |change: &dyn Fn(&mut Json)| {
        let mut world = good.clone();
        change(&mut world);
        world
    };
    let cell = |row: usize, column: usize, code: u8| with(&|world| world["grid"][row][column] = json!(code));
    let cases = [
        (
            with(&|world| world["grid"] = json!(world["grid"].as_array().unwrap()[1..])),
            "the grid is not 5 rows of 5 cells",
        ),
        (with(&|world| world["grid"][2] = json!([1, 0, 1, 1])), "the grid is not 5 rows of 5 cells"),
        (cell(1, 2, 4), "cell [1, 2] of the grid is 4, allowed is 0 or 1"),
        (cell(1, 2, 2), "cell [1, 2] of the grid is 2, allowed is 0 or 1"),
        (cell(1, 2, 3), "cell [1, 2] of the grid is 3, allowed is 0 or 1"),
        (cell(1, 0, 0), "the start, cell [1, 0] of the grid, is 0, expected 2"),
        (cell(3, 4, 1), "the end, cell [3, 4] of the grid, is 1, expected 3"),
        (with(&|world| world["start"] = json!([1, 1])), "the start, cell [1, 1] of the grid, is 0, expected 2"),
        (with(&|world| world["start"] = json!([1, 5])), "the start is [1, 5], allowed is 0..5 for each"),
        (with(&|world| world["end"] = json!([9, 0])), "the end is [9, 0], allowed is 0..5 for each"),
        (with(&|world| world["end"] = json!([1, 0])), "the end, cell [1, 0] of the grid, is 2, expected 3"),
        (with(&|world| world["start"] = json!([1, -1])), "-1"),
        (with(&|world| world["start"] = json!([1])), "length 1"),
        (with(&|world| world["size"] = json!(5)), "unknown field `size`"),
        (json!({ "grid": good["grid"], "start": [1, 0] }), "missing field `end`"),
        (json!(maze("11111 21111 11111 11113 11111", [0, 0])), "the grid has no free cell"),
    ];
    let mut escape = LabyrinthEscape::new("game", Params { corridors: 2 });
    let mut explore = LabyrinthExplore::new("game", Params { corridors: 2 });
    let before = [drawn(&mut escape, 0), drawn(&mut explore, 0)];
    for (world, reason) in &cases {
        let error = escape.set_world(world).expect_err(reason);
        assert!(error.contains(reason), "{error}");
    }
    // Where there is no goal, the end is a wall.
    let error = explore.set_world(&good).unwrap_err();
    assert!(error.contains("the end, cell [3, 4] of the grid, is 3, expected 1"), "{error}");
    assert_eq!([world(&escape), world(&explore)], before);

    // A goal that cannot be reached, and a start inside, are allowed; and the world that comes out is the one put in.
    for world in [good, json!(maze("11111 12011 10111 11111 11131", [0, 0]))] {
        escape.set_world(&world).unwrap();
        assert_eq!(escape.world(), world);
    }
    assert_eq!(walk(&mut escape, &[RIGHT, DOWN]).steps.len(), 1023);
}

#[test]
#[should_panic(expected = "there are 101 corridors, allowed is 1..=100")]
fn mazes_have_their_largest_size() {
    LabyrinthEscape::new("game", Params { corridors: 101 });
}
