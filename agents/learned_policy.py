"""Learned policies as plain arrays: NumPy inference, no torch, nothing executed on load.

A file is in the safetensors form: arrays, and a header of strings. ``observation_mean`` and ``observation_scale``
normalise the observation, ``gru_*`` are a gated recurrent unit in torch's layout (reset, update, new), ``lstm_*`` a
long short-term memory (input, forget, cell, output), ``weight_i`` and ``bias_i`` the layers after it, ``envelope_low``
and ``envelope_high`` of an exported agent the range of each field in its training. The header names the environment,
the control and the fields of the observation, by which the agent selects its columns.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, get_type_hints

import numpy

from ..envs.contract.companions import action_reach, trained_banks
from ..envs.contract.model import Model
from ..envs.contract.parameters import quote_shortened
from ..envs.contract.task import Task
from ..envs.data.foreign_files import parse_json, read_content
from ..envs.engine.catalogue import short_name, task_class
from ..evaluation.competitors.kinds import Policy
from ..evaluation.storage.files import whole_file
from ..evaluation.storage.stored import has_type
from .gate import wrap_as_trained
from .learned_estimator import EstimatorMaker
from .training_run import TrainingRun

PRETRAINED = Path(__file__).parent / "pretrained"
ACTIVATIONS: dict[str, Callable[[numpy.ndarray], numpy.ndarray]] = {
    "tanh": numpy.tanh,
    "relu": lambda x: numpy.maximum(x, 0.0),
}
OUTPUTS = ("clip", "tanh", "argmax")
"""Maps from the last layer to an action: clipped to the box, squashed into it, or the index of the largest entry."""
ENVELOPE = ("envelope_low", "envelope_high")
"""Optional arrays: smallest and largest value of each field in training, see :mod:`.envelope`."""
HEADER = ("environment", "control", "interface", "fields", "output", "activation", "run")
MOST_BYTES = 64_000_000
"""Largest size of a file; a network of twice 256 units has 0.3 MB."""
OBSERVATION_LIMIT = 10.0
"""Largest magnitude of a normalised observation, as in VecNormalize."""


ROWS = 8
"""Observations in one matrix product."""


def _product(rows: numpy.ndarray, weight: numpy.ndarray) -> numpy.ndarray:
    """Return ``rows @ weight.T`` in products of one shape, so that rounding does not depend on the number of rows.

    The compiler makes a loop of traced rows.
    """
    if not isinstance(rows, numpy.ndarray):
        return rows @ weight.T
    count, width = rows.shape
    padded = numpy.zeros((-(-count // ROWS), ROWS, width), rows.dtype)
    padded.reshape(-1, width)[:count] = rows
    return (padded @ weight.T).reshape(-1, len(weight))[:count]


def _logistic(x: numpy.ndarray) -> numpy.ndarray:
    return 0.5 * (1.0 + numpy.tanh(0.5 * x))


class LearnedPolicy(Policy):
    """A network with fixed weights, with or without memory.

    Args:
        model: the model whose observations are passed.
        arrays: arrays by the names in the module's description; float32, as in a file, or wider.
        output: one of ``OUTPUTS``.
        activation: function between layers, "tanh" or "relu".
        fields: names of the fields that the network reads, in its order; default: all fields of the model.

    Raises:
        ValueError: if the model's observation lacks one of the fields.
    """

    traced_as: ClassVar[str] = "network"
    """Name in an export, beside the network's own code."""
    observation_limit: ClassVar[float] = OBSERVATION_LIMIT

    traceable = True

    def __init__(
        self,
        model: Model,
        arrays: Mapping[str, numpy.ndarray],
        output: str,
        activation: str = "tanh",
        fields: Sequence[str] | None = None,
    ) -> None:
        super().__init__(model)
        self.control: str = model.control  # type: ignore[misc]  # as it was trained
        self.columns: slice | list[int] = slice(None) if fields is None else model.columns(fields)
        arrays = {name: values.astype(numpy.float64) for name, values in arrays.items()}
        self.arrays = arrays
        self.output = output
        self.activation: Callable[[numpy.ndarray], numpy.ndarray] = ACTIVATIONS[activation]
        self.layers: list[tuple[numpy.ndarray, numpy.ndarray]] = [
            (arrays[f"weight_{i}"], arrays[f"bias_{i}"])
            for i in range(sum(name.startswith("weight_") for name in arrays))
        ]

    def act(self, observation: numpy.ndarray, state: Any, start: numpy.ndarray) -> tuple[numpy.ndarray, Any]:
        """Return the network's action for observations, in the precision of its arrays, and the memory.

        Interpreted, compiled with the filters and written in NumPy, the outputs agree to rounding.
        """
        a = self.arrays
        x = (observation[:, self.columns] - a["observation_mean"]) / a["observation_scale"]
        x = numpy.clip(x, -OBSERVATION_LIMIT, OBSERVATION_LIMIT).astype(a["observation_mean"].dtype)
        if "gru_input_weight" in a:
            memory = self._memory(state, start, a["gru_memory_weight"].shape[1])
            x = state = self._gru_step(x, memory)
        elif "lstm_input_weight" in a:
            memory = self._memory(state, start, 2 * a["lstm_memory_weight"].shape[1])
            state = self._long_short_term(x, memory)
            x = numpy.split(state, 2, axis=1)[0]
        for i, (weight, bias) in enumerate(self.layers):
            x = _product(x, weight) + bias
            if i < len(self.layers) - 1:
                x = self.activation(x)
        if self.output == "argmax":
            return numpy.argmax(x, axis=1), state
        space: Any = self.model.action_space
        if self.output == "clip":
            return numpy.clip(x, space.low, space.high), state
        return space.low + (space.high - space.low) * 0.5 * (1.0 + numpy.tanh(x)), state

    def _memory(self, state: Any, start: numpy.ndarray, width: int) -> numpy.ndarray:
        """Return the network's memory ``(N, width)``, with zeros where an episode starts."""
        dtype = self.arrays["observation_mean"].dtype
        memory = numpy.zeros((len(start), width), dtype) if state is None else state
        return numpy.where(start[:, None], dtype.type(0.0), memory)

    def _gru_step(self, x: numpy.ndarray, memory: numpy.ndarray) -> numpy.ndarray:
        """Return the memory after a step of the gated recurrent unit (Cho et al., 2014, in torch's form)."""
        a = self.arrays
        from_input = _product(x, a["gru_input_weight"]) + a["gru_input_bias"]
        from_input = numpy.split(from_input, 3, axis=1)
        from_memory = _product(memory, a["gru_memory_weight"]) + a["gru_memory_bias"]
        from_memory = numpy.split(from_memory, 3, axis=1)
        reset = _logistic(from_input[0] + from_memory[0])
        update = _logistic(from_input[1] + from_memory[1])
        new = numpy.tanh(from_input[2] + reset * from_memory[2])
        return (1.0 - update) * new + update * memory

    def _long_short_term(self, x: numpy.ndarray, memory: numpy.ndarray) -> numpy.ndarray:
        """Return outputs and cells after a step of the long short-term memory (Gers et al., 2000)."""
        a = self.arrays
        shown, cells = numpy.split(memory, 2, axis=1)
        gates = _product(x, a["lstm_input_weight"]) + a["lstm_input_bias"]
        gates = gates + _product(shown, a["lstm_memory_weight"]) + a["lstm_memory_bias"]
        admit, keep, new, show = numpy.split(gates, 4, axis=1)
        cells = _logistic(keep) * cells + _logistic(admit) * numpy.tanh(new)
        return numpy.concatenate([_logistic(show) * numpy.tanh(cells), cells], axis=1)


