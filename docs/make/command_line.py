"""The page of the command line, made from the commands themselves."""

import inspect
from collections.abc import Callable
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin

from filtergym.__main__ import GROUPS, application, import_command
from filtergym.papers.grid import markdown_table

KINDS = {str: "TEXT", int: "INTEGER", float: "NUMBER", Path: "PATH"}


def command_functions() -> dict[str, Callable[..., None]]:
    """Return the function of each command of ``filtergym``, by its name."""
    return {name: import_command(own) for commands in GROUPS.values() for name, own in commands.items()}


def command_line_markdown() -> str:
    """Return the ``--help`` of every command in Markdown, as sections of a page."""
    program = application()
    lines = [*_options(_general_options(program), program.callback)]
    for name, function in command_functions().items():
        what, *examples = inspect.cleandoc(function.__doc__ or "").split("\n\nExample: ")
        # Help that is folded is shown unfolded; of an example that is two commands each has its line.
        shown = [line for one in examples for line in " ".join(one.split()).split(", then ")]
        paragraphs = [" ".join(paragraph.split()) for paragraph in what.split("\n\n")]
        lines += ["", f"## {name}", "", "\n\n".join(paragraphs)]
        lines += ["", "```sh", *shown, "```", "", *_options(program.get_command(None, name).params, function)]
    return "\n".join(lines)


def _general_options(program: Any) -> list[Any]:
    """Return the program's own options, before the command, without those of the shell's completion."""
    return [parameter for parameter in program.params if parameter.name in ("version", "no_cache")]


def _options(parameters: list[Any], function: Callable[..., Any]) -> list[str]:
    annotations = {name: p.annotation for name, p in inspect.signature(function).parameters.items()}
    rows = []
    for parameter in parameters:
        option = parameter.opts[0].startswith("-")
        kind = _kind(annotations.get(parameter.name, bool))
        shown = parameter.opts[0] if option else parameter.name.upper()
        if option and kind != "bool":
            shown += f" {kind}"
        names = [f"`{shown}`", *(f"`{other}`" for other in parameter.secondary_opts)]
        rows.append([", ".join(names), _default(parameter, kind), " ".join((parameter.help or "").split())])
    return markdown_table(("argument or option", "default", "what it is"), rows)


def _kind(annotation: Any) -> str:
    if hasattr(annotation, "__metadata__"):
        annotation = annotation.__origin__
    if get_origin(annotation) is UnionType:
        [annotation] = [member for member in get_args(annotation) if member is not NoneType]
    if get_origin(annotation) is list:
        [annotation] = get_args(annotation)
    return KINDS.get(annotation, "bool")


def _default(parameter: Any, kind: str) -> str:
    if parameter.required:
        return "needed"
    several = "several" if parameter.multiple or parameter.nargs == -1 else ""
    if kind == "bool" or parameter.default in (None, "", [], ()):
        return several or ("yes" if parameter.default is True else "")
    return f"`{parameter.default}`"
