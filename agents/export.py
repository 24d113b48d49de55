"""Export of a training run as a learned policy without torch: the network's arrays and the run's record."""

import shutil
from pathlib import Path

from ..evaluation.storage.files import whole_files, writable_file
from .envelope import training_range
from .learned_policy import load_policy, write_arrays, write_envelope
from .named_policies import load_zipped_model
from .training_run import TrainingRun, best_agent, load_run, save_run
from .validation import TrainingEpisodes

CHECK_EPISODES = 32


def export_run(folder: Path, out: Path, trust: bool = False) -> TrainingRun:
    """Write the best agent of a training run as a file, with its ``run.json`` beside it; return the run.

    Args:
        folder: folder of the run.
        out: file of the agent.
        trust: load a model that has no plain arrays beside it, or import the module that registers the environment;
            both can execute code.

    Raises:
        ValueError: if the folder contains no run, the run cannot be exported or needs ``trust``, or the file cannot be
            written.
    """
    run = load_run(folder, trust)
    if out.suffix != ".safetensors":
        raise ValueError(f"{out} must end in .safetensors, by which an evaluation recognises an agent")
    writable_file(out)
    source = best_agent(folder)
    with whole_files(out.parent) as waiting:
        file = waiting / out.name
        if source.suffix == ".safetensors":
            shutil.copyfile(source, file)
        else:
            from .network_arrays import network_arrays  # imports torch, which plain arrays do not need

            agent = load_zipped_model(run.problem.task, source, run.control, trust)
            arrays, output, activation = network_arrays(agent, run.algorithm)
            write_arrays(file, arrays, run, output, activation)
        seen = training_range(run.problem.task, load_policy(run.problem.task, file))
        if seen is not None:
            write_envelope(file, seen.low, seen.high)
        costs = TrainingEpisodes(run, CHECK_EPISODES).costs(load_policy(run.problem.task, file))
        run.exported = {"episodes": CHECK_EPISODES, "cost": float(costs.mean())}
        save_run(run, file.with_suffix(".json"))
    return run
