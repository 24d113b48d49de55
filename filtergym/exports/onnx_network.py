"""The network of an agent as an ONNX graph: observation and memory in, action and memory out.

The graph is that of :class:`~filtergym.agents.learned_policy.LearnedPolicy` in primitive operators and float32:
normalisation, recurrent unit, layers, and the conversion to an action. The observation is that of the environment's
filter, which is not in the graph.
"""

import json
from pathlib import Path
from typing import Any

import numpy

from ..agents.learned_estimator import EstimatorMaker
from ..agents.learned_policy import OBSERVATION_LIMIT, StoredPolicy
from ..envs.contract.companions import action_meanings
from ..envs.contract.model import Model
from ..envs.engine.backend import make_model
from ..evaluation.storage.files import whole_file
from .request import ExportRequest

OPSET, IR_VERSION = 17, 8
"""Versions of 2022, which runtimes since then read."""
BATCH = "N"
"""Name of the axis of observations side by side."""


class _Graph:
    """Nodes and constants of an ONNX graph under construction; ``onnx`` is the package."""

    def __init__(self, onnx: Any) -> None:
        self.onnx = onnx
        self.nodes: list[Any] = []
        self.constants: dict[str, Any] = {}

    def constant(self, name: str, values: Any, dtype: Any = numpy.float32) -> str:
        """Add an array to the graph as a constant, once for each name; return its name."""
        array = numpy.ascontiguousarray(values, dtype=dtype)
        self.constants.setdefault(name, self.onnx.numpy_helper.from_array(array, name))
        return name

    def node(self, operator: str, inputs: list[str], *outputs: str, **attributes: Any) -> str:
        """Add an operation to the graph; return the name of its first output."""
        names = list(outputs) or [f"{operator.lower()}_{len(self.nodes)}"]
        self.nodes.append(self.onnx.helper.make_node(operator, inputs, names, names[0], **attributes))
        return names[0]

    def split(self, whole: str, count: int, width: int, name: str) -> list[str]:
        """Add a split of columns into parts to the graph; return the parts' names."""
        parts = [f"{name}_{i}" for i in range(count)]
        sizes = self.constant(f"{name}_widths", [width] * count, numpy.int64)
        self.node("Split", [whole, sizes], *parts, axis=1)
        return parts

    def linear(self, rows: str, weight: str, bias: str) -> str:
        return self.node("Gemm", [rows, weight, bias], transB=1)


def _normalise(graph: _Graph, arrays: dict[str, numpy.ndarray]) -> str:
    """Add the clipped ``(observation - mean) / scale`` to the graph; return its name."""
    limit = [graph.constant(n, v) for n, v in (("low", -OBSERVATION_LIMIT), ("high", OBSERVATION_LIMIT))]
    mean, scale = (graph.constant(n, arrays[n]) for n in ("observation_mean", "observation_scale"))
    centred = graph.node("Sub", ["observation", mean])
    return graph.node("Clip", [graph.node("Div", [centred, scale]), *limit])


def _gated_recurrent(graph: _Graph, x: str, width: int) -> str:
    """Add a step of the gated recurrent unit (Cho et al., 2014, torch's form); return the name of its output."""
    from_input = graph.split(graph.linear(x, "gru_input_weight", "gru_input_bias"), 3, width, "from_input")
    from_memory = graph.linear("memory", "gru_memory_weight", "gru_memory_bias")
    from_memory_parts = graph.split(from_memory, 3, width, "from_memory")
    reset, update = (
        graph.node("Sigmoid", [graph.node("Add", [from_input[i], from_memory_parts[i]])]) for i in (0, 1)
    )
    remembered = graph.node("Mul", [reset, from_memory_parts[2]])
    new = graph.node("Tanh", [graph.node("Add", [from_input[2], remembered])])
    less = graph.node("Sub", [graph.constant("one", 1.0), update])
    parts = [graph.node("Mul", [less, new]), graph.node("Mul", [update, "memory"])]
    return graph.node("Add", parts, "memory_after")


def _long_short_term(graph: _Graph, x: str, width: int) -> str:
    """Add a step of the long short-term memory (Gers et al., 2000); return the name of its output.

    The memory has the output first, then the cells.
    """
    shown, cells = graph.split("memory", 2, width, "memory_part")
    from_input = graph.linear(x, "lstm_input_weight", "lstm_input_bias")
    from_memory = graph.linear(shown, "lstm_memory_weight", "lstm_memory_bias")
    gates = graph.split(graph.node("Add", [from_input, from_memory]), 4, width, "gate")
    admit, keep, show = (graph.node("Sigmoid", [gates[i]]) for i in (0, 1, 3))
    new = graph.node("Tanh", [gates[2]])
    after = graph.node("Add", [graph.node("Mul", [keep, cells]), graph.node("Mul", [admit, new])])
    answer = graph.node("Mul", [show, graph.node("Tanh", [after])])
    graph.node("Concat", [answer, after], "memory_after", axis=1)
    return answer


