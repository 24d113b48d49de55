"""A learned policy's network as C: loops over constant arrays, in float as it was trained."""

from typing import Any

import numpy

from ..agents.learned_policy import OBSERVATION_LIMIT, LearnedPolicy
from ..compiler.c_source import FLOAT, Parameter, Scalar, array_text, function_text, literal

_LAYER = """/* One linear layer: the sums of all rows side by side, each in its order, so that they vectorise. */
static void {name}_layer(
    const float *restrict x, int inputs, const float *weight, const float *bias, int outputs, float *restrict y) {{
    int i, j;
    for (i = 0; i < outputs; ++i) y[i] = 0.0f;
    for (j = 0; j < inputs; ++j)
        for (i = 0; i < outputs; ++i) y[i] += weight[j * outputs + i] * x[j];
    for (i = 0; i < outputs; ++i) y[i] += bias[i];
}}

"""
_LOGISTIC = """static float {name}_logistic(float x) {{
    return 0.5f * (1.0f + tanhf(0.5f * x));
}}

"""
_GRU = """/* Gated recurrent unit: reset, update, new. */
{name}_layer(x, {inputs}, &{name}_gru_input_weight[0][0], {name}_gru_input_bias, {gates}, a);
{name}_layer(memory, {units}, &{name}_gru_memory_weight[0][0], {name}_gru_memory_bias, {gates}, b);
for (i = 0; i < {units}; ++i) {{
    const float reset = {name}_logistic(a[i] + b[i]);
    const float update = {name}_logistic(a[{units} + i] + b[{units} + i]);
    const float candidate = tanhf(a[{twice} + i] + reset * b[{twice} + i]);
    memory[i] = (1.0f - update) * candidate + update * memory[i];
    x[i] = memory[i];
}}"""
_LSTM = """/* Long short-term memory: admit, keep, new, show; what it shows, then its cells. */
{name}_layer(x, {inputs}, &{name}_lstm_input_weight[0][0], {name}_lstm_input_bias, {gates}, a);
{name}_layer(memory, {units}, &{name}_lstm_memory_weight[0][0], {name}_lstm_memory_bias, {gates}, b);
for (i = 0; i < {units}; ++i) {{
    const float admit = {name}_logistic(a[i] + b[i]);
    const float keep = {name}_logistic(a[{units} + i] + b[{units} + i]);
    const float cell = keep * memory[{units} + i] + admit * tanhf(a[{twice} + i] + b[{twice} + i]);
    const float show = {name}_logistic(a[{thrice} + i] + b[{thrice} + i]);
    memory[i] = show * tanhf(cell);
    memory[{units} + i] = cell;
    x[i] = memory[i];
}}"""


def memory_size(network: LearnedPolicy) -> int:
    """Numbers that a network remembers."""
    arrays = network.arrays
    if "gru_memory_weight" in arrays:
        return int(arrays["gru_memory_weight"].shape[1])
    return 2 * int(arrays["lstm_memory_weight"].shape[1]) if "lstm_memory_weight" in arrays else 0


def network_text(network: LearnedPolicy, name: str, scalar: Scalar) -> tuple[str, int]:
    """Write a network as ``NAME_network(shown, memory, answer)``.

    Args:
        network: to write.
        name: that everything begins with.
        scalar: of what it is shown and answers.

    Returns:
        Its text, and the bytes of its constants.
    """
    arrays = {
        # Of a matrix its columns one after the other.
        key: numpy.ascontiguousarray(values.T)
        if key.rpartition("_")[2].isdigit() or "weight" in key
        else values
        for key, values in network.arrays.items()
    }
    fields = len(arrays["observation_mean"])
    unit = next((kind for kind in ("gru", "lstm") if f"{kind}_memory_weight" in arrays), None)
    width = max([fields, *(values.shape[-1] for key, values in arrays.items() if "weight" in key)])
    body = [f"float x[{width}], a[{width}]{f', b[{width}]' if unit else ''};", "int i;"]
    limit = literal(OBSERVATION_LIMIT, scalar)
    body += [
        f"for (i = 0; i < {fields}; ++i) {{",
        f"    const {scalar.name} z = (shown[i] - ({scalar.name}){name}_observation_mean[i])"
        f" / ({scalar.name}){name}_observation_scale[i];",
        f"    x[i] = (float)(z < -{limit} ? -{limit} : z > {limit} ? {limit} : z);",
        "}",
    ]
    inputs = fields
    if unit is not None:
        units = len(arrays[f"{unit}_memory_weight"])
        words = {
            "name": name, "inputs": inputs, "units": units, "twice": 2 * units, "thrice": 3 * units,
            "gates": (3 if unit == "gru" else 4) * units,
        }  # fmt: skip
        body += (_GRU if unit == "gru" else _LSTM).format(**words).split("\n")
        inputs = units
    for i in range(len(network.layers)):
        outputs = len(arrays[f"bias_{i}"])
        body.append(f"{name}_layer(x, {inputs}, &{name}_weight_{i}[0][0], {name}_bias_{i}, {outputs}, a);")
        between = "tanhf(a[i])" if network.activation is numpy.tanh else "a[i] > 0.0f ? a[i] : 0.0f"
        if i < len(network.layers) - 1:
            body.append(f"for (i = 0; i < {outputs}; ++i) x[i] = {between};")
        inputs = outputs
    body += _answer(network, inputs, scalar)
    parameters = [
        Parameter(f"const {scalar.name} *", "shown"),
        Parameter("float *", "memory"),
        Parameter(f"{scalar.name} *", "answer"),
    ]
    text = [array_text(f"{name}_{key}", values, FLOAT) for key, values in arrays.items()]
    text.append(_LAYER.format(name=name))
    if unit is not None:
        text.append(_LOGISTIC.format(name=name))
    text.append(function_text("static void", f"{name}_network", parameters, body))
    return "\n".join(text), sum(values.size for values in arrays.values()) * 4


def _answer(network: LearnedPolicy, count: int, scalar: Scalar) -> list[str]:
    """Statements that make an action of the last layer."""
    if network.output == "argmax":
        return [
            "{",
            "    int best = 0;",
            f"    for (i = 1; i < {count}; ++i) best = a[i] > a[best] ? i : best;",
            f"    answer[0] = ({scalar.name})best;",
            "}",
        ]
    space: Any = network.model.action_space
    lines = []
    for i, (low, high) in enumerate(zip(space.low.tolist(), space.high.tolist(), strict=True)):
        least, most = literal(low, FLOAT), literal(high, FLOAT)
        if network.output == "clip":
            expression = f"a[{i}] < {least} ? {least} : a[{i}] > {most} ? {most} : a[{i}]"
        else:
            expression = f"{least} + {literal(high - low, FLOAT)} * 0.5f * (1.0f + tanhf(a[{i}]))"
        lines.append(f"answer[{i}] = ({scalar.name})({expression});")
    return lines
