"""The order of CONTRIBUTING.md: imports point downwards only, every module stands in
it, public names stand once."""

import ast
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "jaxro"
LAYOUT = re.search(
    r"```layout\n(.*?)```",
    (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"),
    re.DOTALL,
)
ORDER = [line.split()[0] for line in LAYOUT[1].splitlines()] if LAYOUT else []
ABOVE_ALL = {"__init__", "__main__"}
FILES = sorted(PACKAGE.rglob("*.py"))


def imported(file: Path) -> set[tuple[str, ...]]:
    """Modules of the package a file imports, as paths below it: ("io", "tables");
    ("io",) for the package io itself."""
    here = ("jaxro", *file.relative_to(PACKAGE).parent.parts)
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            above = here[: len(here) - node.level + 1] if node.level else ()
            module = (*above, *(node.module or "").split(".")) if node.module else above
            names = [(*module, alias.name) for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [tuple(alias.name.split(".")) for alias in node.names]
        else:
            continue
        for name in names:
            if name[0] == "jaxro" and name[1:] != (
                "__version__",
            ):  # a constant, which reports carry
                path = name[1:]
                while path and not is_module(path):
                    path = path[:-1]
                found.add(path)
    return found


def is_module(path: tuple[str, ...]) -> bool:
    place = PACKAGE.joinpath(*path)
    return place.with_suffix(".py").exists() or place.is_dir()


def test_layout_lists_the_modules():
    existing = {
        file.relative_to(PACKAGE).parts[0].removesuffix(".py") for file in FILES
    }
    assert set(ORDER) == existing - ABOVE_ALL
    assert not [name for name, count in Counter(ORDER).items() if count > 1]


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_imports_point_downwards(file):
    own = file.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if own in ABOVE_ALL:
        return
    for path in imported(file):
        assert path, (
            f"{file.name} imports the package's __init__, which stands above everything"
        )
        family = path[0] == own and len(file.relative_to(PACKAGE).parts) > 1
        assert family or ORDER.index(path[0]) < ORDER.index(own), (
            f"{own} imports {path[0]}, which stands below it"
        )


def test_families_have_no_cycles():
    from graphlib import TopologicalSorter

    TopologicalSorter(
        {
            file.relative_to(PACKAGE).with_suffix("").parts: imported(file)
            for file in FILES
            if file.stem != "__init__"
        }
    ).prepare()


def test_public_names_stand_once():
    """`__init__` re-exports as `X as X`, each name once, and defines nothing but its
    version."""
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    aliases = [
        alias
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    ]
    assert all(alias.name == alias.asname for alias in aliases)
    assert not [
        name
        for name, count in Counter(alias.name for alias in aliases).items()
        if count > 1
    ]
    assigned = [node.targets[0] for node in tree.body if isinstance(node, ast.Assign)]
    assert [target.id for target in assigned if isinstance(target, ast.Name)] == [
        "__version__"
    ]
    assert not [
        node for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)
    ]


def test_files_are_small():
    long = {
        file.name: count
        for file in FILES
        if (count := len(file.read_text(encoding="utf-8").splitlines())) > 460
    }
    assert not long


def test_importing_starts_nothing():
    """No array is made on import, which would start JAX before the user has chosen a
    device, and nothing is imported that only few calls need."""
    script = (
        "import sys, jaxro; from jax._src import xla_bridge; "
        "print(list(xla_bridge._backends), 'scipy.spatial' in sys.modules)"
    )
    line = [sys.executable, "-c", script]
    done = subprocess.run(line, capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == ["[]", "False"]
