"""The tables of an environment's page, made from the texts in its code."""

import inspect
import typing
from typing import Any

from filtergym.baselines.problem import Problem
from filtergym.envs.contract.causes import Causes
from filtergym.envs.contract.companions import action_meanings
from filtergym.envs.contract.model import Model
from filtergym.envs.contract.observation import Block
from filtergym.envs.contract.parameters import ParameterLimits, field_limits
from filtergym.envs.contract.task import Task, field_texts
from filtergym.envs.engine.backend import make_model
from filtergym.envs.engine.catalogue import catalogue, nearest
from filtergym.papers.grid import markdown_table

PARTS_SHOWN = 4
"""Largest number of fields of a block that are named one by one; of more, the endings are named."""


def field_documentation(cls: type) -> dict[str, str]:
    """Return the docstring of each field of a NamedTuple or dataclass, in one line, by name, inherited ones first."""
    texts = (item for base in reversed(cls.__mro__) for item in field_texts(base).items())
    return {name: text.replace("``", "`") for name, text in texts}


def measurement_class(cls: type[Task]) -> Any:
    """Return the NamedTuple of a task's measurements, from the type of its world's result."""
    return typing.get_args(typing.get_type_hints(cls.World.advance)["return"])[1]


def _space(model: Model) -> str:
    space: Any = model.action_space
    if hasattr(space, "n"):
        return f"`Discrete({space.n})`"
    return f"`Box({space.low.min():g}, {space.high.max():g}, {space.shape})`"


def _actions(cls: type[Task]) -> list[str]:
    rows = []
    for control in cls.controls:
        role = " (default)" if control == cls.controls[0] else ""
        rows.append(
            (f"`{control}`{role}", _space(make_model(cls, control)), action_meanings(cls).get(control, ""))
        )
    return markdown_table(("control", "space", "meaning"), rows)


def _names(block: Block) -> str:
    if not block.parts:
        return f"`{block.name}`"
    if len(block.parts) <= PARTS_SHOWN:
        return ", ".join(f"`{block.name}_{part}`" for part in block.parts)
    return f"`{block.name}` ending in " + ", ".join(f"`_{part}`" for part in block.parts)


def _fields(cls: type[Task]) -> list[str]:
    lines: list[str] = []
    tables: dict[tuple[Any, ...], list[str]] = {}
    models = {control: make_model(cls, control) for control in cls.controls}
    for control, model in models.items():
        tables.setdefault(model.fields, []).append(control)
    for fields, controls in tables.items():
        named = ", ".join(f"`{control}`" for control in controls)
        rows = [
            (
                _names(block),
                block.unit,
                block.compression.text
                + block.text
                + (" (mean over the interval)" if block.over_interval == "mean" else ""),
            )
            for block in models[controls[0]].filter.blocks
        ]
        lines += [
            "",
            f"{named} ({len(fields)} fields):",
            "",
            *markdown_table(("field", "unit", "what it is"), rows),
        ]
        quantities = models[controls[0]].filter.quantities
        if quantities:
            readable = "; ".join(f"`{q.name}`, {q.unit}: {q.text}" for q in quantities)
            lines += ["", f"Read from them by `model.reader(NAME)`: {readable}."]
    return lines[1:]


def _measurement(cls: type[Task]) -> list[str]:
    rows = [(f"`{name}`", text) for name, text in field_documentation(measurement_class(cls)).items()]
    return markdown_table(("field", "meaning"), rows)


def _limits(limits: ParameterLimits) -> str:
    if limits.choices:
        return ", ".join(f'`"{choice}"`' for choice in limits.choices)
    signs = {"above": ">", "at_least": "≥", "below": "<", "at_most": "≤"}
    parts = [
        f"{sign} {getattr(limits, name):g}"
        for name, sign in signs.items()
        if getattr(limits, name) is not None
    ]
    parts += ["ascending"] if limits.ascending else []
    parts += ["sums to 1"] if limits.stochastic else []
    return ", ".join(parts)


def _parameters(cls: type[Task]) -> list[str]:
    texts, defaults = field_documentation(cls.Parameters), cls.Parameters()
    rows = [
        (f"`{name}`", f"`{getattr(defaults, name)!r}`", _limits(limits), texts[name])
        for name, (_, limits) in field_limits(cls.Parameters).items()
    ]
    return markdown_table(("keyword", "default", "limits", "meaning"), rows)


def _scenarios(cls: type[Task]) -> list[str]:
    rows = [
        (f"`{s.name}`", "training" if s.training else "held out", s.description)
        for s in cls.scenarios.values()
    ]
    return markdown_table(("scenario", "role", "what happens"), rows)


def _first_sentence(maker: Any) -> str:
    paragraph = (inspect.getdoc(maker) or "").partition("\n\n")[0]
    return " ".join(paragraph.split()).replace("``", "`")


def _policies(problem: Problem) -> list[str]:
    known = problem.baselines
    roles = {known.compared_paper: " (score 0)", known.score_reference: " (score 1)"}
    rows = []
    for name, maker in known.policies.items():
        rows.append(
            (f"`{name}`{roles.get(name, '')}", getattr(maker, "control", "any"), _first_sentence(maker))
        )
    for name, maker in known.estimators.items():
        rows.append((f"`{name}`", "(estimator)", _first_sentence(maker)))
    for name, maker in known.smoothers.items():
        text = f"{_first_sentence(maker)} Not causal: it uses later measurements."
        rows.append((f"`{name}`", "(smoother)", text))
    for kind, table in (("reference", known.references), ("bound", known.bounds)):
        for name, maker in table.items():
            text = f"{_first_sentence(maker)} Knows {maker.knows}."
            rows.append((f"`{name}`{roles.get(name, '')}", f"({kind})", text))
    return markdown_table(("name", "control", "what it does"), rows)


TABLES = {
    "actions": _actions,
    "fields": _fields,
    "measurement": _measurement,
    "parameters": _parameters,
    "scenarios": _scenarios,
}
"""Functions that make a task's tables in Markdown, by the tables' names."""


def causes_table() -> str:
    """Return a Markdown table of the causes to which evaluations attribute costs, in all environments."""
    rows = []
    for cls in catalogue().values():
        causes = Causes.of(cls(cls.Parameters())).causes
        rows.append((cls.__name__, "; ".join(f"`{cause.name}`, {cause.phrase}" for cause in causes)))
    rows.append(("all", "`start`, the start of the track; `other`, what remains"))
    return "\n".join(markdown_table(("environment", "causes"), rows))


def environment_table(problem: Problem, name: str) -> str:
    """Return the table ``name`` (such as actions, fields) of an environment in Markdown.

    Raises:
        ValueError: if there is no table of that name.
    """
    if name == "policies":
        return "\n".join(_policies(problem))
    if name not in TABLES:
        raise nearest("table", name, [*TABLES, "policies"])
    return "\n".join(TABLES[name](problem.task))
