"""What agents see and are paid: the range of every field of the observation and of the reward.

Learning code expects numbers of about one. Actions are those of the paper's algorithm (where the control has it, else
zero) and uniformly random ones.

    python benchmarks/ranges.py --steps 100000
"""

import argparse
import math
from collections.abc import Iterator

import gymnasium
import numpy
from filtergym.envs.engine.catalogue import task_class

PARALLEL = 100


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--steps", type=int, default=100_000, help="decisions in each environment and control"
    )
    parser.add_argument("--environment", action="append", help="id; default: all")
    parser.add_argument("--control", action="append", help="default: the environment's first")
    parser.add_argument("--scenario", help="default: the environment's own")
    parser.add_argument("--fields", action="store_true", help="a row for each field, not only the widest")
    return parser.parse_args()


def actions(
    env: gymnasium.vector.VectorEnv, kind: str, generator: numpy.random.Generator
) -> Iterator[numpy.ndarray]:
    space, model = env.unwrapped.single_action_space, env.unwrapped.model
    discrete = isinstance(space, gymnasium.spaces.Discrete)
    paper = model.task.paper_policy
    own = model.control == paper.control
    while True:
        if kind == "random":
            if discrete:
                yield generator.integers(space.n, size=env.num_envs)
            else:
                yield generator.uniform(space.low, space.high, (env.num_envs, *space.shape)).astype(
                    space.dtype
                )
        elif discrete:
            yield numpy.zeros(env.num_envs, dtype=int)
        else:
            action = numpy.asarray(paper.action if own else [0.0] * space.shape[0], dtype=space.dtype)
            yield numpy.broadcast_to(action, (env.num_envs, *space.shape))


def main() -> None:
    chosen = arguments()
    for id in chosen.environment or sorted(i for i in gymnasium.registry if i.startswith("filtergym/")):
        for control in chosen.control or [task_class(id).controls[0]]:
            show(id, control, chosen)


def show(id: str, control: str, chosen: argparse.Namespace) -> None:
    print(f"\n{id}, {control}")
    rows = {}
    keywords = {} if chosen.scenario is None else {"scenario": chosen.scenario}
    for kind in ("paper", "random"):
        env = gymnasium.make_vec(id, num_envs=PARALLEL, control=control, **keywords)
        observation, _ = env.reset(seed=0)
        names = [field.name for field in env.unwrapped.observation_fields]
        low, high = observation.min(axis=0), observation.max(axis=0)
        seen, rewards = [observation], []
        source = actions(env, kind, numpy.random.default_rng(0))
        for _ in range(math.ceil(chosen.steps / PARALLEL)):
            observation, reward, *_ = env.step(next(source))
            seen.append(observation)
            rewards.append(reward)
        seen, rewards = numpy.concatenate(seen), numpy.concatenate(rewards)
        low, high = seen.min(axis=0), seen.max(axis=0)
        rows[kind] = low, high, seen.mean(axis=0), seen.std(axis=0)
        print(
            f"  reward, {kind:6}: mean {rewards.mean():9.3f}, sd {rewards.std():9.3f}, "
            f"median {numpy.median(rewards):8.3f}, least {rewards.min():10.2f}, most {rewards.max():7.3f}"
        )
        widest = int(numpy.abs(seen).max(axis=0).argmax())
        still = [n for n, d in zip(names, high - low, strict=True) if d == 0.0]
        print(
            f"  widest,  {kind:6}: {names[widest]} {low[widest]:.2f} to {high[widest]:.2f}; "
            f"{len(still)} of {len(names)} fields never move: {', '.join(still)}"
        )
    for i, name in enumerate(names):
        shown = {k: (v[0][i], v[1][i], v[3][i]) for k, v in rows.items()}
        if chosen.fields or any(max(-a, b) > w for (a, b, _), w in zip(shown.values(), (5, 10), strict=True)):
            ranges = "".join(f"  {k} {a:7.2f} to {b:7.2f} (sd {d:5.2f})" for k, (a, b, d) in shown.items())
            print(f"    {name:40}{ranges}")


if __name__ == "__main__":
    main()
