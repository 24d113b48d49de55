"""A learned policy's network as C: loops over constant arrays of float, the type of its training."""

from typing import TYPE_CHECKING, Any

import numpy

from ..compiler.c_text import FLOAT, Parameter, Scalar, array_text, function_text, literal

if TYPE_CHECKING:
    from ..agents.learned_policy import LearnedPolicy

_LAYER = """/* One linear layer: the sums of all rows side by side, each in its order, so that they vectorise. */
static void {name}_layer(
    const {real} *restrict x, int inputs, const float *weight, const float *bias, int outputs, {real} *restrict y) {{
    int i, j;
    for (i = 0; i < outputs; ++i) y[i] = {zero};
    for (j = 0; j < inputs; ++j)
        for (i = 0; i < outputs; ++i) y[i] += ({real})weight[j * outputs + i] * x[j];
    for (i = 0; i < outputs; ++i) y[i] += ({real})bias[i];
}}

"""
_LOGISTIC = """static {real} {name}_logistic({real} x) {{
    return {half} * ({one} + tanh{f}({half} * x));
}}

"""
_GRU = """/* Gated recurrent unit: reset, update, new. */
{name}_layer(x, {inputs}, &{name}_gru_input_weight[0][0], {name}_gru_input_bias, {gates}, a);
{name}_layer(memory, {units}, &{name}_gru_memory_weight[0][0], {name}_gru_memory_bias, {gates}, b);
for (i = 0; i < {units}; ++i) {{
    const {real} reset = {name}_logistic(a[i] + b[i]);
    const {real} update = {name}_logistic(a[{units} + i] + b[{units} + i]);
    const {real} candidate = tanh{f}(a[{twice} + i] + reset * b[{twice} + i]);
    memory[i] = ({one} - update) * candidate + update * memory[i];
    x[i] = memory[i];
}}"""
_LSTM = """/* Long short-term memory: gates admit (input), keep (forget), show (output); its output, then its cells. */
{name}_layer(x, {inputs}, &{name}_lstm_input_weight[0][0], {name}_lstm_input_bias, {gates}, a);
{name}_layer(memory, {units}, &{name}_lstm_memory_weight[0][0], {name}_lstm_memory_bias, {gates}, b);
for (i = 0; i < {units}; ++i) {{
    const {real} admit = {name}_logistic(a[i] + b[i]);
    const {real} keep = {name}_logistic(a[{units} + i] + b[{units} + i]);
    const {real} cell = keep * memory[{units} + i] + admit * tanh{f}(a[{twice} + i] + b[{twice} + i]);
    const {real} show = {name}_logistic(a[{thrice} + i] + b[{thrice} + i]);
    memory[i] = show * tanh{f}(cell);
    memory[{units} + i] = cell;
    x[i] = memory[i];
}}"""


def memory_size(network: "LearnedPolicy") -> int:
    """Return the number of values in the memory of a network; 0 without recurrence."""
    arrays = network.arrays
    if "gru_memory_weight" in arrays:
        return int(arrays["gru_memory_weight"].shape[1])
    return 2 * int(arrays["lstm_memory_weight"].shape[1]) if "lstm_memory_weight" in arrays else 0


def network_operations(network: "LearnedPolicy") -> int:
    """Return the number of multiplications and additions of a network, without its activations."""
    sizes = {key: int(values.size) for key, values in network.arrays.items()}
    return sum(2 * size for key, size in sizes.items() if "weight" in key) + sum(
        size for key, size in sizes.items() if "bias" in key
    )


def scratch_size(network: "LearnedPolicy") -> int:
    """Return the number of values that a network's C code needs on the stack."""
    return _width(network) * (3 if memory_size(network) else 2)


def _width(network: "LearnedPolicy") -> int:
    outputs = [len(values) for key, values in network.arrays.items() if "weight" in key]
    return max([len(network.arrays["observation_mean"]), *outputs])


def network_text(network: "LearnedPolicy", name: str, scalar: Scalar) -> tuple[str, int]:
    """Return the C function ``NAME_network(shown, memory, answer)`` of a network, and the bytes of its constants."""
    arrays = {
        # Of a matrix its columns one after the other.
        key: numpy.ascontiguousarray(values.T)
        if key.rpartition("_")[2].isdigit() or "weight" in key
        else values
        for key, values in network.arrays.items()
    }
    fields = len(arrays["observation_mean"])
    unit = next((kind for kind in ("gru", "lstm") if f"{kind}_memory_weight" in arrays), None)
    width = _width(network)
    words: dict[str, Any] = {"name": name, "real": scalar.name, "f": scalar.suffix}
    words |= {key: literal(value, scalar) for key, value in (("zero", 0.0), ("half", 0.5), ("one", 1.0))}
    body = [f"{scalar.name} x[{width}], a[{width}]{f', b[{width}]' if unit else ''};", "int i;"]
    limit = literal(network.observation_limit, scalar)
    body += [
        f"for (i = 0; i < {fields}; ++i) {{",
        f"    const {scalar.name} z = (shown[i] - ({scalar.name}){name}_observation_mean[i])"
        f" / ({scalar.name}){name}_observation_scale[i];",
        f"    x[i] = z < -{limit} ? -{limit} : z > {limit} ? {limit} : z;",
        "}",
    ]
    inputs = fields
    if unit is not None:
        units = len(arrays[f"{unit}_memory_weight"])
        words |= {"inputs": inputs, "units": units, "twice": 2 * units, "thrice": 3 * units}
        words["gates"] = (3 if unit == "gru" else 4) * units
        body += (_GRU if unit == "gru" else _LSTM).format(**words).split("\n")
        inputs = units
    for i in range(len(network.layers)):
        outputs = len(arrays[f"bias_{i}"])
        body.append(f"{name}_layer(x, {inputs}, &{name}_weight_{i}[0][0], {name}_bias_{i}, {outputs}, a);")
        zero = words["zero"]
        smooth = network.activation is numpy.tanh
        between = f"tanh{scalar.suffix}(a[i])" if smooth else f"a[i] > {zero} ? a[i] : {zero}"
        if i < len(network.layers) - 1:
            body.append(f"for (i = 0; i < {outputs}; ++i) x[i] = {between};")
        inputs = outputs
    body += _answer(network, inputs, scalar)
    parameters = [
        Parameter(f"const {scalar.name} *", "shown"),
        Parameter(f"{scalar.name} *", "memory"),
        Parameter(f"{scalar.name} *", "answer"),
    ]
    text = [array_text(f"{name}_{key}", values, FLOAT) for key, values in arrays.items()]
    text.append(_LAYER.format(**words))
    if unit is not None:
        text.append(_LOGISTIC.format(**words))
    text.append(function_text("static void", f"{name}_network", parameters, body))
    return "\n".join(text), sum(values.size for values in arrays.values()) * 4


def _answer(network: "LearnedPolicy", count: int, scalar: Scalar) -> list[str]:
    """Return the C statements that convert the last layer's outputs to ``count`` action values."""
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
        least, most = literal(low, scalar), literal(high, scalar)
        if network.output == "clip":
            expression = f"a[{i}] < {least} ? {least} : a[{i}] > {most} ? {most} : a[{i}]"
        else:
            half, one = literal(0.5, scalar), literal(1.0, scalar)
            width = literal(high - low, scalar)
            expression = f"{least} + {width} * {half} * ({one} + tanh{scalar.suffix}(a[{i}]))"
        lines.append(f"answer[{i}] = {expression};")
    return lines
