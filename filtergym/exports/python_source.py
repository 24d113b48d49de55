"""A filter as one Python file that needs NumPy only.

The file is put together from the definitions of this package that the filter uses, as they are written, with their
equations (:mod:`.definitions`), and from the constants in force (:mod:`.constants`): the same functions on the same
numbers, so the same mathematics. Worlds, Gymnasium and the compiler stay behind.
"""

import ast
import itertools
import textwrap
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy

from .. import __version__
from ..envs.contract.model import Episode, Model
from ..evaluation.rollout import rollout, start_lanes
from .constants import Constants, ConstantsText, call_text, word
from .definition_text import WIDTH, DefinitionText
from .definitions import Definitions, ExportError, External, Key, class_statement
from .exported_filter import Exported, find_exported, lane_of
from .request import ExportRequest

CHECKED = 25
"""Measurements on which a written filter is tried."""
CLASS = "OnlineFilter"
"""Name of the class that a user of the file calls."""
MAKES_OBJECTS = '''def with_constants(kind: type, **constants: Any) -> Any:
    """Return an object of a class with these attributes."""
    made = kind.__new__(kind)
    vars(made).update(constants)
    return made'''
TEMPLATES = {
    "Model": '''class Model:
    """What a policy knows of the filter that it steers."""''',
    "Box": '''class Box(NamedTuple):
    """Actions that are numbers between limits."""

    low: Array
    high: Array''',
    "Discrete": '''class Discrete(NamedTuple):
    """Actions that are one of some numbers."""

    n: int''',
}
"""What stands for objects of the engine, written where it is used."""
ALWAYS = (
    External("typing", "Any", "Any"),
    External("typing", "NamedTuple", "NamedTuple"),
    External("numpy", None, "numpy"),
)
OF_A_TRACK = ("start_track", "update_track", "arrays", "count_tracks", "named")
"""Methods that the class calls, or a user."""
RESERVED = {CLASS, "Array", "with_constants", *TEMPLATES}


def clean(text: str) -> str:
    """Return a stranger's words so that they stay within a docstring, on their line."""
    printable = "".join(c if c.isprintable() else " " for c in str(text))
    return " ".join(printable.replace("\\", "/").replace('"', "'").split())


def export_python(request: ExportRequest) -> str:
    """Return the text of a Python file that is a filter.

    Raises:
        ValueError: for what is not ranked, draws numbers, or takes more than NumPy.
    """
    exported = find_exported(request)
    try:
        text = _write(request, exported)
        _check_text(text, exported, request.name)
    except ExportError as error:
        raise ValueError(f"{request.name!r} cannot be written as one Python file: {error}") from None
    return text


def _check_text(text: str, exported: Exported, name: str) -> None:
    """Run the file on the measurements of an episode, beside the filter that it is written from.

    Raises:
        ExportError: if it fails, or says something else.
    """
    model = exported.model
    starts: list[Episode] = []
    start_lanes(model, [0], starts.append)
    answers = rollout(model, exported.maker, [0], _answer, name=name)
    namespace: dict[str, Any] = {"__name__": __name__}
    try:
        exec(compile(text, "<export>", "exec", dont_inherit=True), namespace)
        track = namespace[CLASS]()
        track.start(**lane_of(starts[0].measurement))
        for (measurement, mean, covariance), _ in itertools.islice(answers, CHECKED):
            estimate = track.update(**lane_of(measurement))
            for own, other in ((mean, estimate.mean), (covariance, estimate.covariance)):
                if not numpy.array_equal(own[..., 0], other, equal_nan=True):
                    raise ExportError(
                        "what was written estimates something else: this is a mistake of filtergym's"
                    )
    except (ArithmeticError, AttributeError, LookupError, NameError, TypeError) as error:
        raise ExportError(f"what was written does not run: {error}") from error


def _answer(model: Model, episode: Episode) -> tuple[Any, Any, Any]:
    """Report what the written filter is compared with."""
    return episode.measurement, model.mean(episode), model.covariance(episode)


def _collect(exported: Exported) -> Definitions:
    """Find all definitions that the file takes."""
    track, arguments, called = exported.parts
    roots = [type(exported.task), *map(type, arguments.values())]
    packages = {"filtergym", *(cls.__module__.partition(".")[0] for cls in roots)}
    definitions = Definitions(packages - {"builtins", "numpy"})
    definitions.externals |= set(ALWAYS)
    definitions.attributes |= {*called, *OF_A_TRACK}
    definitions.instantiated.add(track)
    definitions.add(Key(track.__module__, track.__name__))
    for example in (exported.initial, exported.measurement):
        for cls in _classes_of(example):
            definitions.add_class(cls)
    constants, size = Constants(definitions), -1
    while size != definitions.size:
        size = definitions.size
        for part, value in arguments.items():
            constants.collect(value, part)
        definitions.add_members()
    return definitions


