"""Rewrites code that uses jaxcon for new names: Python files, notebooks, and code in Markdown.

    pip install libcst
    python tools/rename.py PATH …  [--table FILE] [--check]

The table is `jaxcon/renamed.json` unless another is given. Its parts:

    modules     {"jaxcon.core.native": "jaxcon.staging.batch_last"}, of moved modules
    names       {"jaxcon.Dense": "jaxcon.solvers.Dense"}, of functions, classes and constants
    arguments   {"jaxcon.Method": {"bounded": "contact_solver"}}, of keywords in calls
    calls       {"jaxcon.wrench": ["info", "name", "body"]}, of functions with other arguments
    attributes  {"tail": "ending"}, of all fields, methods and keywords with this name
    methods     {"feedback": "stabilizer_for"}, of methods whose calls are printed
    overrides   [{"classes": ["Baumgarte"], "members": {"bounded": "cap_gains"}}], of methods and
                flags in classes that derive from these

Names are resolved by the imports of each file, so a local variable that is called like a name of
the table stays as it is. Attributes have no types in Python. They are renamed wherever they occur
after a dot, as a keyword, or in the body of a class. The names of `arguments` change in calls of
their function. Texts (comments, docstrings, annotations in quotes, Markdown, pages of Sphinx) are
searched for `jc.Name`, dotted paths, imports, and autodoc directives. Other strings stay: they may
be names of files or loggers.

Prints the files that change, and the lines that need a look:

    - strings that contain an old dotted name
    - names of `arguments` after a dot, as keywords of other functions, as keys, and in paths such
      as "*/most"
    - functions of `calls` with more arguments than now, with `*arguments`, or passed as values
    - classes that define members of `overrides`
    - imports of modules and names that no longer exist; they are looked up in the folder of the
      table if that is the package
    - `getattr(jc, name)` and `from jaxcon import *`

In a notebook the line is that of its cell, in Markdown that of the piece of code. With `--check` it
writes nothing, and ends with 1 if any file would change. Line endings and encodings stay. Hidden
folders and virtual environments are left out.
"""

from __future__ import annotations

import argparse
import codecs
import functools
import io
import json
import re
import symtable
import sys
import tokenize
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import libcst as cst
from libcst import matchers
from libcst.metadata import (
    MetadataWrapper,
    ParentNodeProvider,
    PositionProvider,
    QualifiedNameProvider,
    QualifiedNameSource,
)

PACKAGE = "jaxcon"
FENCE = re.compile(r"(```(?:python|py|\{code-cell\}[^\n]*)\r?\n)(.*?)(```)", re.DOTALL)
IMPLICIT = "import jaxcon as jc\n"
"""The import that code in a text is assumed to have."""
IMPORT = re.compile(rf"\bfrom ({PACKAGE}[\w.]*) import (\w+(?: as \w+)?(?:, \w+(?: as \w+)?)*)")
MAGIC = re.compile(r"^([ \t]*)([%!].*)$", re.MULTILINE)
MASKED = re.compile(r"^([ \t]*)#:MAGIC:", re.MULTILINE)
DIRECTIVE = re.compile(r"^\.\. (?:py:)?(auto\w+|currentmodule|module):: +([\w.]+)", re.MULTILINE)

USES = re.compile(rf"\b(?:from|import) +{PACKAGE}\b")
PRAGMA = re.compile(r"#\s*(?:noqa|type:|pyright:|pylint:|ruff:|isort:|pragma:)")
"""Comments that tell a tool about their line."""
LOOKUPS = ("get", "pop", "setdefault", "getattr", "hasattr", "setattr")
"""Functions with a key or the name of an attribute among their arguments."""
INSIDE = cst.BaseExpression | cst.SubscriptElement | cst.Index | cst.BaseElement
"""Nodes between an annotation and a string in it."""


@functools.cache
def defined_in(path: Path) -> frozenset[str]:
    """Returns the names that a module defines or imports at its top level."""
    symbols = symtable.symtable(path.read_text(encoding="utf-8"), str(path), "exec").get_symbols()
    return frozenset(x.get_name() for x in symbols if x.is_assigned() or x.is_imported())


