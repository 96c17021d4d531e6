//! Many environments at once: the same episodes as one by one, and no allocation.
#![allow(unsafe_code, reason = "a global allocator, to count allocations, cannot be written without")]

mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use popgym_envs::wrappers::{Antialias, Flatten, PreviousAction};
use popgym_envs::{MakeError, Purpose, Registry, Slab, Space, Step, VecEnv, stream};

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

/// More than are stepped side by side, and not a multiple.
const ROWS: usize = 11;

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
            if running.len() == ROWS {
                let ended = envs.step_all(&actions, &mut observations, &mut steps).unwrap();
                assert_eq!(ended, steps.iter().filter(|step| step.done()).count());
            } else {
                for &row in &running {
                    steps[row] = envs.step(row, actions.row(row), &mut observations).unwrap();
                }
            }
            for &row in &running {
                assert_eq!(steps[row], singles[row].steps[t]);
            }
            t += 1;
        }
    }
}

#[test]
fn stepping_and_beginning_do_not_allocate() {
    let standard = Registry::standard();
    let mut wrapped = Registry::new();
    for entry in &standard {
        let bare = entry.clone();
        let make = move || Flatten::new(Antialias::new(PreviousAction::new(bare.make()))).unwrap();
        wrapped.register(&entry.name, &[], "wrapped", make).unwrap();
    }
    for registry in [&standard, &wrapped] {
        for entry in registry {
            let (mut envs, mut actions, mut observations, mut steps) = begun(registry, entry.id());
            let mut states = envs.states();
            let action = envs.spec().action.clone();
            let mut policy = stream(0, 0, 0, Purpose::TrainAction);
            let mut episodes = ROWS;
            let before = ALLOCATIONS.get();
            while episodes < 3 * ROWS {
                action.sample_rows(&mut policy, &mut actions);
                envs.step_all(&actions, &mut observations, &mut steps).unwrap();
                for (row, step) in steps.iter().enumerate() {
                    envs.state(row, &mut states);
                    if step.done() {
                        envs.begin(row, env_stream(episodes), &mut observations);
                        episodes += 1;
                    }
                }
            }
            assert_eq!(ALLOCATIONS.get(), before, "{}", entry.id());
        }
    }
    let before = ALLOCATIONS.get();
    drop(std::hint::black_box(vec![0_u8; 100]));
    assert!(ALLOCATIONS.get() > before, "the counter does not count");
}

/// Also where a game writes less than a row, so that it would not notice.
#[test]
fn begin_and_state_demand_slabs_of_the_right_shape() {
    let registry = Registry::standard();
    for entry in &registry {
        let refusal = |use_slab: fn(&mut VecEnv, &mut Slab), slab: Slab| {
            let mut envs = VecEnv::new(&registry, entry.id(), 2).unwrap();
            let mut slab = slab;
            let attempt = std::panic::AssertUnwindSafe(|| use_slab(&mut envs, &mut slab));
            let panic = std::panic::catch_unwind(attempt).expect_err(entry.id());
            assert_eq!(envs.running(), 0, "{}", entry.id());
            panic.downcast_ref::<String>().unwrap().clone()
        };
        let begin = |envs: &mut VecEnv, slab: &mut Slab| envs.begin(0, env_stream(0), slab);
        let state = |envs: &mut VecEnv, slab: &mut Slab| envs.state(0, slab);
        for (space, use_slab, what) in [
            (&entry.spec.observation, begin as fn(&mut VecEnv, &mut Slab), "the observations have"),
            (&entry.spec.state, state, "the states have"),
        ] {
            let wide = Space::Tuple(vec![space.clone(), Space::MultiDiscrete(vec![2; 2])]);
            for slab in [Slab::new(&wide, 2), Slab::new(&Space::Tuple(vec![]), 2), Slab::new(space, 1)] {
                let reason = refusal(use_slab, slab);
                assert!(reason.starts_with(what) && reason.contains(", expected "), "{}: {reason}", entry.id());
            }
        }
        let no_row = refusal(|envs, slab| envs.begin(2, env_stream(0), slab), Slab::new(&entry.spec.observation, 2));
        assert_eq!(no_row, "row 2 of a VecEnv of 2 rows", "{}", entry.id());
    }
}

#[test]
fn an_unknown_name_is_an_error() {
    let error = VecEnv::new(&Registry::standard(), "Nothing", 1).err().unwrap();
    assert!(matches!(error, MakeError::Unknown(unknown) if unknown.name == "Nothing"));
}
