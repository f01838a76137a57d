"""Rewrites code that uses jaxcon for new names: Python files, notebooks, and code in Markdown.

    pip install libcst
    python tools/rename.py PATH …  [--table FILE] [--check]

The table is `jaxcon/renamed.json` unless another is given. Its parts:

    modules     {"jaxcon.core.native": "jaxcon.staging.batch_last"}, of moved modules
    names       {"jaxcon.Dense": "jaxcon.solvers.Dense"}, of functions, classes and constants
    arguments   {"jaxcon.Method": {"bounded": "contact_solver"}}, of keywords in calls
    calls       {"jaxcon.wrench": ["info", "name", "body"]}, of functions with other arguments
    attributes  {"tail": "ending"}, of all fields, methods and keywords with this name

Names are resolved by the imports of each file, so a local variable that is called like a name of
the table stays as it is. Attributes have no types in Python. They are renamed wherever they occur
after a dot, as a keyword, or in the body of a class. The names of `arguments` change in calls of
their function; where they stand after a dot, the line is printed. Texts (comments, docstrings,
Markdown, pages of Sphinx) are searched for `jc.Name`, dotted paths, imports, and autodoc
directives.

Prints the files that change, and the lines that need a look: `getattr(jc, name)`, `from jaxcon
import *`, and calls with more arguments than `calls` says. In a notebook the line is that of its
cell, in Markdown that of the piece of code. With `--check` it writes nothing, and ends with 1 if
any file would change. Hidden folders and virtual environments are left out.
"""

from __future__ import annotations

import argparse
import functools
import json
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import libcst as cst
from libcst.metadata import (
    MetadataWrapper,
    ParentNodeProvider,
    PositionProvider,
    QualifiedNameProvider,
    QualifiedNameSource,
)

PACKAGE = "jaxcon"
FENCE = re.compile(r"(```(?:python|py|\{code-cell\}[^\n]*)\n)(.*?)(```)", re.DOTALL)
IMPLICIT = "import jaxcon as jc\n"
"""The import that code in a text is assumed to have."""
IMPORT = re.compile(rf"\bfrom ({PACKAGE}[\w.]*) import (\w+(?: as \w+)?(?:, \w+(?: as \w+)?)*)")
MAGIC = re.compile(r"^([ \t]*)([%!].*)$", re.MULTILINE)
MASKED = re.compile(r"^([ \t]*)#:MAGIC:", re.MULTILINE)
DIRECTIVE = re.compile(r"^\.\. (?:py:)?(auto\w+|currentmodule|module):: +([\w.]+)", re.MULTILINE)


