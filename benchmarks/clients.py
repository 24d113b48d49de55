"""Steps per second of the environments in libraries for reinforcement learning.

    python benchmarks/clients.py --install [NAME ...]   # the clients that are not in this Python's environment
    python benchmarks/clients.py [--client NAME ...] [--environment ID ...]
    python benchmarks/clients.py --recipes              # output of the recipes of docs/recipes.md

**Installing.** Each client gets a virtual environment ``build/clients/NAME`` with access to the packages of this one,
and with the versions of ``docs/recipes/NAME.txt``: so torch is not downloaded again, and the pins of clients do not
conflict. A client that is not installed there is imported from this environment.

**Timing.** Random actions (with Stable-Baselines3's family: PPO or TQC at the start of learning) through the client's
own rollouts of default environments, for about a second after a warm-up; in a process for each client and environment,
with one thread. ``native``: the vector environment of filtergym; otherwise single ones, side by side where supported.
"""

import argparse
import functools
import importlib.metadata
import importlib.util
import json
import os
import re
import subprocess
import sys
import sysconfig
import tempfile
import time
import venv
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy loads its BLAS

ROOT = Path(__file__).resolve().parent.parent
RECIPES = ROOT / "docs" / "recipes"
ENVIRONMENTS = ROOT / "build" / "clients"
LIMIT = 120
"""Seconds that a client may take in one environment."""
SINGLE, NATIVE = 16, 256
"""Environments side by side: single ones, and in a native vector environment."""
PORTION = 20
"""Steps of each of them in a portion."""
RESULT = "result: "

Portion = Callable[[], int]
"""Function that steps the environments through a client and returns the number of steps."""


def gymnasium_single(id: str) -> Portion:
    import gymnasium

    return random_steps(gymnasium.vector.SyncVectorEnv([lambda: gymnasium.make(id)] * SINGLE))


def gymnasium_native(id: str) -> Portion:
    import gymnasium

    return random_steps(gymnasium.make_vec(id, num_envs=NATIVE))


def random_steps(env: Any) -> Portion:
    env.reset(seed=0)
    env.action_space.seed(0)

    def portion() -> int:
        for _ in range(PORTION):
            env.step(env.action_space.sample())
        return PORTION * env.num_envs

    return portion


def make_training_portion(model: Any) -> Portion:
    def portion() -> int:
        model.learn(PORTION * model.n_envs)
        return model.num_timesteps

    return portion


def sb3_single(id: str) -> Portion:
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    env = make_vec_env(id, SINGLE)
    return make_training_portion(
        PPO("MlpPolicy", env, n_steps=PORTION, batch_size=PORTION * SINGLE, n_epochs=1)
    )


def sb3_native(id: str) -> Portion:
    import gymnasium
    from stable_baselines3 import PPO

    from filtergym.agents import to_sb3

    env = to_sb3(gymnasium.make_vec(id, num_envs=NATIVE, autoreset_mode="SameStep"))
    return make_training_portion(
        PPO("MlpPolicy", env, n_steps=PORTION, batch_size=PORTION * NATIVE, n_epochs=1)
    )


def sb3_contrib_single(id: str) -> Portion:
    from sb3_contrib import TQC
    from stable_baselines3.common.env_util import make_vec_env

    return make_training_portion(
        TQC("MlpPolicy", make_vec_env(id, SINGLE), learning_starts=10**9, buffer_size=10**4)
    )


def rl_zoo3_single(id: str) -> Portion:
    from rl_zoo3 import train

    def portion() -> int:
        steps = 2 * PORTION * SINGLE
        with tempfile.TemporaryDirectory() as folder:
            parameters = f"n_envs:{SINGLE} n_steps:{PORTION} batch_size:{PORTION * SINGLE} n_epochs:1"
            sys.argv = [
                *f"train --algo ppo --env {id} --gym-packages filtergym --verbose 0 --eval-freq -1".split(),
                *f"-n {steps} --log-folder {folder} --conf-file {ROOT}/agents/hyperparameters/ppo.yml".split(),
                "--hyperparams",
                *parameters.split(),
            ]
            train.train()
        return steps

    return portion


def rllib(id: str, count: int, mode: str) -> Portion:
    import ray
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner

    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    config = PPOConfig().environment(f"filtergym:{id}")
    runner = SingleAgentEnvRunner(
        config=config.env_runners(
            num_env_runners=0, num_envs_per_env_runner=count, gym_env_vectorize_mode=mode
        )
    )
    steps = PORTION * count
    return lambda: sum(len(part) for part in runner.sample(num_timesteps=steps, random_actions=True))


def torchrl_single(id: str) -> Portion:
    from torchrl.envs import GymEnv

    env = GymEnv(id)
    return lambda: env.rollout(PORTION * SINGLE, break_when_any_done=False).numel()


