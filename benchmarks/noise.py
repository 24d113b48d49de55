"""What noise by counter costs: nanoseconds a normal number, and microseconds of restarts.

    python benchmarks/noise.py [--lanes 4096]

Times are of the process, the least of several runs. For an older processor set ``FILTERGYM_COMPILER_PROCESSOR``
(``x86-64``, ``haswell,+avx2``).
"""

import argparse
import time
from collections.abc import Callable

import gymnasium
import numpy
from filtergym.compiler.counter_code import bind_numbers
from filtergym.compiler.counter_numbers import numbers
from filtergym.compiler.functions import empty_lanes
from filtergym.envs.engine.episode_noise import draw_identity, identities_of_seeds

import filtergym  # noqa: F401  (registers the environments)

ID = "filtergym/ManeuveringTarget-v0"
RUNS = 9


def nanoseconds(function: Callable[[], object], calls: int) -> float:
    """Process time of a call, the least of several runs."""
    found = []
    for _ in range(RUNS):
        start = time.process_time_ns()
        for _ in range(calls):
            function()
        found.append((time.process_time_ns() - start) / calls)
    return min(found)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lanes", type=int, default=4096, help="episodes side by side, a multiple of eight")
    lanes = parser.parse_args().lanes
    identities, t = identities_of_seeds(range(lanes)).copy(), numpy.zeros(lanes, dtype=numpy.int64)
    generator = numpy.random.default_rng(0)
    for normals in (2, 10):
        rows, count = empty_lanes((normals,), lanes), normals * lanes
        call = bind_numbers(identities, t, rows, normals)
        made = {
            "compiled, by counter": nanoseconds(lambda call=call: call(0, lanes), 100),
            "NumPy, by counter": nanoseconds(lambda n=normals: numbers(identities, t, n, 0), 5),
            "numpy.random.Generator, in order": nanoseconds(
                lambda count=count: generator.standard_normal(count), 20
            ),
        }
        for name, time_of_all in made.items():
            print(f"{normals:3} normals of {lanes} lanes, {name}: {time_of_all / count:.1f} ns a number")
    print(f"identity of an episode: {nanoseconds(lambda: draw_identity(generator), 10_000) / 1e3:.2f} us")

    env = gymnasium.make_vec(ID, num_envs=lanes, control="gain", reward="cost").unwrapped
    env.reset(seed=0)
    for _ in range(2):
        env.step(numpy.zeros((lanes, 1)))
    for some in (1, 8, 64, lanes):
        chosen = sorted(generator.choice(lanes, min(some, lanes), replace=False).tolist())
        taken = nanoseconds(lambda chosen=chosen: env.fleet.restart(chosen), 5 if some == lanes else 50) / 1e3
        print(f"restart of {some} of {lanes} lanes: {taken:.0f} us")
    single = gymnasium.make(ID, control="gain", reward="cost", disable_env_checker=True).unwrapped
    single.reset(seed=0)
    single.step(numpy.zeros(1))
    print(f"reset() of a single environment: {nanoseconds(single.reset, 300) / 1e3:.0f} us")
    print(f"reset(seed=3): {nanoseconds(lambda: single.reset(seed=3), 300) / 1e3:.0f} us")


if __name__ == "__main__":
    main()