def _classes_of(given: Any) -> list[type]:
    """Return the classes of nested NamedTuples."""
    if not isinstance(given, tuple):
        return []
    return [type(given), *(cls for part in given for cls in _classes_of(part))]


def _write(request: ExportRequest, exported: Exported) -> str:
    """Put the sections of the file together."""
    definitions, arguments = _collect(exported), exported.parts.arguments
    text = DefinitionText(definitions, RESERVED)
    constants = ConstantsText(definitions, text, "OBSERVATION", arguments["filter"])
    made = {part: constants.expression(value, part) for part, value in arguments.items()}
    equations, parameters = text.text(), text.parameters_text()
    statements = "\n".join(constants.statements)
    called = _online_filter(text, exported, made)
    whole = ast.parse("\n".join([equations, parameters, statements, called]))
    used = {node.id for node in ast.walk(whole) if isinstance(node, ast.Name)} | {"Any", "NamedTuple"}
    engine = [template for template_name, template in TEMPLATES.items() if template_name in used]
    imports = [found for found in definitions.externals if found.name in used]
    head = [_docstring(request, exported), "from __future__ import annotations", _imports(imports)]
    sections = [
        "\n\n".join(head),
        'Array = Any\n"""A NumPy array."""',
        equations,
        *filter(None, [_rule("constants"), parameters, MAKES_OBJECTS, *engine]),
        f"{statements}\n{called}",
    ]
    return "\n\n\n".join(sections) + "\n"


def _rule(title: str) -> str:
    return f"# --- {title} ".ljust(WIDTH - 1, "-")


def _imports(externals: list[External]) -> str:
    """Return the statements that import, NumPy's last.

    Raises:
        ExportError: if a name is imported from two places.
    """
    of_types = {"typing", "collections.abc"}
    origins: dict[str, set[tuple[str, str | None]]] = {}
    for found in externals:
        origin = "" if found.module in of_types else found.module
        origins.setdefault(found.name, set()).add((origin, found.attribute))
    for name, places in origins.items():
        if len(places) > 1:
            raise ExportError(f"{name} is imported from {' and '.join(sorted(place for place, _ in places))}")
    whole = sorted(str(found) for found in externals if found.attribute is None)
    names: dict[str, list[str]] = {}
    for found in sorted(externals, key=str):
        if found.attribute is not None:
            names.setdefault(found.module, []).append(str(found).partition(" import ")[2])
    lines = [*whole, *(f"from {module} import {', '.join(names[module])}" for module in sorted(names))]
    python = [line for line in lines if not line.split()[1].startswith("numpy")]
    return "\n".join(python) + "\n\n" + "\n".join(line for line in lines if line not in python)


def _field_text(cls: type, field: str) -> str:
    """Describe a field of a measurement, as its class does."""
    body = class_statement(cls).body
    for statement, following in zip(body, [*body[1:], None], strict=True):
        if getattr(getattr(statement, "target", None), "id", "") == field and isinstance(following, ast.Expr):
            return clean(ast.literal_eval(following.value)).partition(" Reading: ")[0]
    return ""


class Argument(NamedTuple):
    """One array that a filter is given."""

    text: str
    """What it is."""
    dtype: str
    shape: tuple[int, ...]
    """For one track."""


def _arguments(given: Any, prefix: str = "") -> dict[str, Argument]:
    """Arrays that a filter is given, by name; what it does without is left out."""
    found: dict[str, Argument] = {}
    for field, value in given._asdict().items():
        if isinstance(value, tuple):
            found |= _arguments(value, f"{prefix}{field}_")
        elif value is not None:
            text = _field_text(type(given), field)
            found[prefix + field] = Argument(text, value.dtype.name, value.shape[:-1])
    return found


def _given(text: DefinitionText, given: Any, prefix: str = "") -> str:
    """Expression of what a filter is given, of its arrays by name."""
    parts = []
    for field, value in given._asdict().items():
        if isinstance(value, tuple):
            parts.append(f"{field}={_given(text, value, f'{prefix}{field}_')}")
        else:
            parts.append(f"{field}={'None' if value is None else f'given[{word(prefix + field)}]'}")
    return call_text(f"{text.name_of(type(given).__module__, type(given).__name__)}(", parts, ")")


