"""Definitions as the text of one module: sections by the module that they stand in, names without those of modules."""

import ast
import sys
from collections import Counter, defaultdict
from typing import Any, NamedTuple

from .definitions import (
    DROPPED_BASES,
    SIMPLER,
    SIMPLER_METHODS,
    Definitions,
    ExportError,
    External,
    Key,
    Source,
    annotations,
    class_statement,
    code_nodes,
    first_line,
    global_names,
    is_named_tuple,
    members_of,
    source_of,
)

WIDTH = 110


class _Edit(NamedTuple):
    """A name that changes."""

    row: int
    """Of its module, from 1 on."""
    start: int
    """First byte in the row."""
    end: int
    old: str
    """Empty where it does not matter."""
    new: str


def module_order(modules: set[str], definitions: Definitions) -> list[str]:
    """Modules so that each comes after those that it imports."""
    done: list[str] = []
    waiting: set[str] = set()

    def visit(module: str) -> None:
        if module in done or module in waiting:
            return
        waiting.add(module)
        source = source_of(module)
        for name in source.imports:
            origin, attribute = source.imported(name) or ("", None)
            for needed in (origin, f"{origin}.{attribute}"):
                if definitions.is_own(needed) and isinstance(sys.modules.get(needed), type(sys)):
                    visit(needed)
        waiting.remove(module)
        done.append(module)

    for module in sorted(modules):
        visit(module)
    return [module for module in done if module in modules]


