"""Objects as the text that makes them again: numbers, arrays, and objects of the classes that are written out."""

import ast
import dataclasses
import functools
import inspect
import textwrap
import types
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy

from ..envs.contract.model import Model
from ..envs.contract.observation import Blocks
from ..envs.contract.parameters import TaskParameters
from ..envs.contract.task import Task
from ..envs.contract.world import World
from .definition_text import WIDTH, DefinitionText
from .definitions import SPACE, Definitions, ExportError, External, Key, is_named_tuple, source_of

LONG = 30
"""Numbers beyond which an array is a constant of its own."""
OF_A_MODEL = ("task", "filter", "control", SPACE)
"""What policies read of the model that they act in, after they are made."""


class NamedReader:
    """Reads a block or a quantity from observations, and knows its name.

    Args:
        blocks: of the observation.
        name: of the block or quantity.
    """

    def __init__(self, blocks: Blocks, name: str) -> None:
        self.name, self._read = name, blocks.reader(name)

    def __call__(self, observation: numpy.ndarray) -> numpy.ndarray:
        """Read it, ``(N, parts)``."""
        return self._read(observation)


class ReadModel(Model):
    """A model whose readers know their names, for policies that are to be written out."""

    @property
    def observation(self) -> Blocks:
        """What the observation is made of."""
        return self._blocks

    def reader(self, name: str) -> NamedReader:
        """Return what reads a block or quantity."""
        return NamedReader(self._blocks, name)


def _attributes(value: Any, definitions: Definitions) -> dict[str, Any]:
    """Attributes of an object that are read, by name."""
    if isinstance(value, Model):
        return {name: getattr(value, name) for name in OF_A_MODEL if name in definitions.attributes}
    if dataclasses.is_dataclass(value) and not isinstance(value, TaskParameters):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value) if field.init}
    names = definitions.shared_attributes if isinstance(value, Task | World) else definitions.attributes
    if isinstance(value, TaskParameters):
        names = names | definitions.words
    found = {name: part for name, part in vars(value).items() if name in names}
    if isinstance(value, Task | World | TaskParameters):
        for name in sorted(names - found.keys()):
            member = inspect.getattr_static(type(value), name, None)
            # A dataclass's fields stand in its instance already.
            if member is not None and not isinstance(member, types.FunctionType | classmethod | staticmethod):
                found[name] = getattr(value, name)
    if SPACE in names and hasattr(type(value), SPACE):
        found[SPACE] = getattr(value, SPACE)
    return found


def _lambda_of(function: types.FunctionType) -> tuple[str, ast.Lambda] | None:
    """Module and expression of a function without a name that uses nothing of where it was made."""
    if function.__name__ != "<lambda>" or function.__closure__:
        return None
    found = [
        node
        for node in ast.walk(source_of(function.__module__).tree)
        if isinstance(node, ast.Lambda) and node.lineno == function.__code__.co_firstlineno
    ]
    return (function.__module__, found[0]) if len(found) == 1 else None


class Constants:
    """Finds what objects consist of, and writes them.

    Args:
        definitions: where their classes are collected.
    """

    def __init__(self, definitions: Definitions) -> None:
        self.definitions = definitions
        self._visited: set[int] = set()

    def collect(self, value: Any, path: str) -> None:
        """Add the definitions that an object needs.

        Args:
            value: the object.
            path: that leads to it, in errors.

        Raises:
            ExportError: for what cannot be written.
        """
        self._visited = set()
        self._collect(value, path)

    def _collect(self, value: Any, path: str) -> None:
        if id(value) in self._visited:
            return
        if isinstance(value, tuple | list | Mapping) or hasattr(value, "__dict__"):
            self._visited.add(id(value))
        if isinstance(value, Mapping):
            for key, part in value.items():
                self._collect(part, f"{path}[{key!r}]")
        elif isinstance(value, tuple | list):
            if is_named_tuple(type(value)):
                self.definitions.add_class(type(value))
            for i, part in enumerate(value):
                self._collect(part, f"{path}[{i}]")
        elif isinstance(value, functools.partial):
            for part in (value.func, value.args, value.keywords):
                self._collect(part, path)
        elif isinstance(value, types.FunctionType | type):
            self._collect_definition(value, path)
        elif isinstance(value, types.MethodType):
            restricted = isinstance(value.__self__, World)
            names = self.definitions.shared_attributes if restricted else self.definitions.attributes
            names.add(value.__name__)
            self._collect(value.__self__, path)
        elif isinstance(value, Blocks):
            self.definitions.instantiated.add(Blocks)
            self.definitions.attributes |= {"blocks", "quantities"}
            self.definitions.add_class(Blocks)
        elif isinstance(value, NamedReader):
            self.definitions.attributes.add("reader")
        elif not _is_plain(value):
            self._collect_object(value, path)

    def _collect_definition(self, value: Any, path: str) -> None:
        found = _lambda_of(value) if isinstance(value, types.FunctionType) else None
        if found is not None:
            self.definitions.add_code(*found)
            return
        name = value.__qualname__
        if "." in name or not self.definitions.is_own(value.__module__):
            raise ExportError(f"{path} is {name} of {value.__module__}, which cannot be written as text")
        self.definitions.add(Key(value.__module__, name))

    def _collect_object(self, value: Any, path: str) -> None:
        cls = type(value)
        if isinstance(value, Model):
            pass
        elif not self.definitions.is_own(cls.__module__) or not hasattr(value, "__dict__"):
            raise ExportError(
                f"{path} is a {cls.__name__} of {cls.__module__}, which cannot be written as text"
            )
        else:
            if isinstance(value, Task | World):
                self.definitions.tasks.add(cls)
                self.definitions.task_names.add(path.rpartition(".")[2])
            if isinstance(value, TaskParameters):
                self.definitions.parameters.add(cls)
                self.definitions.externals.add(External("dataclasses", "dataclass", "dataclass"))
            self.definitions.add_class(cls)
        for name, part in _attributes(value, self.definitions).items():
            self._collect(part, f"{path}.{name}")