def _wrapped(text: str, indent: str, hanging: str = "") -> str:
    return "\n".join(
        textwrap.wrap(
            text, WIDTH, initial_indent=indent, subsequent_indent=indent + hanging, break_on_hyphens=False
        )
    )


def _docstring(request: ExportRequest, exported: Exported) -> str:
    task, C = exported.task, len(exported.task.components)
    components = ", ".join(f"{clean(c.name)} ({clean(c.unit)})" for c in task.components)
    fields = list(_arguments(exported.measurement))
    more = "".join(f", {field}" for field in list(_arguments(exported.initial))[2:])
    call = f"    estimate = filter.update({', '.join(f'{field}=...' for field in fields)})"
    lines = [
        f'"""{clean(request.name)}: a filter of {clean(request.problem.id)}, as one file that needs NumPy only.',
        "",
        _wrapped(
            f"Written by filtergym {__version__} for Python 3.11 and NumPy 2, or later. The equations are those of "
            "the package, function by function; the parameters in force stand behind them, under 'constants'. One "
            "track is estimated, or N side by side with N as last axis of every array.",
            "",
        ),
        "",
        f"    filter = {CLASS}()",
        f"    filter.start(mean, covariance{more})",
        call if len(call) < WIDTH else "    estimate = filter.update(...)  # see there",
        "    estimate.named(), estimate.covariance, estimate.statistics",
        "",
        _wrapped(f"Estimated are {C}: {components}.", ""),
        "",
        _wrapped(f"Source of the problem: {clean(task.paper_source)}.", ""),
        '"""',
    ]
    return "\n".join(lines)


def _online_filter(text: DefinitionText, exported: Exported, made: Mapping[str, str]) -> str:
    """Class with the names of what it is given and says."""
    arguments = {**_arguments(exported.initial), **_arguments(exported.measurement)}
    components = tuple((c.name, c.unit) for c in exported.task.components)
    base = text.name_of(exported.parts.track.__module__, exported.parts.track.__name__)
    parts = "".join(f", {expression}" for part, expression in made.items() if part != "filter")
    table = "".join(
        f"    {word(field)}: ({word(each.dtype)}, {each.shape}),\n" for field, each in arguments.items()
    )
    rows = "".join(f"    ({word(name)}, {word(unit)}),\n" for name, unit in components)
    return "\n".join(
        [
            f"COMPONENTS = (\n{rows})",
            '"""What is estimated, and its units."""',
            f"SHAPES = {{\n{table}}}",
            '"""What the filter is given: type of the numbers, and shape for one track."""',
            "",
            "",
            _rule("the filter"),
            "",
            "",
            f"class {CLASS}({base}):",
            '    """The filter in a loop of your own."""',
            "",
            "    def __init__(self) -> None:",
            f"        super().__init__({made['filter']}, COMPONENTS, SHAPES{parts})",
            "",
            _method(text, "start", exported.initial, exported),
            "",
            _method(text, "update", exported.measurement, exported),
        ]
    )


def _method(text: DefinitionText, method: str, given: Any, exported: Exported) -> str:
    """One of the two methods that a user calls, with what each argument is."""
    described = {field: each.text for field, each in _arguments(given).items()}
    if method == "start":
        C = len(exported.task.components)
        described |= {"mean": f"of COMPONENTS, ``({C},)``, or ``({C}, N)`` of N tracks."}
        described |= {"covariance": f"of its errors, ``({C}, {C})`` or ``({C}, {C}, N)``."}
    returned, title = (
        ("None", "Start the track at an initial estimate.")
        if method == "start"
        else ("Estimate", "Predict to the time of a measurement, take it in, and estimate.")
    )
    signature = ["self", *(f"{field}: Any" for field in described)]
    opening = call_text(f"def {method}(", signature, f") -> {returned}:")
    lines = [textwrap.indent(opening, " " * 4), f'        """{title}', ""]
    if method == "update":
        lines += ["        Shapes are those of N tracks; of one, they are without the N.", ""]
    lines += ["        Args:"]
    lines += [_wrapped(f"{field}: {words}", " " * 12, "    ") for field, words in described.items()]
    lines += ["", "        Raises:", "            ValueError: for an array of another shape.", '        """']
    pairs = call_text("given = self.arrays(", [f"{field}={field}" for field in described], ")")
    if method == "start":
        lines.append("        self.count_tracks(mean)")
    call = "self.start_track" if method == "start" else "return self.update_track"
    lines.append(textwrap.indent(pairs, " " * 8))
    lines.append(textwrap.indent(f"{call}({_given(text, given)})", " " * 8))
    return "\n".join(lines)