@dataclass(frozen=True)
class Table:
    """Old names and their new ones.

    Attributes:
        modules: dotted names of modules.
        names: dotted names of what modules hold.
        arguments: keywords by the old dotted name of the function or class.
        calls: positional arguments by the dotted name of a function that had more of them.
        attributes: of fields, methods and keyword arguments.
        methods: of methods whose calls are printed.
        overrides: "members" of classes that derive from any of "classes".
        package: the folder of the package as it is now; None if it is unknown.
    """

    modules: dict[str, str] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)
    arguments: dict[str, dict[str, str]] = field(default_factory=dict)
    calls: dict[str, list[str]] = field(default_factory=dict)
    attributes: dict[str, str] = field(default_factory=dict)
    methods: dict[str, str] = field(default_factory=dict)
    overrides: list[dict[str, Any]] = field(default_factory=list)
    package: Path | None = None

    @classmethod
    def read(cls, path: Path) -> Table:
        """Returns the table of a JSON file."""
        package = path.parent if (path.parent / "__init__.py").exists() else None
        return cls(**json.loads(path.read_text(encoding="utf-8")), package=package)

    def dotted(self, name: str) -> str | None:
        """Returns the new dotted name of a module, or of something in one; None if unchanged."""
        if name in self.names:
            return self.names[name]
        parts = name.split(".")
        for end in range(len(parts), 0, -1):
            head, tail = ".".join(parts[:end]), parts[end:]
            if head in self.names or head in self.modules:
                return ".".join([self.names.get(head) or self.modules[head], *tail])
        return None

    @functools.cached_property
    def fields(self) -> dict[str, str]:
        """New names of `arguments`, without their functions."""
        return {old: new for names in self.arguments.values() for old, new in names.items()}

    def members(self, name: str) -> dict[str, str]:
        """Returns the new names of members that classes derived from a class define."""
        found = [x["members"] for x in self.overrides if name in x["classes"]]
        return {old: new for members in found for old, new in members.items()}

    def missing(self, module: str, name: str | None = None) -> str | None:
        """Returns why a module, or a name in it, cannot be imported; None if it can."""
        head, *rest = module.split(".")
        if self.package is None or head != PACKAGE:
            return None
        folder = self.package.joinpath(*rest)
        paths = [x for x in (folder / "__init__.py", folder.with_suffix(".py")) if x.exists()]
        if not paths:
            return f"there is no module {module} now"
        if name is None or name in defined_in(paths[0]) or name.startswith("__"):
            return None
        if self.missing(f"{module}.{name}") is None:
            return None
        return f"{module} has no {name} now"

    def found_in(self, text: str) -> Iterator[tuple[int, str]]:
        """Yields (position, reason) of the old names that a text mentions."""
        for pattern, new in ((IMPORT, self._new_import), (self._pattern, self._new_text)):
            for found in pattern.finditer(text):
                if new(found) != found[0]:
                    yield found.start(), f"a string contains {found[0]}; it is {new(found)} now"
            text = pattern.sub(lambda found: " " * len(found[0]), text)

    def in_text(self, text: str) -> str:
        """Returns a text with new names in place of the old ones that it mentions."""
        return self._pattern.sub(self._new_text, IMPORT.sub(self._new_import, text))

    def homes(self, module: str, names: Sequence[str]) -> list[tuple[str, str]]:
        """Returns (module, name) now of each of the names that are imported from a module."""
        found = []
        for name in names:
            home, _, last = (self.dotted(f"{module}.{name}") or f"{module}.{name}").rpartition(".")
            found.append((home, last))
        return found

    def _new_import(self, found: re.Match[str]) -> str:
        module, names = found[1], found[2].split(", ")
        by_module: dict[str, list[str]] = {}
        homes = self.homes(module, [name.split(" ")[0] for name in names])
        for name, (home, last) in zip(names, homes, strict=True):
            by_module.setdefault(home, []).append(" ".join([last, *name.split(" ")[1:]]))
        return "; ".join(f"from {home} import {', '.join(x)}" for home, x in by_module.items())

    def _new_text(self, found: re.Match[str]) -> str:
        old = found[0]
        head = PACKAGE if old.startswith(PACKAGE) else "jc"
        new = self.dotted(PACKAGE + old.replace("\\", "").removeprefix(head))
        assert new is not None
        new = head + new.removeprefix(PACKAGE)
        return new.replace(".", r"\.") if "\\" in old else new

    @functools.cached_property
    def _pattern(self) -> re.Pattern[str]:
        known = sorted({*self.modules, *self.names}, key=len, reverse=True)
        options = "|".join(re.escape(name.removeprefix(PACKAGE)) for name in known)
        options = options.replace(r"\.", r"\\?\.")  # regular expressions have "\." in place of "."
        return re.compile(rf"(?<![\w.])(?:{PACKAGE}|jc)(?:{options})\b" if options else r"(?!)")


