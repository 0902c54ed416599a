"""The parts of the site that are made of the code: public names and commands."""

import ast
import importlib
import inspect
import re
import types
from pathlib import Path
from typing import Any

CODE = re.compile(r"(`+)(.+?)\1", re.S)
MARKUP = re.compile(r"([\\*|_`])")
ITEM = re.compile(r"(?:[*-]|\d+\.) ")
COLUMNS = re.compile(r"\S {2,}\S")


def public_names(module: types.ModuleType) -> list[str]:
    """The names that the file of a package exports ("X as X"), and its constants with
    a docstring; none of a plain module."""
    tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
    names = []
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            names += [alias.name for alias in node.names if alias.asname == alias.name]
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names.append(node.target.id)
    return names


def members(name: str) -> list[str]:
    """The public names of a package that are no modules."""
    package = importlib.import_module(name)
    if not hasattr(package, "__path__"):
        return []
    found = [n for n in public_names(package) if not inspect.ismodule(vars(package)[n])]
    return sorted(found, key=lambda n: _place(package, n)) if name == "jaxro" else found


def _place(package: types.ModuleType, name: str) -> int:
    """The place of a name by the order in which the packages stand on each other."""
    of_member = getattr(vars(package)[name], "__module__", name).split(".")
    return list(vars(package)).index(of_member[1] if of_member[1:] else name)


def describe_members(name: str) -> str:
    """What autodoc shows of a package (the names that it exports) or of a module (all
    its public names)."""
    module = importlib.import_module(name)
    if not hasattr(module, "__path__"):
        return _directive("automodule", name, "members")
    lines = [_directive("automodule", name, "no-index")]
    here = [(m, _stands_elsewhere(name, getattr(module, m))) for m in members(name)]
    for member, elsewhere in sorted(here, key=lambda pair: pair[1]):
        found = getattr(module, member)
        if inspect.isclass(found):
            once = ["no-index"] if elsewhere else []
            lines.append(_directive("autoclass", f"{name}.{member}", "members", *once))
        elif callable(found) and hasattr(found, "__name__"):
            lines.append(_directive("autofunction", f"{name}.{member}"))
        else:
            lines.append(_directive("autodata", f"{name}.{member}", "no-value"))
    return "\n\n".join(lines)


def _stands_elsewhere(name: str, found: Any) -> bool:
    """Whether something of `jaxro` is shown by the package that it comes from, too."""
    if name != "jaxro":
        return False
    package = ".".join(found.__module__.split(".")[:2])
    return found.__name__ in members(package)


def _directive(kind: str, name: str, *options: str) -> str:
    inside = "\n".join([f".. {kind}:: {name}", *(f"   :{o}:" for o in options)])
    return f"```{{eval-rst}}\n{inside}\n```"


def describe_commands(program: str) -> str:
    """What `jaxro --help` and `jaxro COMMAND --help` print, one section each."""
    from typer.main import get_command
    from typer.testing import CliRunner

    from jaxro.cli import app

    runner = CliRunner(env={"COLUMNS": "100", "NO_COLOR": "1"})
    commands = ["", *get_command(app).commands]  # pyright: ignore
    shown = []
    for command in commands:
        asked = [command, "--help"] if command else ["--help"]
        printed = runner.invoke(app, asked, prog_name=program).stdout.strip()
        shown.append(f"## {program} {command}".rstrip())
        shown.append(f"```text\n{printed}\n```")
    return "\n\n".join(shown)


def to_rest(lines: list[str]) -> list[str]:
    """A docstring in plain English as reStructuredText: `code` as code, indented blocks
    and columns as they are, every other sign as itself."""
    text = "\n".join(lines).strip("\n")
    shown: list[str] = []
    for block in re.split(r"\n\s*\n", text):
        rows = block.split("\n")
        if _is_formula(rows):
            shown += ["::", "", *("    " + row for row in rows), ""]
        elif any(ITEM.match(row) for row in rows):
            shown += [*_items(rows), ""]
        else:
            shown += [*_escape("\n".join(r.strip() for r in rows)).split("\n"), ""]
    return shown


def _is_formula(rows: list[str]) -> bool:
    """Indented, or in columns."""
    indented = all(row.startswith("    ") for row in rows)
    return indented or sum(bool(COLUMNS.search(row)) for row in rows) > 1


def _items(rows: list[str]) -> list[str]:
    """A list; what stands above it is a paragraph of its own."""
    shown: list[str] = []
    for row in _escape("\n".join(rows)).split("\n"):
        item = ITEM.match(row.replace("\\*", "*", 1))
        if item:
            row = row.replace("\\*", "*", 1)
            shown.append("")
        shown.append(row)
    return shown


def _escape(text: str) -> str:
    """Text without markup but `code`."""
    shown, end = "", 0
    for found in CODE.finditer(text):
        shown += MARKUP.sub(r"\\\1", text[end : found.start()])
        shown += f"``{found[2].strip()}``"
        if text[found.end() : found.end() + 1].isalnum():
            shown += "\\ "
        end = found.end()
    return shown + MARKUP.sub(r"\\\1", text[end:])