class DefinitionText:
    """Writes definitions.

    Args:
        definitions: all that is needed.
        reserved: names that the file uses for something else.
    """

    def __init__(self, definitions: Definitions, reserved: set[str]) -> None:
        self.definitions = definitions
        self.names = self._choose_names(reserved)
        self.parameter_values: dict[type, dict[str, str]] = {}
        """Of each class of parameters: fields and their values as text."""

    # --- names

    def _choose_names(self, reserved: set[str]) -> dict[Key, str]:
        """Name of every definition in the file: its own, with its module's where that is taken or says what it is."""
        keys = self.definitions.keys
        counts = Counter(key.name for key in keys)
        taken = reserved | {found.name for found in self.definitions.externals}
        qualified = self._qualified_functions()
        names = {}
        for key in sorted(keys):
            plain = counts[key.name] == 1 and key.name not in taken and key not in qualified
            names[key] = key.name if plain else f"{key.module.rpartition('.')[2].strip('_')}_{key.name}"
        again = Counter(names.values())
        for key, name in names.items():
            if again[name] > 1 or (name != key.name and name in taken | set(counts)):
                names[key] = key.module.replace(".", "_") + "_" + key.name
        return names

    def _qualified_functions(self) -> set[Key]:
        """Functions that are called by the name of their module, as in ``kalman.update``."""
        found = set()
        for module, node in self._pieces():
            names = global_names(node)
            keys = {self._attribute_key(module, each, names) for each in code_nodes(node)} - {None}
            found |= {key for key in keys if key is not None and not key.name[:1].isupper()}
        return found

    def _pieces(self) -> list[tuple[str, ast.stmt]]:
        """Every piece of code that is written, with its module."""
        pieces: list[tuple[str, ast.stmt]] = []
        for key in self.definitions.keys - SIMPLER.keys():
            statement = source_of(key.module).definitions[key.name][0]
            if isinstance(statement, ast.ClassDef):
                cls = getattr(sys.modules[key.module], key.name)
                pieces += [(key.module, member) for member, _ in self.definitions.written_members(cls)]
            else:
                pieces.append((key.module, statement))
        return pieces

    def _attribute_key(self, module: str, node: ast.AST, names: frozenset[str]) -> Key | None:
        """Definition that an attribute of a module is."""
        if not (isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)):
            return None
        if node.value.id not in names:
            return None
        found = self.definitions.resolve(module, node.value.id)
        found = self.definitions.resolve(found, node.attr) if isinstance(found, str) else None
        return found if isinstance(found, Key) else None

    def name_of(self, module: str, name: str) -> str:
        """Name in the file of a definition."""
        return self.names[Key(module, name)]

    # --- text

    def expression(self, module: str, node: ast.expr) -> str:
        """Return an expression of a module, with the names that the file has."""
        source = source_of(module)
        lines = self._edited(source, node, node.lineno, node.end_lineno or 0).splitlines()
        after = len(source.lines[(node.end_lineno or 0) - 1].encode()) - (node.end_col_offset or 0)
        lines[-1] = lines[-1].encode()[: len(lines[-1].encode()) - after].decode()
        lines[0] = lines[0].encode()[node.col_offset :].decode()
        return "\n".join(lines)

    def parameters_text(self) -> str:
        """Return the classes of parameters, with the values in force."""
        classes = sorted(self.definitions.parameters, key=lambda cls: cls.__name__)
        return "\n\n\n".join(self._class(cls, source_of(cls.__module__)) for cls in classes)

    def text(self) -> str:
        """Return all other definitions, a section for each module."""
        by_module: dict[str, list[Key]] = defaultdict(list)
        elsewhere = {Key(cls.__module__, cls.__name__) for cls in self.definitions.parameters}
        for key in self.definitions.keys - elsewhere:
            by_module[key.module].append(key)
        sections = []
        for module in module_order(set(by_module), self.definitions):
            source = source_of(module)
            keys = sorted(by_module[module], key=lambda key: source.definitions[key.name][0].lineno)
            statements = {id(source.definitions[key.name][0]): key for key in keys}
            parts = [self._definition(key) for key in statements.values()]
            parts = [part for part in parts if part]
            if parts:
                sections.append("\n\n\n".join([_heading(source), *parts]))
        return "\n\n\n".join(sections)

    def _definition(self, key: Key) -> str:
        if key in SIMPLER:
            return SIMPLER[key]
        source = source_of(key.module)
        statement, last = source.definitions[key.name]
        if isinstance(statement, ast.ClassDef):
            return self._class(getattr(sys.modules[key.module], key.name), source)
        text = self._edited(source, statement, first_line(statement), last)
        if isinstance(statement, ast.FunctionDef):
            name = self.names[key]
            text = text.replace(f"def {key.name}(", f"def {name}(", 1)
        elif self.names[key] != key.name:
            if not text.startswith((f"{key.name} =", f"{key.name}:")):
                raise ExportError(f"{key.name} of {key.module} cannot be given another name")
            text = self.names[key] + text.removeprefix(key.name)
        return text

    def _class(self, cls: type, source: Source) -> str:
        """A class with the members that are needed."""
        statement, constant = class_statement(cls), cls in self.definitions.parameters
        bases = [] if constant else self.written_bases(cls)
        decorators = [self._edited(source, d, d.lineno, d.end_lineno or 0) for d in statement.decorator_list]
        head = f"class {self.name_of(cls.__module__, cls.__name__)}"
        lines = (
            ["@dataclass(frozen=True)"]
            if constant
            else [f"@{text.strip().lstrip('@')}" for text in decorators]
        )
        lines.append(f"{head}({', '.join(bases)}):" if bases else f"{head}:")
        lines.append(self._class_docstring(cls, statement, source))
        if constant:
            lines += ["", *self._parameter_fields(cls)]
        before: Any = None
        for owner, (member, last) in self._members(cls):
            if isinstance(member, ast.FunctionDef) or isinstance(before, ast.FunctionDef | None):
                lines.append("")
            simpler = SIMPLER_METHODS.get((owner.__module__, owner.__name__, getattr(member, "name", "")))
            written = self._edited(source_of(owner.__module__), member, first_line(member), last)
            lines.append(simpler or written)
            before = member
        return "\n".join(lines)

    def _members(self, cls: type) -> list[tuple[type, tuple[ast.stmt, int]]]:
        """Statements of a class that are written, with the class that they are of; of parameters with the inherited."""
        classes = cls.__mro__ if cls in self.definitions.parameters else (cls,)
        own = [owner for owner in classes if self.definitions.is_own(owner.__module__)]
        return [(owner, member) for owner in own for member in self.definitions.written_members(owner)]

    def _class_docstring(self, cls: type, statement: ast.ClassDef, source: Source) -> str:
        first = statement.body[0]
        if cls in self.definitions.tasks:
            return '    """Constants that the parts of the filter share."""'
        if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
            return "\n".join(source.lines[first.lineno - 1 : first.end_lineno])
        return f'    """{cls.__name__}."""'

    def _parameter_fields(self, cls: type) -> list[str]:
        """Fields of the parameters that are read, each with the value in force and what it is."""
        lines = []
        for name, text in self.parameter_values[cls].items():
            lines.append(f"    {name}: Any = {text}")
            for owner in cls.__mro__:
                member = members_of(owner).get(name) if self.definitions.is_own(owner.__module__) else None
                if member is not None:
                    source, statement = source_of(owner.__module__), member[0]
                    if isinstance(statement, ast.FunctionDef):
                        lines.append(f'    """{(ast.get_docstring(statement) or name).splitlines()[0]}"""')
                    else:
                        lines += source.lines[statement.end_lineno or 0 : member[1]]
                    break
        return lines

    def written_bases(self, cls: type) -> list[str]:
        """Bases of a class that are written, in their order; those of bases that are not, in their place."""
        if is_named_tuple(cls):
            return ["NamedTuple"]
        bases: list[str] = []
        for base in cls.__bases__:
            if base.__name__ in DROPPED_BASES:
                continue
            own = self.definitions.is_own(base.__module__)
            written = own and Key(base.__module__, base.__name__) in self.names
            found = [self.name_of(base.__module__, base.__name__)] if written else self.written_bases(base)
            bases += [name for name in found if name not in bases]
        return bases

    def _edited(self, source: Source, node: ast.AST, first: int, last: int) -> str:
        """Lines of a module with the names that the file has.

        Raises:
            ExportError: where a name is not where Python says, as inside of some formatted strings.
        """
        lines = [line.encode() for line in source.lines[first - 1 : last]]
        for edit in sorted(self._edits(source.name, node), reverse=True):
            line = lines[edit.row - first]
            if edit.old and line[edit.start : edit.end] != edit.old.encode():
                raise ExportError(
                    f"{edit.old} in line {edit.row} of {source.name} cannot be given another name"
                )
            lines[edit.row - first] = line[: edit.start] + edit.new.encode() + line[edit.end :]
        return "\n".join(line.decode() for line in lines)

    def _edits(self, module: str, node: ast.AST) -> list[_Edit]:
        """Places where a name changes."""
        if not isinstance(node, ast.stmt | ast.expr):
            return []
        names, edits = global_names(node), []
        for each in code_nodes(node):
            key = self._attribute_key(module, each, names)
            if isinstance(each, ast.Name) and each.id in names:
                found = self.definitions.resolve(module, each.id)
                if isinstance(found, Key) and self.names.get(found, each.id) != each.id:
                    edits.append(_edit(each, self.names[found]))
            elif key is not None:
                edits.append(_edit(each, self.names[key]))
        for annotation in annotations(node):
            edits += self._annotation_edits(module, annotation)
        return edits

    def _annotation_edits(self, module: str, node: ast.AST) -> list[_Edit]:
        """Likewise in an annotation; what is not in the file is Any."""
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            return [_edit(node, "Any")]
        if isinstance(node, ast.Attribute):
            key = self._attribute_key(module, node, frozenset([getattr(node.value, "id", "")]))
            if key in self.names:
                return [_edit(node, self.names[key])]
            external = getattr(node.value, "id", "") == "numpy"
            return [] if external else [_edit(node, "Any")]
        if isinstance(node, ast.Name):
            return self._annotated_name(module, node)
        return [
            edit for child in ast.iter_child_nodes(node) for edit in self._annotation_edits(module, child)
        ]

    def _annotated_name(self, module: str, node: ast.Name) -> list[_Edit]:
        try:
            found: Any = self.definitions.resolve(module, node.id)
        except ValueError:
            return [_edit(node, "Any")]
        if found is None:
            return []
        if isinstance(found, External):
            self.definitions.externals.add(found)
            return []
        name = self.names.get(found, "Any") if isinstance(found, Key) else "Any"
        return [] if name == node.id else [_edit(node, name)]


def _edit(node: Any, new: str) -> _Edit:
    old = "" if isinstance(node, ast.Constant) else ast.unparse(node)
    if node.lineno != node.end_lineno:
        raise ExportError(f"{old or 'an annotation'} goes over several lines")
    return _Edit(node.lineno, node.col_offset, node.end_col_offset, old, new)


def _heading(source: Source) -> str:
    """Rule with the name of a module, and what it says of itself, as comments."""
    rule = f"# --- {source.name} ".ljust(WIDTH - 1, "-")
    package, _, rest = source.name.partition(".")[2].partition(".")
    # What the engine says of itself is not about this filter.
    of_engine = package in ("evaluation", "exports") or (package in ("envs", "baselines") and "." not in rest)
    documentation = [] if of_engine else source.documentation.splitlines()
    return "\n".join([rule, *(f"# {line}".rstrip() for line in documentation)])