def dotted_name(node: cst.BaseExpression | None) -> str | None:
    """Returns "a.b.c" of an attribute or a name; None of other expressions."""
    if isinstance(node, cst.Name):
        return node.value
    if isinstance(node, cst.Attribute):
        head = dotted_name(node.value)
        return None if head is None else f"{head}.{node.attr.value}"
    return None


def expression(dotted: str) -> cst.Name | cst.Attribute:
    """Returns the expression of a dotted name."""
    head, *rest = dotted.split(".")
    node: cst.Name | cst.Attribute = cst.Name(head)
    for part in rest:
        node = cst.Attribute(node, cst.Name(part))
    return node


@dataclass
class Notes:
    """Comments that belong to an import statement, or to one name of it.

    Attributes:
        above: on lines of their own.
        beside: at the end of the line.
    """

    above: list[str] = field(default_factory=list)
    beside: list[str] = field(default_factory=list)


def notes_of(node: cst.ImportFrom) -> tuple[Notes, list[Notes]]:
    """Returns the comments inside the parentheses of an import: of all of it, and by name."""
    assert not isinstance(node.names, cst.ImportStar)
    gaps: list[list[Any]] = [[node.lpar.whitespace_after] if node.lpar else []]
    for alias in node.names:
        comma = alias.comma
        has_comma = isinstance(comma, cst.Comma)
        gaps.append([comma.whitespace_before, comma.whitespace_after] if has_comma else [])
    gaps[-1] += [node.rpar.whitespace_before] if node.rpar else []
    whole, notes = Notes(), [Notes() for _ in node.names]
    for before, after, gap in zip([whole, *notes], [*notes, whole], gaps, strict=True):
        for space in gap:
            if isinstance(space, cst.ParenthesizedWhitespace):
                lines = [x.comment for x in space.empty_lines]
                before.beside += [x.value for x in [space.first_line.comment] if x is not None]
                after.above += [x.value for x in lines if x is not None]
    return whole, notes


