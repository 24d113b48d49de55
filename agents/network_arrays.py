"""Conversion of a trained model of Stable-Baselines3 to the arrays of a learned policy."""

from typing import Any

import numpy
import torch


def _layers(*modules: torch.nn.Module) -> tuple[dict[str, numpy.ndarray], str]:
    """Return weights and biases of the linear layers in torch modules, by name, and the activation between them."""
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
    names = {
        "weight_ih_l0": "lstm_input_weight", "bias_ih_l0": "lstm_input_bias",
        "weight_hh_l0": "lstm_memory_weight", "bias_hh_l0": "lstm_memory_bias",
    }  # fmt: skip
    parameters = {name: values.detach().numpy() for name, values in module.named_parameters()}
    if parameters.keys() != names.keys():
        raise ValueError(
            f"cannot export {module}: a learned policy has one layer, with biases and without projection"
        )
    return {names[name]: values for name, values in parameters.items()}


def network_arrays(agent: Any, algorithm: str) -> tuple[dict[str, numpy.ndarray], str, str]:
    """Return a trained model's network as float32 arrays by name, its output map and its activation.

    Raises:
        ValueError: for an algorithm or network that a learned policy cannot represent.
    """
    policy: Any = agent.model.policy
    discrete = not hasattr(agent.action_space, "low")
    if algorithm in ("ppo", "recurrent-ppo", "rl-ukf"):
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
    found = {"observation_mean": mean, "observation_scale": scale, **arrays}
    return {name: a.astype(numpy.float32) for name, a in found.items()}, output, activation