def _action(graph: _Graph, x: str, output: str, space: Any) -> None:
    """Add the conversion of the last layer to an action: clipped, squashed by tanh, or the largest one's index."""
    if output == "argmax":
        graph.node("ArgMax", [x], "action", axis=1, keepdims=0)
        return
    if output == "clip":
        # Limits of a box may differ from number to number, and those of Clip may not.
        low, high = (graph.constant(f"action_{n}", getattr(space, n)) for n in ("low", "high"))
        graph.node("Min", [graph.node("Max", [x, low]), high], "action")
        return
    half = graph.constant("action_half_range", 0.5 * (space.high - space.low))
    middle = graph.constant("action_middle", 0.5 * (space.high + space.low))
    graph.node("Add", [graph.node("Mul", [graph.node("Tanh", [x]), half]), middle], "action")


def _network(request: ExportRequest) -> tuple[StoredPolicy, Model]:
    """Return an agent's stored network, and the model of its environment."""
    maker = request.maker
    stored = maker.policy if isinstance(maker, EstimatorMaker) else maker
    if not isinstance(stored, StoredPolicy):
        raise ValueError(
            f"{request.name!r} has no network of plain arrays: name a shipped agent or a .safetensors file, which "
            "filtergym export writes of a training run"
        )
    model = make_model(request.problem.task, stored.control, **stored.task_keywords)
    stored(model)  # refuses what does not fit
    return stored, model


def network_metadata(stored: StoredPolicy, model: Model) -> dict[str, str]:
    """Return the metadata of a network's ONNX file: environment, fields with units, actions, as texts by key."""
    header, space = stored.header, model.action_space
    known = {field.name: field for field in model.fields}
    fields = [known[field] for field in header["fields"]]
    corrected, gated = stored.around
    around = [f"corrects the actions of {corrected}"] if corrected else []
    around += ["acts behind a gate"] if gated else []
    box: Any = space
    limits = (
        {"low": box.low.tolist(), "high": box.high.tolist()} if hasattr(box, "low") else {"n": int(box.n)}
    )
    return {
        "environment": header["environment"],
        "interface": str(header["interface"]),
        "control": header["control"],
        "decision_interval": str(model.task.decision_interval),
        "fields": json.dumps([field.name for field in fields]),
        "units": json.dumps([field.unit for field in fields]),
        "descriptions": json.dumps([field.description for field in fields]),
        "action": action_meanings(model.task).get(header["control"], ""),
        "action_space": json.dumps(limits),
        "memory": "zeros at the start of a track; then what the last step returned",
        "parameters": json.dumps(stored.task_keywords),
        "around": "; ".join(around),
    }


def network_graph(stored: StoredPolicy, model: Model) -> Any:
    """Return an agent's stored network as an ONNX model: observation and memory in, action and memory out."""
    try:
        import onnx
    except ImportError as error:
        raise ValueError(f"ONNX needs one more package: pip install 'filtergym[onnx]' ({error})") from error
    helper, real = onnx.helper, onnx.TensorProto.FLOAT
    arrays, graph = stored.arrays, _Graph(onnx)
    for name, array in arrays.items():
        if name.startswith(("gru_", "lstm_", "weight_", "bias_")):
            graph.constant(name, array)
    x, memory = _normalise(graph, arrays), 0
    for unit, step, size in (("gru", _gated_recurrent, 1), ("lstm", _long_short_term, 2)):
        if f"{unit}_memory_weight" in arrays:
            width = arrays[f"{unit}_memory_weight"].shape[1]
            x, memory = step(graph, x, width), size * width
    layers = sum(name.startswith("weight_") for name in arrays)
    for i in range(layers):
        x = graph.linear(x, f"weight_{i}", f"bias_{i}")
        if i < layers - 1:
            x = graph.node({"tanh": "Tanh", "relu": "Relu"}[stored.header["activation"]], [x])
    _action(graph, x, stored.header["output"], model.action_space)
    inputs = {"observation": len(stored.header["fields"])} | ({"memory": memory} if memory else {})
    outputs = {"memory_after": memory} if memory else {}
    discrete = stored.header["output"] == "argmax"
    action = helper.make_tensor_value_info(
        "action",
        onnx.TensorProto.INT64 if discrete else real,
        [BATCH] if discrete else [BATCH, stored.header["answers"]],
    )
    made = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "network",
            [helper.make_tensor_value_info(n, real, [BATCH, width]) for n, width in inputs.items()],
            [action, *(helper.make_tensor_value_info(n, real, [BATCH, w]) for n, w in outputs.items())],
            list(graph.constants.values()),
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        producer_name="filtergym",
    )
    made.ir_version = IR_VERSION
    helper.set_model_props(made, network_metadata(stored, model))
    onnx.checker.check_model(made, full_check=True)
    return made


def export_onnx(request: ExportRequest, path: Path) -> None:
    """Write the network of an agent as an ONNX file.

    Raises:
        ValueError: for an agent without a network of plain arrays, a file that cannot be written, or without the
            package.
    """
    made = network_graph(*_network(request))
    with whole_file(path) as partial:
        partial.write_bytes(made.SerializeToString())
