"""Many processes against one: equality of records, time and memory.

``python benchmarks/parallel.py`` prints the results in docs/many_cores.md; ``--cluster`` kills a worker and then a node
of a cluster of Ray, ``--memory N`` evaluates N episodes with ten competitors.
"""

import argparse
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

COMPETITORS = (
    "imm", "adaptive", "adaptive-rearm", "fixed-best", "imm-tuned", "kalman-imm", "bptt", "ppo", "known-turn",
    "known-input-bound",
)  # fmt: skip


def process_tree(root: int) -> list[int]:
    """Return the process ids of a process and all its descendants, from /proc."""
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:  # it has ended
            continue
    found = [root]
    for process in found:
        found += [child for child, parent in parents.items() if parent == process]
    return found


def resident_memory(processes: list[int]) -> float:
    """Return the memory of processes together, GiB, with shared memory counted once."""
    total = 0
    for process in processes:
        try:
            lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
            total += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
        except OSError:
            continue
    return total / 2**20


def run_filtergym(*words: str) -> tuple[float, float, float]:
    """Run a ``filtergym`` command; return its seconds, processor seconds, and peak memory of its processes, GiB."""
    began, most = time.monotonic(), 0.0
    command = [sys.executable, "-m", "filtergym", *words]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while process.poll() is None:
        most = max(most, resident_memory(process_tree(process.pid)))
        time.sleep(0.5)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with {process.returncode}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.monotonic() - began, used, most


def results(folder: Path) -> str:
    """Return the results of a benchmark as text, without its command, which differs between the runs."""
    return (folder / "results.json").read_text(encoding="utf-8").partition("\n")[2]


def speed(words: list[str], jobs: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        one, many = Path(folder) / "one", Path(folder) / "many"
        found = {}
        for out, further in ((one, ()), (many, ("--jobs", str(jobs)))):
            found[out] = run_filtergym("benchmark", *words, "--out", str(out), *further)
            seconds, used, _ = found[out]
            print(
                f"{' '.join(['benchmark', *words, *further])}: {seconds:.0f} s, {used:.0f} s of processors",
                flush=True,
            )
        same = results(one) == results(many)
        print(f"records, curves and tracks bit for bit: {'the same' if same else 'DIFFERENT'}")
        print(f"speed-up with {jobs} processes: {found[one][0] / found[many][0]:.2f}")
        print(f"most memory of all processes together: {found[one][2]:.2f} and {found[many][2]:.2f} GiB")
        assert same


def memory(episodes: int, jobs: int) -> None:
    words = ["evaluate", "ManeuveringTarget", "--episodes", str(episodes), "--jobs", str(jobs)]
    for name in COMPETITORS:
        words += ["--policy", name]
    with tempfile.TemporaryDirectory() as folder:
        seconds, _, largest = run_filtergym(*words, "--out", folder)
    print(f"{episodes} episodes, {len(COMPETITORS)} competitors, {jobs} processes: {seconds:.0f} s, "
          f"most memory of all together {largest:.2f} GiB")  # fmt: skip


def command_of(process: int) -> str:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes().decode(errors="replace")
    except OSError:
        return ""


def kill_nodes(words: list[str]) -> None:
    """Evaluate on a cluster of two nodes, and kill a worker, then a node; print whether the records are the same."""
    import ray
    from ray.cluster_utils import Cluster

    from filtergym.evaluation.running.parallel import Workers
    from filtergym.evaluation.running.rollout import Progress
    from filtergym.reports.tables.benchmark import BenchmarkOptions, Callbacks, run_benchmark

    options = BenchmarkOptions(environments=words or ["filtergym/ManeuveringTarget-v0"])
    with tempfile.TemporaryDirectory() as folder:
        run_benchmark(Path(folder) / "one", options)
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
        lost = cluster.add_node(num_cpus=1)
        ray.init(cluster.address, log_to_driver=False, logging_level="error")
        done = 0.0

        def started(total: int) -> Progress:
            def tick(measurements: int) -> None:
                nonlocal done
                before, done = done / total, done + measurements
                if before < 0.2 <= done / total:
                    own = [id for id in process_tree(os.getpid()) if "ray::_run_piece" in command_of(id)]
                    os.kill(own[0], signal.SIGKILL)
                    print("killed a worker", flush=True)
                if before < 0.5 <= done / total:
                    cluster.remove_node(lost, allow_graceful=False)
                    print("killed a node", flush=True)

            return tick

        with Workers(cluster="ray") as workers:
            run_benchmark(Path(folder) / "many", options, Callbacks(started), workers)
        ray.shutdown()
        cluster.shutdown()
        same = results(Path(folder) / "one") == results(Path(folder) / "many")
        print(f"after both, records bit for bit: {'the same' if same else 'DIFFERENT'}")
        assert same


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--memory", type=int, default=0, metavar="N")
    parser.add_argument("--cluster", action="store_true")
    parser.add_argument(
        "words", nargs="*", help="of filtergym benchmark, after --; environments with --cluster"
    )
    asked = parser.parse_args()
    if asked.memory:
        memory(asked.memory, asked.jobs)
    elif asked.cluster:
        kill_nodes(asked.words)
    else:
        speed(asked.words or ["--full"], asked.jobs)


if __name__ == "__main__":
    main()