def torchrl_native(id: str) -> Portion:
    import gymnasium
    from torchrl.envs import GymWrapper

    env = GymWrapper(gymnasium.make_vec(id, num_envs=NATIVE, autoreset_mode="Disabled"))
    return lambda: env.rollout(PORTION, break_when_any_done=False).numel()


def tianshou_single(id: str) -> Portion:
    import gymnasium
    import torch
    from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
    from tianshou.data import Collector, VectorReplayBuffer
    from tianshou.env import DummyVectorEnv

    envs = DummyVectorEnv([lambda: gymnasium.make(id)] * SINGLE)
    policy = ProbabilisticActorPolicy(
        actor=torch.nn.Identity(),  # type: ignore[arg-type]  # never called
        dist_fn=torch.distributions.Normal,
        action_space=envs.action_space[0],
    )
    collector = Collector(policy, envs, VectorReplayBuffer(PORTION * SINGLE, SINGLE))
    collector.reset()
    return lambda: collector.collect(n_step=PORTION * SINGLE, random=True).n_collected_steps


def skrl(id: str, native: bool) -> Portion:
    import gymnasium
    import torch
    from skrl.envs.wrappers.torch import wrap_env

    env = wrap_env(gymnasium.make_vec(id, num_envs=NATIVE) if native else gymnasium.make(id))
    env.reset()
    shape, count = env.action_space.shape, NATIVE if native else SINGLE

    def portion() -> int:
        for _ in range(PORTION * count // env.num_envs):
            *_, terminated, truncated, _ = env.step(2 * torch.rand(env.num_envs, *shape) - 1)
            if not native and (terminated | truncated).any():
                env.reset()
        return PORTION * count

    return portion


def minari_single(id: str) -> Portion:
    import gymnasium

    with tempfile.TemporaryDirectory() as folder:
        os.environ["MINARI_DATASETS_PATH"] = folder
    import minari

    names = iter(range(10**9))

    def portion() -> int:
        env = minari.DataCollector(gymnasium.make(id))
        for _ in range(2):
            env.reset()
            finished = False
            while not finished:
                _, _, _, finished, _ = env.step(env.action_space.sample())
        name = f"filtergym/recorded-v{next(names)}"
        env.create_dataset(name, algorithm_name="random", eval_env=id)
        dataset = minari.load_dataset(name)
        steps = sum(len(episode.rewards) for episode in dataset.iterate_episodes())
        minari.delete_dataset(name)
        return steps

    return portion


def d3rlpy_single(id: str) -> Portion:
    import d3rlpy
    import gymnasium

    env, policy = gymnasium.make(id), d3rlpy.algos.RandomPolicyConfig().create()
    steps = PORTION * SINGLE

    def portion() -> int:
        policy.collect(env, n_steps=steps, show_progress=False)
        return steps

    return portion


CLIENTS: dict[str, tuple[str, str, Callable[[str], Portion]]] = {
    "Gymnasium": ("gymnasium", "gymnasium", gymnasium_single),
    "Gymnasium, native": ("gymnasium", "gymnasium", gymnasium_native),
    "Stable-Baselines3": ("stable_baselines3", "stable-baselines3", sb3_single),
    "Stable-Baselines3, native": ("stable_baselines3", "stable-baselines3", sb3_native),
    "sb3-contrib": ("sb3_contrib", "sb3-contrib", sb3_contrib_single),
    "rl-zoo3": ("rl_zoo3", "rl-zoo3", rl_zoo3_single),
    "RLlib": ("rllib", "ray", functools.partial(rllib, count=SINGLE, mode="sync")),
    "RLlib, native": ("rllib", "ray", functools.partial(rllib, count=NATIVE, mode="vector_entry_point")),
    "TorchRL": ("torchrl", "torchrl", torchrl_single),
    "TorchRL, native": ("torchrl", "torchrl", torchrl_native),
    "Tianshou": ("tianshou", "tianshou", tianshou_single),
    "skrl": ("skrl", "skrl", functools.partial(skrl, native=False)),
    "skrl, native": ("skrl", "skrl", functools.partial(skrl, native=True)),
    "Minari": ("minari", "minari", minari_single),
    "d3rlpy": ("d3rlpy", "d3rlpy", d3rlpy_single),
}
"""Name in the table: name of its virtual environment, of its distribution, and its rollouts."""


def install(name: str) -> None:
    folder = ENVIRONMENTS / name
    print(f"installing {name} into {folder.relative_to(ROOT)}", flush=True)
    venv.create(folder)  # without pip: this environment's serves both
    packages = next(folder.glob("lib/python*/site-packages"))
    # Read at every start: this environment's packages follow the new one's own, also those installed editably.
    beneath = sysconfig.get_path("purelib")
    (packages / "beneath.pth").write_text(f"import site; site.addsitedir({beneath!r})\n", encoding="utf-8")
    # The versions are complete: without --no-deps pip would reject versions of this environment for the client's pins.
    pip = [sys.executable, "-m", "pip", "--python", python_of(name), "--disable-pip-version-check"]
    versions = RECIPES / f"{name}.txt"
    subprocess.run([*pip, "install", "--quiet", "--no-deps", "--requirement", str(versions)], check=True)


def python_of(name: str) -> str:
    own = ENVIRONMENTS / name / "bin" / "python"
    return str(own) if own.exists() else sys.executable


def measure(client: str, id: str) -> dict[str, Any]:
    _, distribution, rollouts = CLIENTS[client]
    try:
        version = importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return {"failed": "not installed"}
    import filtergym  # noqa: F401

    try:
        portion = rollouts(id)
        portion()
        steps, start = 0, time.perf_counter()
        while (seconds := time.perf_counter() - start) < 1.0:
            steps += portion()
    except Exception as error:  # any failure of a client
        words = str(error).strip().splitlines()
        return {"version": version, "failed": f"{type(error).__name__}: {words[0] if words else ''}"}
    return {"version": version, "rate": steps / seconds}


def measure_in_client(client: str, id: str) -> dict[str, Any]:
    command = [python_of(CLIENTS[client][0]), __file__, "--measure", client, "--environment", id]
    try:
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=LIMIT, cwd=ROOT)
    except subprocess.TimeoutExpired:
        return {"failed": f"more than {LIMIT} s"}
    for line in done.stdout.splitlines():
        if line.startswith(RESULT):
            return json.loads(line.removeprefix(RESULT))
    lines = done.stderr.strip().splitlines()
    return {"failed": lines[-1] if lines else f"exit status {done.returncode}"}


