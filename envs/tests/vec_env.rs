//! Many environments at once: the same episodes as one by one, and no allocation.
#![allow(unsafe_code, reason = "a global allocator, to count allocations, cannot be written without")]

mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use popgym_envs::{Purpose, Registry, Slab, Step, VecEnv, stream};

thread_local! {
    static ALLOCATIONS: Cell<usize> = const { Cell::new(0) };
}

struct Counting;

// SAFETY: hands every call on to the system's allocator as it is; `realloc` and `alloc_zeroed` come through `alloc`.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.set(ALLOCATIONS.get() + 1);
        // SAFETY: the caller's layout.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the pointer came from `alloc` above, with this layout.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

const ROWS: usize = 5;

fn env_stream(episode: usize) -> popgym_envs::EpisodeRng {
    stream(1, 0, episode as u64, Purpose::EvalEnv)
}

/// Rows of random actions, and an environment for each with its first episode begun.
fn begun(registry: &Registry, id: &str) -> (VecEnv, Slab, Slab, Vec<Step>) {
    let mut envs = VecEnv::new(registry, id, ROWS).unwrap();
    let (actions, mut observations) = (envs.actions(), envs.observations());
    for row in 0..ROWS {
        envs.begin(row, env_stream(row), &mut observations);
    }
    (envs, actions, observations, vec![Step::default(); ROWS])
}

#[test]
fn rows_play_the_episodes_of_single_environments() {
    let registry = Registry::standard();
    for entry in &registry {
        let singles: Vec<_> =
            (0..ROWS).map(|row| common::play_randomly(entry.make().as_mut(), 0, row as u64)).collect();
        let (mut envs, mut actions, mut observations, mut steps) = begun(&registry, entry.id());
        let mut states = envs.states();
        let mut t = 0;
        loop {
            for (row, single) in singles.iter().enumerate() {
                // Rows that are done stay as they were.
                let seen = t.min(single.steps.len());
                envs.state(row, &mut states);
                assert_eq!(observations.row(row), single.observations.row(seen));
                assert_eq!(states.row(row), single.states.row(seen));
            }
            let running: Vec<usize> = (0..ROWS).rev().filter(|&row| t < singles[row].steps.len()).collect();
            if running.is_empty() {
                break;
            }
            for &row in &running {
                actions.set(row, singles[row].actions.row(t));
            }
            envs.step_rows(&running, &actions, &mut observations, &mut steps);
            for &row in &running {
                assert_eq!(steps[row], singles[row].steps[t]);
            }
            t += 1;
        }
    }
}

#[test]
fn stepping_and_beginning_do_not_allocate() {
    let registry = Registry::standard();
    for entry in &registry {
        let (mut envs, mut actions, mut observations, mut steps) = begun(&registry, entry.id());
        let mut states = envs.states();
        let action = envs.spec().action.clone();
        let mut policy = stream(0, 0, 0, Purpose::TrainAction);
        let mut episodes = ROWS;
        let rows = [0, 1, 2, 3, 4];
        let before = ALLOCATIONS.get();
        while episodes < 3 * ROWS {
            for row in rows {
                action.sample_into(&mut policy, actions.row_mut(row));
            }
            envs.step_rows(&rows, &actions, &mut observations, &mut steps);
            for row in rows {
                envs.state(row, &mut states);
                if steps[row].done() {
                    envs.begin(row, env_stream(episodes), &mut observations);
                    episodes += 1;
                }
            }
        }
        assert_eq!(ALLOCATIONS.get(), before, "{}", entry.id());
    }
    let before = ALLOCATIONS.get();
    drop(std::hint::black_box(vec![0_u8; 100]));
    assert!(ALLOCATIONS.get() > before, "the counter does not count");
}

#[test]
fn an_unknown_name_is_an_error() {
    assert_eq!(VecEnv::new(&Registry::standard(), "Nothing", 1).err().unwrap().name, "Nothing");
}