class Renamer(cst.CSTTransformer):
    """Renames in one module.

    Attributes:
        table: the names.
        module: the dotted name of the module that is rewritten; None outside of the package.
        doubts: (line, reason) of what needs a look.
    """

    METADATA_DEPENDENCIES = (QualifiedNameProvider, ParentNodeProvider, PositionProvider)

    def __init__(self, table: Table, module: str | None = None) -> None:
        super().__init__()
        self.table, self.module = table, module
        self.doubts: list[tuple[int, str]] = []
        self._uses_package = True
        self._notes: dict[cst.CSTNode, Notes] = {}
        self._derived: dict[str, dict[str, str]] = {}

    def visit_Module(self, node: cst.Module) -> None:  # noqa: N802
        """Notes whether the package is imported anywhere."""
        self._uses_package = USES.search(node.code) is not None

    def leave_ImportFrom(  # noqa: N802
        self, original_node: cst.ImportFrom, updated_node: cst.ImportFrom
    ) -> cst.BaseSmallStatement | cst.FlattenSentinel[cst.BaseSmallStatement]:
        """Moves each imported name to the module that has it now."""
        module, aliases = dotted_name(original_node.module), original_node.names
        if isinstance(aliases, cst.ImportStar) and (module or "").split(".")[0] == PACKAGE:
            self._doubt(original_node, f"the names of {module} are not known here")
        if original_node.relative or module is None or isinstance(aliases, cst.ImportStar):
            return updated_node
        names = [dotted_name(alias.name) or "" for alias in aliases]
        homes = self.table.homes(module, names)
        reasons = [self.table.missing(home, last) for home, last in homes]
        for reason in dict.fromkeys(x for x in reasons if x is not None):
            self._doubt(original_node, reason)
        if homes == [(module, name) for name in names]:
            return updated_node
        assert not isinstance(updated_node.names, cst.ImportStar)
        renamed_aliases = [
            alias.with_changes(name=cst.Name(last))
            for alias, (_, last) in zip(updated_node.names, homes, strict=True)
        ]
        if len({home for home, _ in homes}) == 1:
            return updated_node.with_changes(module=expression(homes[0][0]), names=renamed_aliases)
        return self._split(original_node, updated_node, renamed_aliases, [x for x, _ in homes])

    def _split(
        self,
        original_node: cst.ImportFrom,
        updated_node: cst.ImportFrom,
        aliases: Sequence[cst.ImportAlias],
        homes: Sequence[str],
    ) -> cst.FlattenSentinel[cst.BaseSmallStatement]:
        """Returns an import for each module, and one for each name that has a comment."""
        whole, notes = notes_of(updated_node)
        groups: dict[Any, tuple[str, list[cst.ImportAlias], Notes]] = {}
        for k, (alias, home, note) in enumerate(zip(aliases, homes, notes, strict=True)):
            key = (home, k) if note.above or note.beside else home
            alias = alias.with_changes(comma=cst.MaybeSentinel.DEFAULT)
            groups.setdefault(key, (home, [], note))[1].append(alias)
        statements = []
        for home, names, note in groups.values():
            statements.append(cst.ImportFrom(module=expression(home), names=names))
            pragmas = [x for x in whole.beside if PRAGMA.match(x)]
            self._notes[statements[-1]] = Notes(note.above, note.beside + pragmas)
        first, last = self._notes[statements[0]], self._notes[statements[-1]]
        first.above[:0] = [x for x in whole.beside if not PRAGMA.match(x)]
        last.above += whole.above
        kept = [*whole.beside, *whole.above, *(x for y in notes for x in y.above + y.beside)]
        in_line = isinstance(
            self.get_metadata(ParentNodeProvider, original_node), cst.SimpleStatementLine
        )
        for comment in matchers.findall(original_node, matchers.Comment()):
            assert isinstance(comment, cst.Comment)
            if not in_line or self.table.in_text(comment.value) not in kept:
                self._doubt(comment, f"the comment {comment.value} is left out")
        return cst.FlattenSentinel(statements)

    def leave_SimpleStatementLine(  # noqa: N802
        self, original_node: cst.SimpleStatementLine, updated_node: cst.SimpleStatementLine
    ) -> cst.SimpleStatementLine | cst.FlattenSentinel[cst.SimpleStatementLine]:
        """Gives each import a line where one has become several."""
        body, end = updated_node.body, updated_node.trailing_whitespace
        if len(body) == len(original_node.body):
            return updated_node
        at_end = [] if end.comment is None else [end.comment.value]
        pragmas = [x for x in at_end if PRAGMA.match(x)]
        lines = []
        for k, statement in enumerate(body):
            notes = self._notes.get(statement, Notes())
            above = [cst.EmptyLine(comment=cst.Comment(x)) for x in notes.above]
            beside = notes.beside + (at_end if k == len(body) - 1 else pragmas)
            trail = cst.TrailingWhitespace()
            if beside:
                space = cst.SimpleWhitespace("  ")
                trail = trail.with_changes(whitespace=space, comment=cst.Comment("  ".join(beside)))
            lines.append(cst.SimpleStatementLine([statement], above, trail))
        above = [*updated_node.leading_lines, *lines[0].leading_lines]
        lines[0] = lines[0].with_changes(leading_lines=above)
        if lines[-1].trailing_whitespace.comment is None:
            lines[-1] = lines[-1].with_changes(trailing_whitespace=end)
        return cst.FlattenSentinel(lines)

    def visit_ClassDef(self, node: cst.ClassDef) -> None:  # noqa: N802
        """Notes members of classes that derive from classes of `overrides`."""
        members: dict[str, str] = {}
        for argument in node.bases:
            base = argument.value
            base = base.value if isinstance(base, cst.Subscript) else base
            for found in self.get_metadata(QualifiedNameProvider, base, set()):
                if found.source is QualifiedNameSource.LOCAL:
                    members |= self._derived.get(found.name, {})
                elif found.name.startswith(f"{PACKAGE}."):
                    members |= self.table.members(found.name.rpartition(".")[2])
        if not members:
            return
        for found in self.get_metadata(QualifiedNameProvider, node, set()):
            self._derived[found.name] = members
        defined = dict(_members_of(node))
        for old, new in members.items():
            if old in defined and new not in defined:
                self._doubt(defined[old], f"{node.name.value} defines {old}, which is {new} now")

    def visit_Arg(self, node: cst.Arg) -> None:  # noqa: N802
        """Notes where the package is handed to a function, such as `getattr`."""
        for found in self.get_metadata(QualifiedNameProvider, node.value, set()):
            if found.name == PACKAGE and found.source is QualifiedNameSource.IMPORT:
                self._doubt(node, f"{dotted_name(node.value)} is an argument of a function")

    def visit_Call(self, node: cst.Call) -> None:  # noqa: N802
        """Notes calls with more positional arguments than now, and calls of `methods`."""
        keywords = [x.keyword.value for x in node.args if x.keyword is not None]
        given = sum(x.keyword is None and not x.star for x in node.args)
        unpacks = any(x.star for x in node.args)
        if isinstance(node.func, cst.Attribute) and self._uses_package:
            old = node.func.attr.value
            if (new := self.table.methods.get(old)) is not None and not self._imported(node.func):
                self._doubt(node, f"{old} may be {new} now")
        for found in self.get_metadata(QualifiedNameProvider, node.func, set()):
            for name in (found.name, self.table.dotted(found.name)):
                taken = self.table.calls.get(name or "")
                known = given + sum(x in taken for x in keywords) if taken else 0
                if taken and (unpacks or known > len(taken)):
                    self._doubt(node, f"{name} takes ({', '.join(taken)}) now")
                    return

    def leave_Import(  # noqa: N802
        self, original_node: cst.Import, updated_node: cst.Import
    ) -> cst.Import:
        """Renames `import a.b`."""
        names = []
        for alias in updated_node.names:
            old = dotted_name(alias.name) or ""
            new = self.table.dotted(old)
            if (reason := self.table.missing(new or old)) is not None:
                self._doubt(original_node, reason)
            names.append(alias if new is None else alias.with_changes(name=expression(new)))
        return updated_node.with_changes(names=names)

    def leave_Attribute(  # noqa: N802
        self, original_node: cst.Attribute, updated_node: cst.Attribute
    ) -> cst.BaseExpression:
        """Renames what is reached by way of an imported module, and attributes."""
        self._check_value(original_node)
        if (new := self._of_module(original_node)) is not None:
            return new.with_changes(lpar=updated_node.lpar, rpar=updated_node.rpar)
        if original_node.attr.value in self.table.attributes and not self._imported(original_node):
            new_name = cst.Name(self.table.attributes[original_node.attr.value])
            return updated_node.with_changes(attr=new_name)
        if (new := self.table.fields.get(original_node.attr.value)) is not None:
            parent = self.get_metadata(ParentNodeProvider, original_node)
            if not self._imported(original_node) and not isinstance(parent, cst.ImportFrom):
                self._doubt(original_node, f"{original_node.attr.value} may be {new} now")
        return updated_node

    def leave_Name(self, original_node: cst.Name, updated_node: cst.Name) -> cst.Name:  # noqa: N802
        """Renames what is imported or defined here by a name that the table has."""
        parent = self.get_metadata(ParentNodeProvider, original_node, None)
        if isinstance(parent, cst.Attribute) and parent.attr is original_node:
            return updated_node
        if isinstance(parent, cst.Arg) and parent.keyword is original_node:
            new = self._keyword(parent, original_node.value)
            return updated_node.with_changes(value=new) if new else self._attribute(updated_node)
        if self._is_field(original_node):
            return self._attribute(updated_node)
        if isinstance(parent, cst.ImportAlias):
            return updated_node
        self._check_value(original_node)
        for found in self.get_metadata(QualifiedNameProvider, original_node, set()):
            if found.source is QualifiedNameSource.IMPORT:
                # what is called otherwise here keeps that name
                if found.name.rpartition(".")[2] == original_node.value:
                    new = self.table.dotted(found.name)
                    if new is not None:
                        return updated_node.with_changes(value=new.rpartition(".")[2])
            elif found.source is QualifiedNameSource.LOCAL and self.module is not None:
                new = self.table.names.get(f"{self.module}.{found.name}")
                if new is not None and "." not in found.name:
                    return updated_node.with_changes(value=new.rpartition(".")[2])
        return updated_node

    def leave_SimpleString(  # noqa: N802
        self, original_node: cst.SimpleString, updated_node: cst.SimpleString
    ) -> cst.SimpleString:
        """Renames in docstrings and annotations; notes old names in other strings."""
        if self._is_text(original_node):
            return updated_node.with_changes(value=self.table.in_text(updated_node.value))
        self._check_string(original_node, original_node.value)
        value = original_node.evaluated_value
        if isinstance(value, str) and self._uses_package:
            names = value.split("/") if "/" in value or self._is_key(original_node) else []
            for name in names:
                if (new := self.table.fields.get(name)) is not None:
                    self._doubt(original_node, f"{name} may be {new} now")
        return updated_node

    def visit_FormattedStringText(self, node: cst.FormattedStringText) -> None:  # noqa: N802
        """Notes old names in formatted strings."""
        self._check_string(node, node.value)

    def leave_Comment(  # noqa: N802
        self, original_node: cst.Comment, updated_node: cst.Comment
    ) -> cst.Comment:
        """Renames in comments."""
        return updated_node.with_changes(value=self.table.in_text(updated_node.value))

    def _is_text(self, node: cst.CSTNode) -> bool:
        """Returns True for a string that stands alone, as docstrings do, or in an annotation."""
        parent = self.get_metadata(ParentNodeProvider, node)
        while isinstance(parent, cst.ConcatenatedString):
            parent = self.get_metadata(ParentNodeProvider, parent)
        if isinstance(parent, cst.Expr):
            return True
        while isinstance(parent, INSIDE):
            of = dotted_name(parent.value) if isinstance(parent, cst.Subscript) else None
            if isinstance(parent, cst.Call) or (of or "").split(".")[-1] == "Literal":
                return False
            parent = self.get_metadata(ParentNodeProvider, parent)
        return isinstance(parent, cst.Annotation)

    def _is_key(self, node: cst.SimpleString) -> bool:
        """Returns True for a key of a dictionary, and for a string that is looked up in one."""
        parent = self.get_metadata(ParentNodeProvider, node)
        if isinstance(parent, cst.DictElement):
            return parent.key is node
        if isinstance(parent, cst.Comparison):
            return parent.left is node  # "most" in fields
        if isinstance(parent, cst.Arg):
            call = self.get_metadata(ParentNodeProvider, parent)
            func = call.func if isinstance(call, cst.Call) else None
            func = func.attr if isinstance(func, cst.Attribute) else func
            return isinstance(func, cst.Name) and func.value in LOOKUPS
        return isinstance(parent, cst.Index)

    def _check_string(self, node: cst.CSTNode, text: str) -> None:
        """Notes the old names in a string that is not rewritten."""
        for position, reason in self.table.found_in(text):
            self._doubt(node, reason, text.count("\n", 0, position))

    def _check_value(self, node: cst.Name | cst.Attribute) -> None:
        """Notes functions of `calls` that are passed on, and names that the package lacks."""
        parent = self.get_metadata(ParentNodeProvider, node, None)
        if isinstance(parent, cst.ImportAlias | cst.ImportFrom | cst.AsName):
            return
        for found in self.get_metadata(QualifiedNameProvider, node, set()):
            if found.source is not QualifiedNameSource.IMPORT:
                continue
            head, _, last = found.name.rpartition(".")
            new = self.table.dotted(found.name)
            if new is None and head == PACKAGE and isinstance(node, cst.Attribute):
                reason = self.table.missing(head, last)
                if reason is not None:
                    self._doubt(node, reason)
            called = isinstance(parent, cst.Call) and parent.func is node
            if called or isinstance(parent, cst.Attribute):
                continue
            for name in (found.name, new):
                if taken := self.table.calls.get(name or ""):
                    self._doubt(node, f"{name} is passed on; it takes ({', '.join(taken)}) now")
                    return

    def _keyword(self, argument: cst.Arg, name: str) -> str | None:
        """Returns the new name of a keyword in a call of a function of `arguments`, or None."""
        call = self.get_metadata(ParentNodeProvider, argument, None)
        if not isinstance(call, cst.Call):
            return None
        for found in self.get_metadata(QualifiedNameProvider, call.func, set()):
            for owner in (found.name, self.table.dotted(found.name)):
                if new := self.table.arguments.get(owner or "", {}).get(name):
                    return new
        if name in self.table.fields:
            self._doubt(argument, f"{name} may be {self.table.fields[name]} now")
        return None

    def _attribute(self, node: cst.Name) -> cst.Name:
        return node.with_changes(value=self.table.attributes.get(node.value, node.value))

    def _is_field(self, node: cst.Name) -> bool:
        """Returns True for the name of a method or field in the body of a class."""
        parent = self.get_metadata(ParentNodeProvider, node, None)
        above = parent
        if isinstance(parent, cst.FunctionDef) and parent.name is node:
            above = self.get_metadata(ParentNodeProvider, parent, None)
        elif isinstance(parent, cst.AnnAssign) and parent.target is node:
            line = self.get_metadata(ParentNodeProvider, parent, None)
            above = self.get_metadata(ParentNodeProvider, line, None)
        elif isinstance(parent, cst.AssignTarget):
            assign = self.get_metadata(ParentNodeProvider, parent, None)
            line = self.get_metadata(ParentNodeProvider, assign, None)
            above = self.get_metadata(ParentNodeProvider, line, None)
        else:
            return False
        block = self.get_metadata(ParentNodeProvider, above, None)
        return isinstance(above, cst.IndentedBlock) and isinstance(block, cst.ClassDef)

    def _imported(self, node: cst.Attribute) -> bool:
        """Returns True for what a module of another package holds, such as `np.bounded`."""
        found = self.get_metadata(QualifiedNameProvider, node, set())
        return any(x.source is QualifiedNameSource.IMPORT for x in found) and not any(
            x.name.startswith(f"{PACKAGE}.") for x in found
        )

    def _of_module(self, node: cst.Attribute) -> cst.BaseExpression | None:
        """Returns the new expression of `module.name`; None where it does not change."""
        written = dotted_name(node)
        if written is None:
            return None
        first, *rest = written.split(".")
        for found in self.get_metadata(QualifiedNameProvider, node, set()):
            new = self.table.names.get(found.name) or self.table.modules.get(found.name)
            if new is None or found.source is not QualifiedNameSource.IMPORT:
                continue
            # what the first name stands for, before and after
            base = found.name.removesuffix("." + ".".join(rest))
            new_base = self.table.dotted(base) or base
            if not new.startswith(f"{new_base}."):
                self._doubt(node, f"{found.name} is {new}, which {first} does not lead to")
                return None
            if first == base.rpartition(".")[2]:
                first = new_base.rpartition(".")[2]
            return expression(first + new.removeprefix(new_base))
        return None

    def _doubt(self, node: cst.CSTNode, reason: str, below: int = 0) -> None:
        line = self.get_metadata(PositionProvider, node).start.line
        self.doubts.append((line + below, reason))