def _is_plain(value: Any) -> bool:
    plain = bool | int | float | str | slice | range | numpy.generic | numpy.ndarray | numpy.ufunc
    return value is None or value is numpy or isinstance(value, plain | gymnasium.Space)


def word(value: Any) -> str:
    """Text of a string or anything that prints as it is written, in double quotes where there are none inside."""
    text = repr(value)
    return f'"{text[1:-1]}"' if isinstance(value, str) and text[0] == "'" and '"' not in text else text


def number_text(value: Any) -> str:
    """Number as text that gives the same bits: the shortest."""
    text = repr(value.item() if isinstance(value, numpy.generic) else value)
    if isinstance(value, numpy.floating):
        # The shortest of its own precision, unless it rounds to another number by way of Python's double.
        shortest = str(value)
        text = shortest if type(value)(float(shortest)) == value else text
        value = float(value)
    if isinstance(value, float) and not numpy.isfinite(value):
        return "numpy.nan" if value != value else ("numpy.inf" if value > 0.0 else "-numpy.inf")
    return text


def array_text(array: numpy.ndarray) -> str:
    """Array as text that gives the same bits, in lines."""
    dtype = "" if array.dtype == numpy.float64 else f", dtype=numpy.{array.dtype.name}"
    order = ', order="F"' if array.flags.f_contiguous and not array.flags.c_contiguous else ""
    if array.size == 0:
        return f"numpy.zeros({array.shape}{dtype}{order})"
    if array.size > LONG and array.ndim > 2 and not order:
        return f"{array_text(array.reshape(-1))}.reshape{array.shape}"
    if array.size > LONG and array.dtype == numpy.float64 and _is_single(array):  # half the digits
        return f"{array_text(array.astype(numpy.float32))}.astype(float)"
    rows = _rows_text(array)
    if array.ndim == 1 and "\n" in rows:
        return f"numpy.array(\n{textwrap.indent(rows, '    ')}{dtype}{order}\n)"
    return f"numpy.array({rows}{dtype}{order})"


def _is_single(array: numpy.ndarray) -> bool:
    """Whether all numbers are those of float32, to the bit."""
    with numpy.errstate(over="ignore"):
        return bool((array.astype(numpy.float32).astype(numpy.float64) == array).all())


def _rows_text(array: numpy.ndarray) -> str:
    if array.ndim == 0:
        return number_text(array[()])
    if array.ndim == 1:
        text = "[" + ", ".join(number_text(x) for x in array) + "]"
        return "\n".join(textwrap.wrap(text, WIDTH - 8, break_long_words=False, break_on_hyphens=False))
    rows = [_rows_text(row) for row in array]
    flat = "[" + ", ".join(rows) + "]"
    if len(flat) < WIDTH - 20 and "\n" not in flat:
        return flat
    return "[\n" + textwrap.indent(",\n".join(rows), "    ") + ",\n]"


