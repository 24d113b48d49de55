"""Reading of JSON files, with checks of their types and limits."""

import types
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints, is_typeddict

from ...envs.contract.parameters import quote_shortened
from ...envs.data import foreign_files

Stored = TypeVar("Stored")


def read_json(path: Path) -> Any:
    """Read a JSON file, with checks of its size and nesting; return Python values.

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if it cannot be read, or breaks a limit of :mod:`~filtergym.envs.data.foreign_files`.
    """
    try:
        return foreign_files.read_json(path)
    except FileNotFoundError:
        raise
    except ValueError as error:
        raise ValueError(f"cannot read {path}: {error}") from error


def restore(cls: type[Stored], values: Any) -> Stored:
    """Make a dataclass or named tuple from a dictionary of its fields; raise ValueError for wrong fields or
    types.
    """
    if not isinstance(values, dict):
        raise ValueError(f"expected the fields of a {cls.__name__}, got {quote_shortened(values)}")
    try:
        found = cls(**values)
    except TypeError as error:
        raise ValueError(str(error)) from error
    for name, hint in get_type_hints(cls).items():
        value = getattr(found, name)
        if not has_type(value, hint):
            raise ValueError(
                f"{name} must be {getattr(hint, '__name__', hint)}, got {quote_shortened(value)}"
            )
    return found


def has_type(value: Any, hint: Any) -> bool:
    """Return whether a value read from JSON has the type of a hint; an integer also counts as a float."""
    origin, of = get_origin(hint), get_args(hint)
    if hint is Any:
        return True
    if origin is types.UnionType:
        return any(has_type(value, other) for other in of)
    if origin is list:
        return isinstance(value, list) and all(has_type(item, of[0]) for item in value)
    if origin is dict:
        return isinstance(value, dict) and all(has_type(item, of[1]) for item in value.values())
    if is_typeddict(hint):
        hints = get_type_hints(hint)
        return (
            isinstance(value, dict)
            and hint.__required_keys__ <= value.keys() <= hints.keys()
            and all(has_type(item, hints[name]) for name, item in value.items())
        )
    if isinstance(value, bool):
        return hint is bool
    return isinstance(value, int | float if hint is float else hint)