def _members_of(node: cst.ClassDef) -> Iterator[tuple[str, cst.CSTNode]]:
    """Yields the names that the body of a class defines, with the place of each."""
    for statement in node.body.body:
        is_line = isinstance(statement, cst.SimpleStatementLine)
        for part in statement.body if is_line else (statement,):
            targets = [x.target for x in part.targets] if isinstance(part, cst.Assign) else []
            targets += [part.target] if isinstance(part, cst.AnnAssign) else []
            targets += [part.name] if isinstance(part, cst.FunctionDef) else []
            yield from ((x.value, part) for x in targets if isinstance(x, cst.Name))


Report = Callable[[int, str], object]
"""Called with the number of a line that needs a look, and the reason."""


def silent(line: int, reason: str) -> None:
    """Reports nothing."""


def renamed(source: str, table: Table, module: str | None = None, report: Report = silent) -> str:
    """Returns the source of a module with new names.

    Args:
        source: Python.
        table: the names.
        module: its dotted name in the package; None outside.
        report: called with lines that need a look.
    """
    renamer = Renamer(table, module)
    code = MetadataWrapper(cst.parse_module(source)).visit(renamer).code
    for doubt in sorted(renamer.doubts, key=lambda doubt: doubt[0]):
        report(*doubt)
    return code


