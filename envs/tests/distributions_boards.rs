//! What the games on boards and in mazes draw, against calculations and against the package's own procedures, written out
//! here word by word. The seeds are fixed; bounds are five standard errors or more.

mod common;
#[path = "common/grid.rs"]
mod grid;

use std::collections::HashMap;

use common::play_randomly;
use grid::{path, world};
use popgym_envs::battleship::{self, Battleship};
use popgym_envs::labyrinth_escape::LabyrinthEscape;
use popgym_envs::labyrinth_explore::LabyrinthExplore;
use popgym_envs::maze::{FREE, GOAL, LEVELS, START, WALL};
use popgym_envs::mine_sweeper::{self, MineSweeper};
use popgym_envs::rng::below;
use popgym_envs::{Env, EpisodeRng, Purpose, stream};

/// `chi2` has this many degrees of freedom: within five standard deviations, as far as it is near normal.
fn assert_chi2(chi2: f64, freedom: usize, what: &str) {
    let freedom = freedom as f64;
    assert!((chi2 - freedom).abs() < 5.0 * (2.0 * freedom).sqrt(), "{what}: {chi2} with {freedom} degrees of freedom");
}

/// Counts that are all expected to be the same.
fn assert_uniform(counts: &[u32], what: &str) {
    let expected = f64::from(counts.iter().sum::<u32>()) / counts.len() as f64;
    assert!(expected > 5.0, "{what}: too few draws");
    let chi2 = counts.iter().map(|&count| (f64::from(count) - expected).powi(2) / expected).sum();
    assert_chi2(chi2, counts.len() - 1, what);
}

/// A sample of one quantity, by sum and sum of squares.
#[derive(Clone, Copy, Default)]
struct Moments {
    n: f64,
    sum: f64,
    squares: f64,
}

impl Moments {
    fn add(&mut self, x: f64) {
        self.n += 1.0;
        self.sum += x;
        self.squares += x * x;
    }

    fn mean(&self) -> f64 {
        self.sum / self.n
    }

    /// Squared standard error of the mean.
    fn error2(&self) -> f64 {
        (self.squares / self.n - self.mean().powi(2)) / self.n
    }

    fn assert_like(&self, other: &Self, what: &str) {
        let (a, b, error) = (self.mean(), other.mean(), (self.error2() + other.error2()).sqrt());
        assert!((a - b).abs() <= 5.0 * error, "{what}: {a} is not {b} (standard error {error})");
    }
}

/// The present world's grid, row after row.
fn cells(env: &dyn Env, key: &str) -> Vec<u8> {
    serde_json::from_value::<Vec<Vec<u8>>>(env.world()[key].clone()).unwrap().concat()
}

#[test]
fn every_set_of_mines_is_equally_likely() {
    let mut env = MineSweeper::new("game", mine_sweeper::LEVELS[0]);
    let mut rng = stream(0, 0, 3, Purpose::TrainEnv);
    let mut counts = HashMap::new();
    for _ in 0..24_000 {
        env.draw_world(&mut rng);
        *counts.entry(cells(&env, "mines")).or_insert(0) += 1;
    }
    // 16 choose 2, 119 degrees of freedom.
    assert_eq!(counts.len(), 120);
    assert_uniform(&counts.into_values().collect::<Vec<u32>>(), "pairs of mines");
}

#[test]
fn every_cell_and_pair_of_cells_is_mined_equally_often() {
    const BOARDS: usize = 8000;
    for level in &mine_sweeper::LEVELS[1..] {
        let mut env = MineSweeper::new("game", *level);
        let mut rng = stream(0, 0, 4, Purpose::TrainEnv);
        let n2 = level.board.pow(2);
        let (mut single, mut pairs) = (vec![0.0_f64; n2], vec![0.0_f64; n2 * n2]);
        for _ in 0..BOARDS {
            env.draw_world(&mut rng);
            let mines: Vec<usize> =
                cells(&env, "mines").iter().enumerate().filter(|(_, mine)| **mine == 1).map(|(cell, _)| cell).collect();
            for (i, &a) in mines.iter().enumerate() {
                single[a] += 1.0;
                mines[..i].iter().for_each(|&b| pairs[a * n2 + b] += 1.0);
            }
        }
        let (n2, m) = (n2 as f64, level.mines as f64);
        let p = m / n2;
        let expected = BOARDS as f64 * p;
        // Counts of a fixed number of mines a board are a little less spread than independent ones.
        let spread = expected * (1.0 - p) * n2 / (n2 - 1.0);
        let chi2 = single.iter().map(|count| (count - expected).powi(2) / spread).sum();
        assert_chi2(chi2, n2 as usize - 1, "cells");
        let q = p * (m - 1.0) / (n2 - 1.0);
        let (expected, error) = (BOARDS as f64 * q, (BOARDS as f64 * q * (1.0 - q)).sqrt());
        for a in 0..n2 as usize {
            for b in 0..a {
                let count = pairs[a * n2 as usize + b];
                assert!((count - expected).abs() < 5.5 * error, "cells {a} and {b}: {count} is not {expected}");
            }
        }
    }
}

