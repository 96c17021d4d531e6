//! Mazes as a test reads them: apart from the crate's own way of storing them.
#![allow(dead_code, reason = "each test binary uses a part")]

use std::collections::VecDeque;

use popgym_envs::Env;
use popgym_envs::maze::{GOAL, START, WALL, World};

/// Row and column steps of the actions: left, right, up, down.
pub(crate) const MOVES: [[i64; 2]; 4] = [[0, -1], [0, 1], [-1, 0], [1, 0]];

pub(crate) fn world(env: &dyn Env) -> World {
    serde_json::from_value(env.world()).unwrap()
}

/// Reads a maze of `0` (free), `1` (wall), `2` (start) and `3` (goal), row by row, between spaces. The end is the goal,
/// or `end` if there is none.
pub(crate) fn maze(text: &str, end: [usize; 2]) -> World {
    let grid: Vec<Vec<u8>> =
        text.split_whitespace().map(|row| row.bytes().map(|digit| digit - b'0').collect()).collect();
    let find = |code: u8| {
        let row = grid.iter().position(|row| row.contains(&code))?;
        Some([row, grid[row].iter().position(|&cell| cell == code)?])
    };
    World { start: find(START).unwrap(), end: find(GOAL).unwrap_or(end), grid }
}

/// The cell that action `action` leads to, and whether it is another one.
pub(crate) fn target(grid: &[Vec<u8>], [row, column]: [usize; 2], action: usize) -> Option<[usize; 2]> {
    let at = |i: usize, step: i64| usize::try_from(i as i64 + step).ok();
    let to = [at(row, MOVES[action][0])?, at(column, MOVES[action][1])?];
    (*grid.get(to[0])?.get(to[1])? != WALL).then_some(to)
}

/// The shortest way from `from` to `to`, as actions.
pub(crate) fn path(grid: &[Vec<u8>], from: [usize; 2], to: [usize; 2]) -> Option<Vec<u8>> {
    let mut came = vec![vec![None; grid.len()]; grid.len()];
    let mut queue = VecDeque::from([from]);
    while let Some(at) = queue.pop_front() {
        if at == to {
            let (mut actions, mut at) = (vec![], at);
            while at != from {
                let (before, action) = came[at[0]][at[1]].unwrap();
                actions.push(action);
                at = before;
            }
            actions.reverse();
            return Some(actions);
        }
        for action in 0..4 {
            if let Some(next) = target(grid, at, action)
                && next != from
                && came[next[0]][next[1]].is_none()
            {
                came[next[0]][next[1]] = Some((at, action as u8));
                queue.push_back(next);
            }
        }
    }
    None
}

/// A way from the start that visits every free cell, as actions: depth first, each cell entered once from its parent and
/// left once for it, until the last new one.
pub(crate) fn tour(world: &World) -> Vec<u8> {
    fn visit(grid: &[Vec<u8>], at: [usize; 2], seen: &mut Vec<[usize; 2]>, actions: &mut Vec<u8>, end: &mut usize) {
        for action in 0..4 {
            if let Some(next) = target(grid, at, action)
                && !seen.contains(&next)
            {
                seen.push(next);
                actions.push(action as u8);
                *end = actions.len();
                visit(grid, next, seen, actions, end);
                actions.push([1, 0, 3, 2][action]);
            }
        }
    }
    let (mut actions, mut end) = (vec![], 0);
    visit(&world.grid, world.start, &mut vec![world.start], &mut actions, &mut end);
    actions.truncate(end);
    actions
}
