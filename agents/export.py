"""From a training run to a learned policy without torch: the network's arrays and the run's record."""

import shutil
from pathlib import Path
from typing import Any

import numpy
import torch

from ..evaluation.evaluate import evaluate
from ..evaluation.files import found_folder, whole_files, writable_file
from .learned_policy import read_header, stored_policy, write_arrays
from .sb3_training import Sb3Policy, load_sb3_policy
from .training_run import TrainingRun, load_run, save_run

CHECK_EPISODES = 32


def _layers(*modules: torch.nn.Module) -> tuple[dict[str, numpy.ndarray], str]:
    """Arrays of the linear layers in order, and the activation between them."""
    parts = [part for module in modules for part in module.modules() if not list(part.children())]
    linear = [part for part in parts if isinstance(part, torch.nn.Linear)]
    between = {type(part) for part in parts} - {torch.nn.Linear, torch.nn.Flatten}
    if not between <= {torch.nn.Tanh, torch.nn.ReLU} or len(between) > 1:
        raise ValueError(f"cannot export a network with {', '.join(sorted(c.__name__ for c in between))}")
    arrays = {}
    for i, layer in enumerate(linear):
        arrays[f"weight_{i}"], arrays[f"bias_{i}"] = (
            layer.weight.detach().numpy(),
            layer.bias.detach().numpy(),
        )
    return arrays, "relu" if torch.nn.ReLU in between else "tanh"


def _lstm(module: torch.nn.LSTM) -> dict[str, numpy.ndarray]:
    """Arrays of a long short-term memory of one layer."""
    names = {
        "weight_ih_l0": "lstm_input_weight", "bias_ih_l0": "lstm_input_bias",
        "weight_hh_l0": "lstm_memory_weight", "bias_hh_l0": "lstm_memory_bias",
    }  # fmt: skip
    parameters = {name: values.detach().numpy() for name, values in module.named_parameters()}
    if parameters.keys() != names.keys():
        raise ValueError(
            f"cannot export {module}: a learned policy holds one layer, with biases and no projection"
        )
    return {names[name]: values for name, values in parameters.items()}


def network_arrays(agent: Sb3Policy, algorithm: str) -> tuple[dict[str, numpy.ndarray], str, str]:
    """Arrays, output and activation of a trained model's deterministic action.

    Raises:
        ValueError: for an algorithm or network that a learned policy cannot hold.
    """
    policy: Any = agent.model.policy
    discrete = not hasattr(agent.action_space, "low")
    if algorithm in ("ppo", "recurrent-ppo"):
        arrays, activation = _layers(policy.mlp_extractor.policy_net, policy.action_net)
        output = "argmax" if discrete else "clip"
        if algorithm == "recurrent-ppo":
            arrays |= _lstm(policy.lstm_actor)
    elif algorithm == "sac":
        arrays, activation = _layers(policy.actor.latent_pi, policy.actor.mu)
        output = "tanh"
    else:  # dqn
        arrays, activation = _layers(policy.q_net.q_net)
        output = "argmax"
    fields: Any = agent.observation_space.shape
    mean, scale = numpy.zeros(fields), numpy.ones(fields)
    if agent.normalisation is not None:
        statistics: Any = agent.normalisation.obs_rms
        mean, scale = statistics.mean, numpy.sqrt(statistics.var + agent.normalisation.epsilon)
    return {"observation_mean": mean, "observation_scale": scale, **arrays}, output, activation


def export_run(folder: Path, out: Path) -> TrainingRun:
    """Write the best agent of a run as ``out``, with its ``run.json`` beside it under the same name.

    Raises:
        ValueError: if the folder holds no run, or none that can be exported, or the file cannot be written.
    """
    run = load_run(folder)
    if out.suffix != ".safetensors":
        raise ValueError(f"{out} must end in .safetensors, by which an evaluation knows what it is")
    writable_file(out)
    best = found_folder(folder / "best")
    with whole_files(out.parent) as waiting:
        file = waiting / out.name
        if run.algorithm == "bptt":
            source = best / "agent.safetensors"
            read_header(source)
            shutil.copyfile(source, file)
        else:
            agent = load_sb3_policy(best / "model.zip", run.algorithm)
            arrays, output, activation = network_arrays(agent, run.algorithm)
            write_arrays(file, arrays, run, output, activation)
        dataset = evaluate(
            run.environment,
            {"exported": stored_policy(run.environment, file)},
            run.scenario,
            CHECK_EPISODES,
            split="validation",
        )
        run.exported = {"episodes": CHECK_EPISODES, "cost": float(dataset["cost"].mean())}
        save_run(run, file.with_suffix(".json"))
    return run