/// Mean return of uniformly random clicks, exactly: all that counts is how many cells were clicked.
fn mine_sweeper_mean(cells: f64, mines: f64) -> f64 {
    let clear = cells - mines;
    let mut mean = vec![0.0; clear as usize + 1];
    // Backwards in time; `mean[seen]` is what is yet to come. After the last clear cell there is nothing.
    for _ in 0..clear as usize {
        for seen in 0..clear as usize {
            let p = seen as f64 / cells;
            mean[seen] = mines / cells * (-0.5 - 1.0 / clear)
                + p * (-0.5 / (clear - 2.0) + mean[seen])
                + (1.0 - mines / cells - p) * (1.0 / clear + mean[seen + 1]);
        }
    }
    mean[0]
}

/// The same of uniformly random shots: all that counts is the number of hits.
fn battleship_mean(cells: f64) -> f64 {
    let mut mean = [0.0; 13];
    for _ in 0..cells as usize {
        for hits in 0..12 {
            let p = (12.0 - hits as f64) / cells;
            mean[hits] = p * (1.0 / 12.0 + mean[hits + 1]) + (1.0 - p) * (mean[hits] - 1.0 / (cells - 12.0));
        }
    }
    mean[0]
}

#[test]
fn random_play_on_boards_returns_what_can_be_calculated() {
    // Close to what the Python package was measured at: -0.236, -0.403, -0.433; -0.449, -0.414, -0.400.
    let mines = mine_sweeper::LEVELS.map(|level| {
        let env: Box<dyn Env> = Box::new(MineSweeper::new("game", level));
        (env, mine_sweeper_mean(level.board.pow(2) as f64, level.mines as f64))
    });
    let ships = battleship::LEVELS.map(|level| {
        let env: Box<dyn Env> = Box::new(Battleship::new("game", level));
        (env, battleship_mean(level.board.pow(2) as f64))
    });
    for (mut env, expected) in mines.into_iter().chain(ships) {
        let mut returns = Moments::default();
        (0..3000).for_each(|index| returns.add(play_randomly(env.as_mut(), 5, index).total()));
        let error = returns.error2().sqrt();
        assert!((returns.mean() - expected).abs() < 4.0 * error, "{} is not {expected}", returns.mean());
    }
}

/// Ships as the package places them: a start, an axis and a direction, until all cells are on the board and free.
fn place_ships(n: i64, rng: &mut EpisodeRng) -> Vec<u8> {
    let mut board = vec![0; (n * n) as usize];
    let mut pick = |m: i64| i64::from(below(rng, m as u32));
    for size in [2, 3, 3, 4] {
        loop {
            let start = [pick(n), pick(n)];
            let (axis, sign) = (pick(2) as usize, 2 * pick(2) - 1);
            let ship: Vec<[i64; 2]> = (0..size)
                .map(|i| {
                    let mut cell = start;
                    cell[axis] += sign * i;
                    cell
                })
                .collect();
            let on_board = ship.iter().flatten().all(|i| (0..n).contains(i));
            if on_board && ship.iter().all(|[row, column]| board[(row * n + column) as usize] == 0) {
                for [row, column] in ship {
                    board[(row * n + column) as usize] = 1;
                }
                break;
            }
        }
    }
    board
}

