"""The definitions that a piece of code needs: functions, classes and constants of this package, as they are written.

Code is followed statically. A name leads to the function, class or constant that it stands for, in whatever module; an
attribute to every method and property of that name in the classes of the objects at hand (rapid type analysis). What
is found is written as it stands in its module, with docstrings, equations and comments; of a class nothing else is
written. Names of modules become part of those of their functions: ``imm.mix`` is ``imm_mix``.
"""

import __future__

import ast
import dataclasses
import dis
import functools
import importlib.util
import inspect
import sys
import types
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

ARRAYS = "filtergym.filters.array_namespace"
SIMPLER = {
    (ARRAYS, "namespace"): '''def namespace(array: Array) -> Any:
    """Return the functions of arrays: NumPy's."""
    return numpy''',
}
"""Functions that are simpler where there is NumPy alone, by module and name."""
SIMPLER_METHODS = {
    ("filtergym.envs.contract.task", "Task", "constant"): '''    def constant(self, values: Any) -> Array:
        """Turn numbers into an array."""
        return numpy.asarray(values, dtype=numpy.float64)''',
}
"""Methods likewise, by module, class and name."""
DROPPED_BASES = ("ABC", "Generic", "Protocol", "object")
SPACE = "action_space"
"""Property whose value is written, not its code, which takes Gymnasium."""


class ExportError(ValueError):
    """What is reached takes more than Python and NumPy."""


class Key(NamedTuple):
    """One definition."""

    module: str
    name: str


class External(NamedTuple):
    """An import from Python's library or NumPy."""

    module: str
    attribute: str | None
    name: str

    def __str__(self) -> str:
        """Return it as a statement."""
        if self.attribute is None:
            return f"import {self.module}" + ("" if self.module == self.name else f" as {self.name}")
        alias = "" if self.attribute == self.name else f" as {self.name}"
        return f"from {self.module} import {self.attribute}{alias}"


@functools.cache
def code_nodes(node: ast.AST) -> tuple[ast.AST, ...]:
    """Nodes that are executed: all but annotations."""
    return tuple(_walk_code(node))


def _walk_code(node: ast.AST) -> Iterator[ast.AST]:
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _walk_code(child)


def annotations(node: ast.AST) -> Iterator[ast.AST]:
    """Annotations in a piece of code."""
    for each in ast.walk(node):
        for name in ("annotation", "returns"):
            found = getattr(each, name, None)
            if found is not None:
                yield found


@functools.cache
def global_names(node: ast.stmt | ast.expr) -> frozenset[str]:
    """Names that a piece of code looks up outside of itself."""
    statement = ast.Expr(node) if isinstance(node, ast.expr) else node
    module = ast.fix_missing_locations(ast.Module([statement], []))
    code = compile(module, "", "exec", __future__.annotations.compiler_flag, dont_inherit=True)
    found, waiting = set(), [code]
    while waiting:
        code = waiting.pop()
        waiting += [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]
        for instruction in dis.get_instructions(code):
            if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS"):
                found.add(instruction.argval)
    return frozenset(found)


class Source:
    """Text and tree of a module, by the names that it defines and imports."""

    def __init__(self, name: str) -> None:
        self.name = name
        module = importlib.import_module(name)
        self.text = inspect.getsource(module)
        self.lines = self.text.splitlines()
        self.tree = ast.parse(self.text)
        self.documentation = (ast.get_docstring(self.tree) or "").strip()
        package = module.__package__ or name
        self.definitions: dict[str, tuple[ast.stmt, int]] = {}
        """Statement and its last line, that of a docstring after it."""
        self.imports: dict[str, tuple[str, str | None]] = {}
        body = self.tree.body
        for i, statement in enumerate(body):
            for defined in _defined_names(statement):
                self.definitions[defined] = statement, _last_line(body, i)
            for alias in getattr(statement, "names", ()) if isinstance(statement, ast.Import) else ():
                whole = alias.name if alias.asname else alias.name.partition(".")[0]
                self.imports[alias.asname or whole] = whole, None
            if isinstance(statement, ast.ImportFrom):
                path = "." * statement.level + (statement.module or "")
                origin = importlib.util.resolve_name(path, package) if statement.level else path
                for alias in statement.names:
                    self.imports[alias.asname or alias.name] = origin, alias.name

    def imported(self, name: str) -> tuple[str, str | None] | None:
        """Module and attribute that an imported name stands for; the attribute is None where it is a module."""
        if name not in self.imports:
            return None
        module, attribute = self.imports[name]
        if attribute is not None and isinstance(sys.modules.get(f"{module}.{attribute}"), types.ModuleType):
            return f"{module}.{attribute}", None
        return module, attribute