def imports(source: str) -> str:
    """Returns the import statements at the top level of a program."""
    module = cst.parse_module(source)
    lines = [x for x in module.body if isinstance(x, cst.SimpleStatementLine)]
    kinds = (cst.Import, cst.ImportFrom)
    found = [module.code_for_node(x) for x in lines if isinstance(x.body[0], kinds)]
    return "".join(code if code.endswith("\n") else f"{code}\n" for code in found)


class Fragments:
    """Renames in the pieces of code of a text, whose imports hold for all later pieces."""

    def __init__(self, table: Table, report: Report = silent) -> None:
        self.table, self.report, self.before = table, report, IMPLICIT

    def __call__(self, source: str) -> str:
        """Returns a piece with new names; what is not Python is searched as a text."""
        above = self.before.count("\n")

        def report(line: int, reason: str) -> None:
            if line > above:  # those of imports before were reported with their piece
                self.report(line - above, reason)

        for hidden in (source, MAGIC.sub(r"\1#:MAGIC:\2", source)):
            try:
                new = renamed(self.before + hidden, self.table, report=report)
                start = renamed(self.before, self.table)
                self.before += imports(hidden)
            except cst.ParserSyntaxError:
                continue
            return MASKED.sub(r"\1", new.removeprefix(start))
        return self.table.in_text(source)