class ConstantsText:
    """Writes objects: statements, in the order in which they need each other.

    Args:
        definitions: of their classes, complete.
        text: that names them.
        observation: name of the observation's blocks, of which readers are made.
    """

    def __init__(self, definitions: Definitions, text: DefinitionText, observation: str, bank: Any) -> None:
        self.definitions, self.definition_text = definitions, text
        self.observation, self.bank = observation, bank
        self.statements: list[str] = []
        self._names: dict[int, str] = {}
        self._kept: list[Any] = []

    def name(self, value: Any, wanted: str) -> str:
        """Write an object as a constant with this name, or one like it, and return that."""
        if id(value) in self._names:
            return self._names[id(value)]
        expression = self.expression(value, wanted, hoist=False)
        return self._keep(value, wanted, expression)

    def _keep(self, value: Any, wanted: str, expression: str) -> str:
        name, number = wanted.upper().strip("_"), 2
        while name in self._names.values():
            name, number = f"{wanted.upper().strip('_')}_{number}", number + 1
        self._names[id(value)] = name
        self._kept.append(value)  # so that its id stays its own
        self.statements.append(f"{name} = {expression}")
        return name

    def expression(self, value: Any, wanted: str, hoist: bool = True) -> str:
        """Return the expression of an object.

        Args:
            value: the object.
            wanted: name for it if it becomes a constant.
            hoist: whether it may become one.
        """
        if id(value) in self._names:
            return self._names[id(value)]
        if isinstance(value, numpy.ndarray):
            # Those of a network are named, whatever their size: it holds some of them twice.
            named = value.size > LONG or value.dtype == numpy.float32
            return self.name(value, wanted) if hoist and named else array_text(value)
        if isinstance(value, Blocks):
            return self._blocks(value)
        if isinstance(value, NamedReader):
            return f"{self.observation}.reader({word(value.name)})"
        if isinstance(value, gymnasium.Space):
            return self._space(value)
        if isinstance(value, Mapping | tuple | list | slice | range | functools.partial):
            return self._container(value, wanted)
        if isinstance(value, types.FunctionType | type):
            return self._definition(value)
        if isinstance(value, types.MethodType):
            return f"{self.expression(value.__self__, wanted)}.{value.__name__}"
        if value is numpy:
            return "numpy"
        if isinstance(value, numpy.ufunc):
            return f"numpy.{value.__name__}"
        if isinstance(value, numpy.generic):
            return f"numpy.{value.dtype.name}({number_text(value)})"
        if _is_plain(value):
            return number_text(value) if isinstance(value, float) else word(value)
        return self.name(value, wanted) if hoist else self._object(value)

    def _space(self, space: Any) -> str:
        if hasattr(space, "n"):
            return f"Discrete({int(space.n)})"
        return call_text("Box(", [array_text(space.low), array_text(space.high)], ")")

    def _blocks(self, value: Blocks) -> str:
        bank = self.expression(self.bank, "filter")
        read = "reader" in self.definitions.attributes
        made = f"Blocks({bank}.blocks, {f'{bank}.quantities' if read else '()'}, numpy)"
        return self._keep(value, self.observation, made)

    def _container(self, value: Any, wanted: str) -> str:
        if isinstance(value, slice):
            return f"slice({value.start!r}, {value.stop!r}, {value.step!r})"
        if isinstance(value, range):
            return repr(value)
        if isinstance(value, Mapping):
            return call_text("{", [f"{word(k)}: {self.expression(v, str(k))}" for k, v in value.items()], "}")
        if isinstance(value, functools.partial):
            parts = [self.expression(part, wanted) for part in (value.func, *value.args)]
            parts += [f"{name}={self.expression(part, name)}" for name, part in value.keywords.items()]
            return call_text("functools.partial(", parts, ")")
        if is_named_tuple(type(value)):
            pairs = [f"{n}={self.expression(v, n)}" for n, v in zip(value._fields, value, strict=True)]
            return call_text(f"{self._definition(type(value))}(", pairs, ")")
        parts = [self.expression(part, f"{wanted}_{i}") for i, part in enumerate(value)]
        if isinstance(value, tuple):
            return call_text("(", parts, ",)" if len(parts) == 1 else ")")
        return call_text("[", parts, "]")

    def _definition(self, value: Any) -> str:
        if isinstance(value, types.FunctionType) and value.__name__ == "<lambda>":
            found = _lambda_of(value)
            assert found is not None
            return self.definition_text.expression(*found)
        return self.definition_text.name_of(value.__module__, value.__qualname__)

    def _object(self, value: Any) -> str:
        found = _attributes(value, self.definitions)
        if isinstance(value, TaskParameters):
            fields = {name: self.expression(part, name) for name, part in found.items()}
            self.definition_text.parameter_values[type(value)] = fields
            return f"{self._definition(type(value))}()"
        invalid = [name for name in found if not name.isidentifier()]
        if invalid:
            raise ExportError(f"{type(value).__name__} has an attribute {invalid[0]!r}, which is no name")
        cls = "Model" if isinstance(value, Model) else self._definition(type(value))
        parts = [f"{name}={self.expression(part, name)}" for name, part in found.items()]
        if dataclasses.is_dataclass(value):
            return call_text(f"{cls}(", parts, ")")
        return call_text("with_constants(", [cls, *parts], ")")


def call_text(opening: str, parts: list[str], closing: str) -> str:
    """Return a call with its arguments, each on a line of its own where they do not fit into one."""
    flat = f"{opening}{', '.join(parts)}{closing}"
    if len(flat) <= WIDTH - 20 and "\n" not in flat:
        return flat
    body = textwrap.indent(",\n".join(parts), "    ")
    return f"{opening}\n{body},\n{closing.lstrip(',')}"