@functools.cache
def source_of(name: str) -> Source:
    """Return the source of a module.

    Raises:
        ExportError: if there is none, as of a module that was typed in.
    """
    try:
        return Source(name)
    except (OSError, TypeError, ModuleNotFoundError) as error:
        raise ExportError(f"the source of module {name} cannot be read: {error}") from None


def _defined_names(statement: ast.stmt) -> list[str]:
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return [statement.name]
    if isinstance(statement, ast.Assign):
        targets = [node for target in statement.targets for node in ast.walk(target)]
        return [node.id for node in targets if isinstance(node, ast.Name)]
    if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
        return [statement.target.id] if statement.value is not None else []
    return []


def _last_line(body: list[ast.stmt], i: int) -> int:
    """Last line of a statement, or of the docstring of a constant after it."""
    following = body[i + 1] if i + 1 < len(body) else None
    is_text = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
    if is_text and isinstance(body[i], ast.Assign | ast.AnnAssign):
        return following.end_lineno or 0  # type: ignore[union-attr]
    return body[i].end_lineno or 0


def first_line(statement: ast.stmt) -> int:
    """First line of a statement, that of its decorators."""
    return min([statement.lineno, *(d.lineno for d in getattr(statement, "decorator_list", ()))])


@functools.cache
def members_of(cls: type) -> dict[str, tuple[ast.stmt, int]]:
    """Statements in the body of a class by name, with their last lines."""
    body = class_statement(cls).body
    members = {}
    for i, statement in enumerate(body):
        names = _defined_names(statement)
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            names = [statement.target.id]
        for name in names:
            members[name] = statement, _last_line(body, i)
    return members


def class_statement(cls: type) -> ast.ClassDef:
    """Return where a class is defined.

    Raises:
        ExportError: if that is no statement of a module.
    """
    found = source_of(cls.__module__).definitions.get(cls.__qualname__)
    if found is None or not isinstance(found[0], ast.ClassDef):
        raise ExportError(
            f"class {cls.__qualname__} of {cls.__module__} is not defined at the top of its module"
        )
    return found[0]


def is_named_tuple(cls: type) -> bool:
    """Whether this is a NamedTuple."""
    return issubclass(cls, tuple) and hasattr(cls, "_fields")


def _is_abstract(statement: ast.stmt) -> bool:
    decorators = getattr(statement, "decorator_list", ())
    return any(isinstance(d, ast.Name) and d.id == "abstractmethod" for d in decorators)


