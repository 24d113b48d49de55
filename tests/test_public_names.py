"""What docs/stability.md promises of public names: a page of the reference shows each, with every argument."""

import importlib
import inspect
import re
from pathlib import Path

import pytest

import filtergym

DOCS = Path(__file__).parent.parent / "docs"
DIRECTIVE = re.compile(r"\.\. auto(\w+):: (\S+)\n((?:   :.*\n)*)")
SHOWN = {
    name: (kind, options)
    for page in sorted((DOCS / "api").glob("*.md"))
    for kind, name, options in DIRECTIVE.findall(page.read_text(encoding="utf-8"))
}
"""What pages of the reference show, with the kind of directive and its options."""
ELSEWHERE = {
    "Flights": "filtergym.envs.logs.flights",
    "Likelihood": "filtergym.envs.contract.filter",
    "Recording": "filtergym.envs.data.recording",
    "Trajectory": "filtergym.envs.data.trajectory",
}
"""Names of the front door that the reference shows with their module."""


def resolve(name):
    words = name.split(".")
    for count in range(len(words), 0, -1):
        try:
            found = importlib.import_module(".".join(words[:count]))
        except ImportError:
            continue
        for word in words[count:]:
            found = getattr(found, word)
        return found
    raise ImportError(name)


def undocumented(function, text):
    """Names of arguments that the text does not describe."""
    names = [name for name in inspect.signature(function).parameters if name not in ("self", "cls")]
    return [name for name in names if not re.search(rf"^ *\*{{0,2}}{name}:", text, re.M)]


def functions_of_the_front_door():
    page = (DOCS / "api" / "front_door.md").read_text(encoding="utf-8")
    for kind, name, options in DIRECTIVE.findall(page):
        members = re.search(r":members: (\S.*)", options)
        if kind == "function":
            yield name
        elif kind == "module" and members:
            yield from (f"{name}.{member.strip()}" for member in members[1].split(","))


def test_every_name_of_the_package_is_on_a_page_of_the_reference():
    hidden = [name for name in filtergym.__all__ if f"filtergym.{name}" not in SHOWN]
    assert [name for name in hidden if ELSEWHERE[name] not in SHOWN] == []


def test_every_argument_of_a_function_is_described():
    for name in functions_of_the_front_door():
        found = resolve(name)
        words = inspect.getdoc(found)
        assert words, name
        assert not inspect.isfunction(found) or undocumented(found, words) == [], name


@pytest.mark.parametrize("name", ["FunctionPolicy", "Input", "Sensor"])
def test_every_argument_of_a_class_is_described(name):
    found = getattr(filtergym, name)
    words = inspect.getsource(found)
    for argument in inspect.signature(found).parameters:
        described = re.search(
            rf"^ +{argument}: .*\n +\"\"\"", words, re.M
        )  # a field, and below it what it means
        assert described or not undocumented(found, inspect.getdoc(found)), argument


def test_the_reference_shows_no_private_name():
    shown = [*SHOWN, *functions_of_the_front_door()]
    assert len(shown) > 80
    assert [name for name in shown if any(word.startswith("_") for word in name.split("."))] == []