@dataclass(frozen=True)
class Table:
    """Old names and their new ones.

    Attributes:
        modules: dotted names of modules.
        names: dotted names of what modules hold.
        arguments: keywords by the old dotted name of the function or class.
        calls: positional arguments by the dotted name of a function that had more of them.
        attributes: of fields, methods and keyword arguments.
    """

    modules: dict[str, str] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)
    arguments: dict[str, dict[str, str]] = field(default_factory=dict)
    calls: dict[str, list[str]] = field(default_factory=dict)
    attributes: dict[str, str] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> Table:
        """Returns the table of a JSON file."""
        return cls(**json.loads(path.read_text(encoding="utf-8")))

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

    def in_text(self, text: str) -> str:
        """Returns a text with new names in place of the old ones that it mentions."""
        text = IMPORT.sub(lambda found: self._new_import(*found.groups()), text)
        return self._pattern.sub(lambda found: self._new_text(found[0]), text)

    def homes(self, module: str, names: Sequence[str]) -> list[tuple[str, str]]:
        """Returns (module, name) now of each of the names that are imported from a module."""
        found = []
        for name in names:
            home, _, last = (self.dotted(f"{module}.{name}") or f"{module}.{name}").rpartition(".")
            found.append((home, last))
        return found

    def _new_import(self, module: str, imported: str) -> str:
        names = imported.split(", ")
        by_module: dict[str, list[str]] = {}
        homes = self.homes(module, [name.split(" ")[0] for name in names])
        for name, (home, last) in zip(names, homes, strict=True):
            by_module.setdefault(home, []).append(" ".join([last, *name.split(" ")[1:]]))
        return "; ".join(f"from {home} import {', '.join(x)}" for home, x in by_module.items())

    def _new_text(self, old: str) -> str:
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
        if homes == [(module, name) for name in names]:
            return updated_node
        by_module: dict[str, list[cst.ImportAlias]] = {}
        for alias, (home, last) in zip(aliases, homes, strict=True):
            alias = alias.with_changes(name=cst.Name(last), comma=cst.MaybeSentinel.DEFAULT)
            by_module.setdefault(home, []).append(alias)
        statements = [
            cst.ImportFrom(module=expression(home), names=names)
            for home, names in by_module.items()
        ]
        return cst.FlattenSentinel(statements)

    def leave_SimpleStatementLine(  # noqa: N802
        self, original_node: cst.SimpleStatementLine, updated_node: cst.SimpleStatementLine
    ) -> cst.SimpleStatementLine | cst.FlattenSentinel[cst.SimpleStatementLine]:
        """Gives each import a line where one has become several."""
        body = updated_node.body
        if len(body) == len(original_node.body):
            return updated_node
        lines = [cst.SimpleStatementLine([x]) for x in body]
        lines[0] = lines[0].with_changes(leading_lines=updated_node.leading_lines)
        end = updated_node.trailing_whitespace
        lines[-1] = lines[-1].with_changes(trailing_whitespace=end)
        return cst.FlattenSentinel(lines)

    def visit_Arg(self, node: cst.Arg) -> None:  # noqa: N802
        """Notes where the package is handed to a function, such as `getattr`."""
        for found in self.get_metadata(QualifiedNameProvider, node.value, set()):
            if found.name == PACKAGE and found.source is QualifiedNameSource.IMPORT:
                self._doubt(node, f"{dotted_name(node.value)} is an argument of a function")

    def visit_Call(self, node: cst.Call) -> None:  # noqa: N802
        """Notes calls with more positional arguments than their function takes now."""
        keywords = [x.keyword.value for x in node.args if x.keyword is not None]
        given = sum(x.keyword is None and not x.star for x in node.args)
        for found in self.get_metadata(QualifiedNameProvider, node.func, set()):
            for name in (found.name, self.table.dotted(found.name)):
                taken = self.table.calls.get(name or "")
                if taken and given + sum(x in taken for x in keywords) > len(taken):
                    self._doubt(node, f"{name} takes ({', '.join(taken)}) now")
                    return

    def leave_Import(  # noqa: N802
        self, original_node: cst.Import, updated_node: cst.Import
    ) -> cst.Import:
        """Renames `import a.b`."""
        names = []
        for alias in updated_node.names:
            new = self.table.dotted(dotted_name(alias.name) or "")
            names.append(alias if new is None else alias.with_changes(name=expression(new)))
        return updated_node.with_changes(names=names)

    def leave_Attribute(  # noqa: N802
        self, original_node: cst.Attribute, updated_node: cst.Attribute
    ) -> cst.BaseExpression:
        """Renames what is reached by way of an imported module, and attributes."""
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
        """Renames in docstrings and messages."""
        return updated_node.with_changes(value=self.table.in_text(updated_node.value))

    def leave_FormattedStringText(  # noqa: N802
        self, original_node: cst.FormattedStringText, updated_node: cst.FormattedStringText
    ) -> cst.FormattedStringText:
        """Renames in messages."""
        return updated_node.with_changes(value=self.table.in_text(updated_node.value))

    def leave_Comment(  # noqa: N802
        self, original_node: cst.Comment, updated_node: cst.Comment
    ) -> cst.Comment:
        """Renames in comments."""
        return updated_node.with_changes(value=self.table.in_text(updated_node.value))

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

    def _doubt(self, node: cst.CSTNode, reason: str) -> None:
        line = self.get_metadata(PositionProvider, node).start.line
        self.doubts.append((line, reason))


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
    for doubt in renamer.doubts:
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


def rewritten(path: Path, table: Table, report: Report = silent) -> str:
    """Returns the new content of a file.

    Args:
        path: of the file.
        table: the names.
        report: called with lines that need a look.
    """
    text = path.read_text(encoding="utf-8")
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
        if new != path.read_text(encoding="utf-8"):
            changed += 1
            print(path)
            if not given.check:
                path.write_text(new, encoding="utf-8")
    return int(given.check and changed > 0)


if __name__ == "__main__":
    sys.exit(main())