class Definitions:
    """Definitions that some code needs, found from it transitively.

    Args:
        packages: names of the packages whose definitions are written out; the rest is imported.
    """

    def __init__(self, packages: Iterable[str]) -> None:
        self.packages = set(packages)
        self.keys: set[Key] = set()
        self.externals: set[External] = set()
        self.attributes: set[str] = set()
        """Names of attributes that are read."""
        self.reads: set[tuple[str, str]] = set()
        """Names before a dot, and of the attribute after it."""
        self.task_names = {"task"}
        """Names that stand for tasks, and for worlds: what is read of these is written, and nothing else."""
        self.shared_attributes: set[str] = set()
        """Names of attributes that are read of them."""
        self.words: set[str] = set()
        """Strings that could be names of attributes."""
        self.members: set[tuple[type, str]] = set()
        self.concrete: set[type] = set()
        """Classes of objects."""
        self.instantiated: set[type] = set()
        self.tasks: set[type] = set()
        """Classes of tasks: of these only what is read of a task is written."""
        self.parameters: set[type] = set()
        """Classes of parameters: their fields are written with the values in force."""
        self._seen: set[tuple[str, int]] = set()

    @property
    def size(self) -> int:
        """Of what was found; it no longer grows when all is."""
        names: Any = (
            self.keys,
            self.attributes,
            self.shared_attributes,
            self.task_names,
            self.words,
            self.members,
        )
        return (
            sum(len(found) for found in names)
            + len(self.concrete)
            + len(self.externals)
            + len(self.instantiated)
        )

    def is_own(self, module: str) -> bool:
        """Whether definitions of a module are written out."""
        return module.partition(".")[0] in self.packages

    def resolve(self, module: str, name: str) -> Key | External | str | None:
        """Return what a global name of a module stands for: a definition, an import, a module of the packages by its
        name, or None for what Python itself has.

        Raises:
            ExportError: for what another library has.
        """
        source = source_of(module)
        if name == "Array":
            return None  # written once, whatever module has it
        if name in source.definitions:
            return Key(module, name)
        found = source.imported(name)
        if found is None:
            return None
        origin, attribute = found
        if self.is_own(origin):
            return origin if attribute is None else self.resolve(origin, attribute)
        root = origin.partition(".")[0]
        if root != "numpy" and root not in sys.stdlib_module_names:
            raise ExportError(f"{module} takes {root}, and the file is to need NumPy only")
        return External(origin, attribute, name)

    def add_code(self, module: str, node: ast.stmt | ast.expr, own_class: type | None = None) -> None:
        """Add what a piece of code needs.

        Args:
            module: where it stands.
            node: the code.
            own_class: class whose method it is.
        """
        if (module, id(node)) in self._seen:
            return
        self._seen.add((module, id(node)))
        names = global_names(node)
        for each in code_nodes(node):
            if isinstance(each, ast.Attribute):
                self._add_attribute(module, each, names, own_class)
            elif isinstance(each, ast.Constant) and isinstance(each.value, str):
                self.words |= {each.value} if each.value.isidentifier() else set()
            elif isinstance(each, ast.Call):
                self._add_call(module, each.func, names)
            elif isinstance(each, ast.Import | ast.ImportFrom):
                self._check_import(module, each)
        for name in names:
            self._add_found(self.resolve(module, name))

    def _check_import(self, module: str, node: ast.Import | ast.ImportFrom) -> None:
        """Refuse an import inside a function of anything but NumPy and Python's library."""
        relative = isinstance(node, ast.ImportFrom) and (node.level or not node.module)
        names = (
            [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
        )
        roots = {name.partition(".")[0] for name in names}
        if relative or not roots <= {"numpy", *sys.stdlib_module_names}:
            raise ExportError(f"{module} imports inside a function: {ast.unparse(node)}")

    def _add_attribute(
        self, module: str, node: ast.Attribute, names: frozenset[str], own_class: type | None
    ) -> None:
        owner = node.value
        if isinstance(owner, ast.Name) and owner.id in names:
            found = self.resolve(module, owner.id)
            if isinstance(found, str):
                self._add_found(self.resolve(found, node.attr))
                return
            if isinstance(found, External) and found.attribute is None:
                return
        if node.attr.startswith("__"):
            return  # what is overridden is found with what overrides it
        self.attributes.add(node.attr)
        self.reads.add((str(getattr(owner, "id", getattr(owner, "attr", ""))), node.attr))
        is_task = own_class is not None and any(issubclass(task, own_class) for task in self.tasks)
        if getattr(owner, "id", None) == "self" and is_task:
            self.shared_attributes.add(node.attr)

    def _add_call(self, module: str, function: ast.expr, names: frozenset[str]) -> None:
        key = self._key_of(module, function, names)
        if key is not None:
            made = getattr(sys.modules[key.module], key.name, None)
            if isinstance(made, type):
                self.instantiated.add(made)

    def _key_of(self, module: str, node: ast.expr, names: frozenset[str]) -> Key | None:
        """Definition that an expression names; None where it is none."""
        if isinstance(node, ast.Name) and node.id in names:
            found = self.resolve(module, node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in names:
            found = self.resolve(module, node.value.id)
            found = self.resolve(found, node.attr) if isinstance(found, str) else None
        else:
            return None
        return found if isinstance(found, Key) else None

    def _add_found(self, found: Key | External | str | None) -> None:
        if isinstance(found, External):
            self.externals.add(found)
        elif isinstance(found, Key):
            self.add(found)

    def add(self, key: Key) -> None:
        """Add a definition and what it needs."""
        if key in self.keys:
            return
        self.keys.add(key)
        if key in SIMPLER:
            self.externals.add(External("numpy", None, "numpy"))
            return
        statement = source_of(key.module).definitions[key.name][0]
        if isinstance(statement, ast.ClassDef):
            self.add_class(getattr(sys.modules[key.module], key.name))
        else:
            self.add_code(key.module, statement)

    def add_class(self, cls: type) -> None:
        """Add a class of which there may be objects; of its members only what is asked for by name."""
        if cls in self.concrete or not self.is_own(cls.__module__):
            return
        statement = class_statement(cls)
        self.concrete.add(cls)
        self.keys.add(Key(cls.__module__, cls.__name__))
        if cls in self.tasks | self.parameters:
            return
        for decorator in statement.decorator_list:
            self.add_code(cls.__module__, decorator)
        if is_named_tuple(cls) or dataclasses.is_dataclass(cls):
            if is_named_tuple(cls):
                self.externals.add(External("typing", "NamedTuple", "NamedTuple"))
            for part in statement.body:
                if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
                    self._add_member(cls, part.target.id, part)

    def add_members(self) -> None:
        """Add the members of the classes that the attributes name."""
        self.shared_attributes |= {name for owner, name in self.reads if owner in self.task_names}
        for cls in sorted(self.concrete, key=lambda cls: (cls.__module__, cls.__name__)):
            named = self.shared_attributes if cls in self.tasks else self.attributes
            names = {*named, "__call__"} | ({"__init__"} if cls in self.instantiated else set())
            for name in sorted(names - {SPACE}):
                self._add_inherited(cls, name)

    def _add_inherited(self, cls: type, name: str) -> None:
        """Add the member of a class that an attribute means, and what that overrides if it asks for it."""
        constant = cls in self.tasks | self.parameters
        if constant and isinstance(
            inspect.getattr_static(cls, name, None), property | functools.cached_property
        ):
            return  # its value is written
        for base in cls.__mro__:
            if not self.is_own(base.__module__):
                continue
            member = members_of(base).get(name)
            if member is None or _is_abstract(member[0]):
                continue
            if isinstance(member[0], ast.AnnAssign) and member[0].value is None:
                continue
            if constant and not isinstance(member[0], ast.FunctionDef):
                return
            self._add_member(base, name, member[0])
            if "super()" not in ast.unparse(member[0]):
                return

    def _add_member(self, cls: type, name: str, statement: ast.stmt) -> None:
        if (cls, name) in self.members:
            return
        self.members.add((cls, name))
        self.keys.add(Key(cls.__module__, cls.__name__))
        if (cls.__module__, cls.__name__, name) in SIMPLER_METHODS:
            return
        if isinstance(statement, ast.AnnAssign):
            if statement.value is not None:
                self.add_code(cls.__module__, statement.value)
        else:
            self.add_code(cls.__module__, statement, cls)

    def written_members(self, cls: type) -> list[tuple[ast.stmt, int]]:
        """Statements of a class that are written, in their order."""
        found = {
            id(members_of(cls)[name][0]): members_of(cls)[name]
            for owner, name in self.members
            if owner is cls
        }
        return sorted(found.values(), key=lambda member: member[0].lineno)