def write_arrays(
    path: Path,
    arrays: Mapping[str, numpy.ndarray],
    run: TrainingRun,
    output: str,
    activation: str = "tanh",
    fields: Sequence[str] | None = None,
) -> None:
    """Write a learned policy's arrays and the record of its run as a safetensors file.

    Arguments are those of :class:`LearnedPolicy`.
    """
    from safetensors.numpy import save

    model = run.make_model()
    header = {
        "environment": model.task.id,
        "control": run.control,
        "interface": str(model.task.interface),
        "fields": json.dumps([field.name for field in model.fields] if fields is None else list(fields)),
        "output": output,
        "activation": activation,
        "run": json.dumps(asdict(run)),
    }
    contiguous = {name: numpy.ascontiguousarray(a, dtype=numpy.float32) for name, a in arrays.items()}
    with whole_file(path) as partial:
        partial.write_bytes(save(contiguous, header))


def write_envelope(path: Path, low: numpy.ndarray, high: numpy.ndarray) -> None:
    """Add the training range of each field, ``low`` to ``high`` of shape ``(fields,)``, to a learned policy's file."""
    from safetensors import safe_open
    from safetensors.numpy import save

    with safe_open(path, framework="numpy") as file:
        header = dict(file.metadata())
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    # Rounded to float32 outwards, so that the ends stay inside.
    ends = (
        numpy.nextafter(numpy.float32(end), numpy.float32(away))
        for end, away in ((low, -numpy.inf), (high, numpy.inf))
    )
    arrays |= dict(zip(ENVELOPE, ends, strict=True))
    with whole_file(path) as partial:
        partial.write_bytes(save(arrays, header))


