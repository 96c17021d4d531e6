"""Steps a second of the Python package popgym 1.0.7, one process, as CSV on standard output.

Uniformly random actions are drawn in the loop, and resets are included: what `cargo bench -p popgym-envs` measures of
the Rust environments. Median of five measurements of half a second each.

    python3 -m venv venv && venv/bin/pip install "popgym[navigation]==1.0.7"
    venv/bin/python package_speed.py [PART_OF_AN_ID ...] > package.csv
"""

import statistics
import sys
import time
import warnings

warnings.filterwarnings("ignore")

import gymnasium
import popgym  # noqa: F401  (registers its environments)


def steps_per_second(env, seconds=0.5):
    sample, step, reset = env.action_space.sample, env.step, env.reset
    reset()
    steps, start = 0, time.perf_counter()
    while (passed := time.perf_counter() - start) < seconds:
        for _ in range(64):
            _, _, terminated, truncated, _ = step(sample())
            if terminated or truncated:
                reset()
        steps += 64
    return steps / passed


def main(parts):
    ids = [id for id in gymnasium.registry if id.startswith("popgym-")]
    print("id,package_fps")
    for id in ids:
        if parts and not any(part in id for part in parts):
            continue
        env = gymnasium.make(id, disable_env_checker=True).unwrapped
        rate = statistics.median(steps_per_second(env) for _ in range(5))
        print(f"{id},{rate:.0f}", flush=True)


main(sys.argv[1:])