def table(clients: list[str], ids: list[str]) -> None:
    names = [id.partition("/")[2].rpartition("-v")[0] for id in ids]
    print("| steps/s | version |", " | ".join(names), "|")
    print("|---|---|" + "---|" * len(ids))
    notes: list[str] = []
    for client in clients:
        found = [measure_in_client(client, id) for id in ids]
        cells = []
        for result in found:
            if "rate" in result:
                cells.append(f"{result['rate']:,.0f}")
                continue
            if result["failed"] not in notes:
                notes.append(result["failed"])
            cells.append(f"fails ({notes.index(result['failed']) + 1})")
        version = next((result["version"] for result in found if "version" in result), "-")
        print(f"| {client} | {version} |", " | ".join(cells), "|", flush=True)
    for number, note in enumerate(notes, 1):
        print(f"\n({number}) {note}")


def recipes() -> None:
    print("| recipe | seconds | prints |\n|---|---|---|")
    for file in sorted(RECIPES.glob("with_*")):
        python = python_of(file.stem.removeprefix("with_"))
        start = time.perf_counter()
        command = [python] if file.suffix == ".py" else ["sh"]
        path = f"{Path(python).parent}{os.pathsep}{os.environ['PATH']}"
        try:
            done = subprocess.run(
                [*command, str(file)],
                check=False,
                capture_output=True,
                text=True,
                timeout=LIMIT,
                cwd=ROOT,
                env={**os.environ, "PATH": path},
            )
            lines = [
                line for line in (done.stdout if done.returncode == 0 else done.stderr).splitlines() if line
            ]
            shown = next(
                (line for line in lines if re.match("cost against", line)), lines[-1] if lines else "nothing"
            )
        except subprocess.TimeoutExpired:
            shown = f"more than {LIMIT} s"
        print(f"| `{file.name}` | {time.perf_counter() - start:.0f} | {shown} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    installable = sorted(file.stem for file in RECIPES.glob("*.txt"))
    parser.add_argument(
        "--install", nargs="*", choices=installable, metavar="NAME", help=", ".join(installable)
    )
    parser.add_argument("--client", nargs="+", choices=CLIENTS, default=list(CLIENTS), metavar="NAME")
    parser.add_argument("--environment", nargs="+", metavar="ID")
    parser.add_argument("--recipes", action="store_true")
    parser.add_argument("--measure", choices=CLIENTS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.install is not None:
        for name in arguments.install or installable:
            install(name)
    elif arguments.measure:
        print(RESULT + json.dumps(measure(arguments.measure, arguments.environment[0])))
    elif arguments.recipes:
        recipes()
    else:
        from filtergym.envs.engine.catalogue import catalogue

        table(arguments.client, arguments.environment or list(catalogue()))


if __name__ == "__main__":
    main()