def read_arrays(path: Path) -> tuple[dict[str, numpy.ndarray], dict[str, Any]]:
    """Return the arrays of a learned policy's file, and its header with parsed ``run`` and ``fields``.

    Raises:
        ValueError: if the file is not a learned policy.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        content = read_content(path, MOST_BYTES)
        arrays = load(content)  # first, as it checks sizes and offsets
        size = int.from_bytes(content[:8], "little")
        header: dict[str, Any] = dict(parse_json(content[8 : 8 + size]).get("__metadata__") or {})
        lacking = [name for name in HEADER if name not in header]
        if lacking:
            raise ValueError(f"its header lacks {', '.join(lacking)}")
        header |= {name: parse_json(header[name].encode()) for name in ("fields", "run")}
        if header["output"] not in OUTPUTS or header["activation"] not in ACTIVATIONS:
            raise ValueError(
                f"unknown output {header['output']!r:.80} or activation {header['activation']!r:.80}"
            )
        if not has_type(header["fields"], list[str]):
            raise ValueError("its header has no list of fields")
        _check_run(header["run"])
        header["answers"] = _count_outputs(arrays, len(header["fields"]))
    except FileNotFoundError as error:
        raise ValueError(f"no learned policy at {path}") from error
    except (SafetensorError, ValueError, TypeError, AttributeError, KeyError) as error:
        raise ValueError(f"{path} is not a learned policy of filtergym: {error}") from error
    return arrays, header


def _check_run(run: Any) -> None:
    """Raise ValueError unless the run's record in a file's header has the right types."""
    if not isinstance(run, dict):
        raise ValueError("its header has no record of a run")
    for name, hint in get_type_hints(TrainingRun).items():
        if name in run and not has_type(run[name], hint):
            raise ValueError(
                f"{name} of its run must be {getattr(hint, '__name__', hint)}, got {run[name]!r:.80}"
            )
    if not isinstance(run.get("hyperparameters", {}).get("env_kwargs", {}), dict):
        raise ValueError("env_kwargs of its run must map names to values")


def _count_outputs(arrays: Mapping[str, numpy.ndarray], width: int) -> int:
    """Check that the arrays of a network fit together, and return its number of outputs.

    Raises:
        ValueError: if an array is missing or unknown, or does not fit the others or a ``width`` of so many fields.
    """
    expected: dict[str, tuple[int, ...]] = {"observation_mean": (width,), "observation_scale": (width,)}
    for unit, gates in (("gru", 3), ("lstm", 4)):
        if f"{unit}_memory_weight" in arrays:
            memory = arrays[f"{unit}_memory_weight"].shape[-1:] or (0,)
            size = gates * memory[0]
            expected |= {f"{unit}_input_weight": (size, width), f"{unit}_input_bias": (size,)}
            expected |= {f"{unit}_memory_weight": (size, *memory), f"{unit}_memory_bias": (size,)}
            width = memory[0]
    for i in range(max(1, sum(name.startswith("weight_") for name in arrays))):
        below, width = width, arrays[f"bias_{i}"].size if f"bias_{i}" in arrays else 0
        expected |= {f"weight_{i}": (width, below), f"bias_{i}": (width,)}
    if arrays.keys() & set(ENVELOPE):
        expected |= dict.fromkeys(ENVELOPE, expected["observation_mean"])
    if arrays.keys() != expected.keys():
        raise ValueError(
            f"it contains the arrays {', '.join(sorted(arrays))}, not {', '.join(sorted(expected))}"
        )
    for name, shape in expected.items():
        if arrays[name].shape != shape or not numpy.isfinite(arrays[name]).all():
            raise ValueError(
                f"{name} must be finite numbers of shape {shape}, got shape {arrays[name].shape}"
            )
    if not arrays["observation_scale"].all():
        raise ValueError("observation_scale must not be zero")
    return width


class StoredPolicy:
    """Factory of the learned policy in a file; an evaluation calls it with a model."""

    def __init__(self, path: Path) -> None:
        self.arrays, self.header = read_arrays(path)
        ends = [self.arrays.pop(name) for name in ENVELOPE if name in self.arrays]
        self.envelope: tuple[numpy.ndarray, numpy.ndarray] | None = (ends[0], ends[1]) if ends else None
        self.path = path
        self.control: str = self.header["control"]
        self.around = self.header["run"].get("residual_to", ""), self.header["run"].get("gated", False)
        hyperparameters = self.header["run"].get("hyperparameters", {})
        self._keywords: dict[str, Any] = hyperparameters.get("env_kwargs", {})

    @property
    def task_keywords(self) -> dict[str, Any]:
        """Task parameters of the policy's training that set the range of its actions (:class:`.Actions`)."""
        reach = action_reach(task_class(self.header["environment"]), self.control)
        return {name: value for name, value in self._keywords.items() if name in reach}

    def _check_reach(self, model: Model) -> None:
        """Raise ValueError if the range of the model's actions differs from that in training."""
        now, keywords = model.task.parameters, self.task_keywords
        defaults = type(now)()
        for name in action_reach(model.task, self.control):
            if name == "decision_interval":  # an action means the same, however long it holds
                continue
            trained = keywords.get(name, getattr(defaults, name))
            if getattr(now, name) != trained:
                raise ValueError(
                    f"{self.path} was trained with {name}={trained!r}, and its actions have another meaning with "
                    f"{name}={getattr(now, name)!r}: leave out {name}"
                )

    def __call__(self, model: Model) -> Policy:
        """Return the policy for a model, wrapped as in its training (corrected policy, gate)."""
        if self.header["interface"] != str(model.task.interface):
            raise ValueError(
                f"{self.path} was trained with another meaning of the fields or actions of {model.task.id} (its "
                f"interface {quote_shortened(self.header['interface'])}, now {model.task.interface}): train it again"
            )
        self._check_reach(model)
        try:
            network = LearnedPolicy(
                model, self.arrays, self.header["output"], self.header["activation"], self.header["fields"]
            )
        except ValueError as error:
            raise ValueError(
                f"{self.path} was trained on other fields than those of {model.task.id}: {error}"
            ) from None
        space: Any = model.action_space
        count = int(space.n) if hasattr(space, "n") else space.shape[0]
        if (self.header["output"] == "argmax") != hasattr(space, "n") or self.header["answers"] != count:
            raise ValueError(
                f"{self.path} returns {self.header['output']} of {self.header['answers']} numbers, which is no "
                f"action of control {model.control!r}: {space}"
            )
        return wrap_as_trained(model, network, *self.around)


def load_policy(cls: type[Task], path: Path) -> StoredPolicy | EstimatorMaker:
    """Return the factory of the learned policy or estimator in a file; it must be of the environment ``cls``.

    Raises:
        ValueError: if the file is not a learned policy, or belongs to another environment.
    """
    stored = StoredPolicy(path)
    if stored.header["environment"] != cls.id:
        raise ValueError(
            f"{path} was trained on {quote_shortened(stored.header['environment'])}, not on {cls.id}"
        )
    return EstimatorMaker(stored.control, stored) if stored.control in trained_banks(cls) else stored


def pretrained_path(id: str, name: str) -> Path:
    """Return the path of the shipped agent of a name for a Gymnasium id; the file need not exist."""
    return PRETRAINED / short_name(id) / f"{name}.safetensors"