#[test]
fn ships_are_spread_as_by_the_package() {
    const BOARDS: usize = 20_000;
    let n = 8;
    let mut env = Battleship::new("game", battleship::LEVELS[0]);
    let mut rngs = [3, 4].map(|seed| stream(seed, 0, 0, Purpose::TrainEnv));
    // Each cell, and pairs of neighbours to the right and below, which also tell how ships touch.
    let mut found = [vec![Moments::default(); 3 * n * n], vec![Moments::default(); 3 * n * n]];
    let mut neighbours = [Moments::default(); 2];
    for _ in 0..BOARDS {
        env.draw_world(&mut rngs[0]);
        for (i, board) in [cells(&env, "ships"), place_ships(n as i64, &mut rngs[1])].into_iter().enumerate() {
            let mut touching = 0.0;
            for cell in 0..n * n {
                let right = cell % n + 1 < n && board[cell] & board[cell + 1] == 1;
                let below = cell / n + 1 < n && board[cell] & board[cell + n] == 1;
                for (j, ship) in [board[cell] == 1, right, below].into_iter().enumerate() {
                    found[i][3 * cell + j].add(f64::from(u8::from(ship)));
                }
                touching += f64::from(u8::from(right) + u8::from(below));
            }
            neighbours[i].add(touching);
        }
    }
    let [a, b] = found;
    a.iter().zip(&b).enumerate().for_each(|(i, (a, b))| a.assert_like(b, &format!("cell {}, kind {}", i / 3, i % 3)));
    neighbours[0].assert_like(&neighbours[1], "pairs of neighbours");
}

/// A maze as the package draws it (hunt and kill of mazelib, in random order), without its entrances.
fn hunt_and_kill(c: usize, rng: &mut EpisodeRng) -> Vec<Vec<u8>> {
    let side = 2 * c + 1;
    let mut grid = vec![vec![WALL; side]; side];
    let pick = |rng: &mut EpisodeRng| 2 * below(rng, c as u32) as usize + 1;
    let mut at = [pick(rng), pick(rng)];
    grid[at[0]][at[1]] = FREE;
    for hunt in 0..=side * side {
        while grid[at[0]][at[1]] == FREE {
            let mut neighbours = vec![];
            for (axis, step) in [(0, -2), (0, 2), (1, -2), (1, 2)] {
                let mut to = at;
                to[axis] = at[axis].wrapping_add_signed(step);
                if to[axis] < side && grid[to[0]][to[1]] == WALL {
                    neighbours.push(to);
                }
            }
            if neighbours.is_empty() {
                break;
            }
            let to = neighbours[below(rng, neighbours.len() as u32) as usize];
            grid[usize::midpoint(at[0], to[0])][usize::midpoint(at[1], to[1])] = FREE;
            grid[to[0]][to[1]] = FREE;
            at = to;
        }
        if hunt < side * side {
            at = [pick(rng), pick(rng)];
        }
    }
    grid
}

/// Number of rooms with one way out, with two in a line, with two round a corner, and with more.
fn rooms(grid: &[Vec<u8>]) -> [f64; 4] {
    let mut counts = [0.0; 4];
    for row in (1..grid.len()).step_by(2) {
        for column in (1..grid.len()).step_by(2) {
            let [left, right] = [grid[row][column - 1], grid[row][column + 1]].map(|cell| cell == FREE);
            let [up, down] = [grid[row - 1][column], grid[row + 1][column]].map(|cell| cell == FREE);
            let kind = match [left, right, up, down].into_iter().filter(|way| *way).count() {
                0 | 1 => 0,
                2 => {
                    if left == right {
                        1
                    } else {
                        2
                    }
                }
                _ => 3,
            };
            counts[kind] += 1.0;
        }
    }
    counts
}