def _markdown(text: str, table: Table, fragments: Fragments) -> str:
    text = FENCE.sub(lambda found: found[1] + fragments(found[2]) + found[3], text)
    return table.in_text(text)


def _notebook(text: str, table: Table, report: Report) -> str:
    content, fragments, changed = json.loads(text), Fragments(table, report), False
    for cell in content["cells"]:
        source = "".join(cell["source"])
        is_code = cell["cell_type"] == "code"
        new = fragments(source) if is_code else _markdown(source, table, fragments)
        if new != source:
            cell["source"], changed = new.splitlines(keepends=True), True
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n" if changed else text


def _sphinx(text: str, table: Table) -> str:
    module = PACKAGE

    def directive(found: re.Match[str]) -> str:
        nonlocal module
        kind, name = found.groups()
        if not kind.startswith("auto"):
            module = name
        elif (new := table.dotted(f"{module}.{name}")) is not None:
            return found[0].removesuffix(name) + new
        return found[0]

    return table.in_text(DIRECTIVE.sub(directive, text))


def module_of(path: Path) -> str | None:
    """Returns the dotted name of a module of the package; None of other files."""
    parts = path.resolve().with_suffix("").parts
    if PACKAGE not in parts or path.suffix != ".py":
        return None
    last = len(parts) - 1 - parts[::-1].index(PACKAGE)
    names = parts[last:]
    return ".".join(names[:-1] if names[-1] == "__init__" else names)