#[test]
fn mazes_are_those_of_the_package() {
    const MAZES: usize = 2000;
    for (level, published) in LEVELS.into_iter().zip([21.5, 36.3, 50.6]) {
        let c = level.corridors;
        let side = 2 * c + 1;
        let mut env = LabyrinthEscape::new("game", level);
        let mut rngs = [5, 6].map(|seed| stream(seed, 0, c as u64, Purpose::TrainEnv));
        let mut walls = [vec![Moments::default(); side * side], vec![Moments::default(); side * side]];
        let mut kinds = [[Moments::default(); 4]; 2];
        let mut lengths = [Moments::default(); 2];
        let (mut borders, mut positions) = ([0; 4], [vec![0; c], vec![0; c]]);
        let (mut shortest, mut pairs) = (usize::MAX, vec![0; c * c]);
        for _ in 0..MAZES {
            env.draw_world(&mut rngs[0]);
            let drawn = world(&env);
            let mut own = drawn.grid.clone();

            // The entrances: two opposite sides, and odd positions independent of each other.
            let (start, end, far) = (drawn.start, drawn.end, side - 1);
            assert_eq!((own[start[0]][start[1]], own[end[0]][end[1]]), (START, GOAL));
            let border = match (start, end) {
                ([0, _], [row, _]) if row == far => 0,
                ([row, _], [0, _]) if row == far => 1,
                ([_, 0], [_, column]) if column == far => 2,
                ([_, column], [_, 0]) if column == far => 3,
                _ => panic!("{start:?} is not opposite {end:?}"),
            };
            borders[border] += 1;
            let along = [start, end].map(|at| at[usize::from(border < 2)]);
            assert!(along.iter().all(|i| i % 2 == 1));
            (0..2).for_each(|i| positions[i][along[i] / 2] += 1);
            pairs[along[0] / 2 * c + along[1] / 2] += 1;

            // A tree: as many free cells as there are, with one way between any two, has no cycle if all are reached.
            (own[start[0]][start[1]], own[end[0]][end[1]]) = (WALL, WALL);
            assert_eq!(own.iter().flatten().filter(|&&cell| cell == FREE).count(), 2 * c * c - 1);
            assert_eq!(reached(&own), 2 * c * c - 1);

            let other = hunt_and_kill(c, &mut rngs[1]);
            // The same entrances, so that the ways through both mazes have the same ends.
            let mut opened = other.clone();
            (opened[start[0]][start[1]], opened[end[0]][end[1]]) = (START, GOAL);
            for (i, grid) in [&drawn.grid, &opened].into_iter().enumerate() {
                let length = path(grid, start, end).unwrap().len();
                lengths[i].add(length as f64);
                if i == 0 {
                    shortest = shortest.min(length);
                }
            }
            for (i, grid) in [&own, &other].into_iter().enumerate() {
                rooms(grid).iter().zip(&mut kinds[i]).for_each(|(&count, moments)| moments.add(count));
                grid.concat().iter().zip(&mut walls[i]).for_each(|(&cell, wall)| wall.add(f64::from(cell)));
            }
        }
        for (kind, what) in ["dead ends", "straight corridors", "corners", "forks"].into_iter().enumerate() {
            kinds[0][kind].assert_like(&kinds[1][kind], what);
        }
        for (cell, (found, expected)) in walls[0].iter().zip(&walls[1]).enumerate() {
            found.assert_like(expected, &format!("cell {cell}"));
        }
        lengths[0].assert_like(&lengths[1], "the shortest way");
        // Measured on the package in 400 episodes or more, and given with one digit.
        let error = (lengths[0].error2() * (1.0 + MAZES as f64 / 400.0)).sqrt() + 0.05;
        assert!((lengths[0].mean() - published).abs() < 4.0 * error, "{} is not {published}", lengths[0].mean());
        assert_eq!(shortest, 2 * c, "straight from one side to the other");
        assert_uniform(&borders, "sides of the start");
        for counts in &positions {
            assert_uniform(counts, "positions of an entrance");
        }
        assert_uniform(&pairs, "positions of both entrances");
    }
}

/// How many free cells can be reached from the first one.
fn reached(grid: &[Vec<u8>]) -> usize {
    let mut seen = vec![vec![false; grid.len()]; grid.len()];
    seen[1][1] = true;
    let (mut stack, mut count) = (vec![[1, 1]], 0);
    while let Some(at) = stack.pop() {
        count += 1;
        for action in 0..4 {
            if let Some(next) = grid::target(grid, at, action)
                && !std::mem::replace(&mut seen[next[0]][next[1]], true)
            {
                stack.push(next);
            }
        }
    }
    count
}

/// Both games draw the same mazes; only the end differs.
#[test]
fn exploring_takes_place_in_the_same_mazes() {
    for level in LEVELS {
        let (mut escape, mut explore) = (LabyrinthEscape::new("game", level), LabyrinthExplore::new("game", level));
        for seed in 0..5 {
            escape.draw_world(&mut stream(seed, 0, 0, Purpose::TrainEnv));
            explore.draw_world(&mut stream(seed, 0, 0, Purpose::TrainEnv));
            let mut expected = world(&escape);
            expected.grid[expected.end[0]][expected.end[1]] = WALL;
            assert_eq!(world(&explore), expected);
        }
    }
}