def decoded(path: Path) -> tuple[str, str]:
    """Returns the text of a file with its line endings, and its encoding.

    Raises:
        SyntaxError: of a Python file with an unknown encoding.
        UnicodeDecodeError: the file has another encoding.
    """
    content = path.read_bytes()
    encoding = "utf-8-sig" if content.startswith(codecs.BOM_UTF8) else "utf-8"
    if path.suffix == ".py":
        encoding, _ = tokenize.detect_encoding(io.BytesIO(content).readline)
    return content.decode(encoding), encoding


def rewritten(path: Path, table: Table, report: Report = silent) -> bytes:
    """Returns the new content of a file.

    Args:
        path: of the file.
        table: the names.
        report: called with lines that need a look.
    """
    try:
        text, encoding = decoded(path)
    except (SyntaxError, UnicodeDecodeError) as error:
        report(1, f"the file cannot be decoded: {error}")
        return path.read_bytes()
    if "\r\n" in text and not re.search(r"(?<!\r)\n", text):
        new = _rewritten(path, text.replace("\r\n", "\n"), table, report)
        return new.replace("\n", "\r\n").encode(encoding)
    return _rewritten(path, text, table, report).encode(encoding)


def _rewritten(path: Path, text: str, table: Table, report: Report) -> str:
    match path.suffix:
        case ".py":
            try:
                return renamed(text, table, module_of(path), report)
            except cst.ParserSyntaxError as error:
                report(error.raw_line, "no Python that libcst can read")
        case ".ipynb":
            return _notebook(text, table, report)
        case ".md":
            return _markdown(text, table, Fragments(table, report))
        case ".rst":
            return _sphinx(text, table)
    return text


def files(paths: Sequence[Path]) -> Iterator[Path]:
    """Yields the files that can be rewritten, those in folders included."""
    for path in paths:
        found = sorted(path.rglob("*")) if path.is_dir() else [path]
        environments = [x.parent for x in found if x.name == "pyvenv.cfg"]
        for each in found:
            hidden = any(part.startswith(".") for part in each.relative_to(path).parts)
            hidden |= any(each.is_relative_to(x) for x in environments)
            if each.is_file() and not hidden and each.suffix in (".py", ".ipynb", ".md", ".rst"):
                yield each


def main(arguments: Sequence[str] | None = None) -> int:
    """Rewrites files. Returns 1 if `--check` is given and a file would change."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("paths", nargs="+", type=Path)
    default = Path(__file__).parent.parent / PACKAGE / "renamed.json"
    parser.add_argument("--table", type=Path, default=default)
    parser.add_argument("--check", action="store_true", help="write nothing")
    given = parser.parse_args(arguments)
    table, changed = Table.read(given.table), 0
    for path in files(given.paths):
        new = rewritten(path, table, lambda line, why, path=path: print(f"{path}:{line}: {why}"))
        if new != path.read_bytes():
            changed += 1
            print(path)
            if not given.check:
                path.write_bytes(new)
    return int(given.check and changed > 0)


if __name__ == "__main__":
    sys.exit(main())
