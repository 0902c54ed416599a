"""The documentation site: pages become notebooks, every page can be reached, every
public name is shown, docstrings become text, and the whole of it builds without a
warning."""

import importlib
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import jaxro

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
pytest.importorskip("sphinx", reason="the site needs pip install 'jaxro[docs]'")
pytest.importorskip("myst_nb", reason="the site needs pip install 'jaxro[docs]'")
nodes = pytest.importorskip("docutils.nodes")


@pytest.fixture(scope="module")
def site():
    """docs/conf.py and docs/reference.py as modules."""
    sys.path.insert(0, str(DOCS))
    try:
        yield importlib.import_module("conf"), importlib.import_module("reference")
    finally:
        sys.path.remove(str(DOCS))
        for name in ("conf", "reference"):
            sys.modules.pop(name, None)


def shown(page: str, text: str, site) -> str:
    """What Sphinx reads of a page."""
    source = [text]
    site[0].prepare(None, page, source)
    return source[0]


PAGE = """# Title

```python
print("""
PAGE += """1)
```

```text
1
```

<!-- output of: jaxro orient -->
```text
kept
```

```python
x = 2
```
Words, [a text](../README.md#conventions), [a file](../benchmarks/results.md).
"""


def test_blocks_of_python_become_cells(site):
    page = shown("page", PAGE, site)
    assert page.startswith("---\nfile_format: mystnb\n")
    assert re.findall(r"^```(\S+)$", page, re.M) == [
        "{code-cell}",
        "text",
        "{code-cell}",
    ]
    assert "print(1)\n```\n" in page and "x = 2\n```\n" in page
    assert "kept" in page
    assert "```text\n1\n" not in page


def test_links_lead_to_pages_of_the_site(site):
    page = shown("page", PAGE, site)
    assert "[a text](readme.md#conventions)" in page
    assert "a file." in page and "benchmarks" not in page


def test_page_without_code_is_no_notebook(site):
    assert shown("page", "# Title\n\nWords.\n", site) == "# Title\n\nWords.\n"


def test_pictures_are_shown_where_a_page_draws(site):
    drawing = "```python\nplots.figure_of(axes)\n```\n"
    assert "%matplotlib inline" in shown("page", drawing, site)
    assert "%matplotlib inline" not in shown("page", PAGE, site)


def test_cell_that_prints_something_else_than_its_page_shows_is_told(site, caplog):
    shown("page", PAGE, site)
    app = SimpleNamespace(env=SimpleNamespace(docname="page"))

    def read(*printed: str):
        page = nodes.document(None, None)
        for text in printed:
            cell = nodes.container(nb_element="cell_code")
            cell += nodes.literal_block(text, text, classes=["output", "stream"])
            page += cell
        site[0].check_outputs(app, page)

    read("1\n", "")
    assert not caplog.records
    read("2\n", "")
    (told,) = caplog.records
    assert "a cell prints:\n2" in told.getMessage()
    with pytest.raises(ValueError, match="zip"):
        read("1\n")


def test_every_page_stands_in_the_contents():
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    lists = re.findall(r"^```\{toctree\}\n(.*?)^```", index, re.M | re.S)
    listed = [
        line for part in lists for line in part.splitlines() if line and line[0] != ":"
    ]
    pages = [*DOCS.glob("*.md"), *(DOCS / "api").glob("*.md")]
    names = {page.relative_to(DOCS).with_suffix("").as_posix() for page in pages}
    assert sorted(listed) == sorted(names - {"index"})


def test_every_public_name_stands_in_the_reference(site):
    """Names of `jaxro`, and of every package that has a page: functions and classes as
    such, modules by a part of their own."""
    asked = [
        name
        for page in sorted((DOCS / "api").glob("*.md"))
        for name in re.findall(r"^<!-- members of: (\S+) -->$", page.read_text(), re.M)
    ]
    assert len(set(asked)) == len(asked)
    text = "\n".join(site[1].describe_members(name) for name in asked)
    described = set(re.findall(r"^\.\. auto\w+:: (\S+)$", text, re.M))
    packages = [name for name in asked if name.count(".") < 2]
    assert {"jaxro", "jaxro.plots", "jaxro.exchange", "jaxro.block"} <= set(packages)
    missing = []
    for name in packages:
        package = importlib.import_module(name)
        for public in site[1].public_names(package):
            member = getattr(package, public)
            module = getattr(member, "__path__", None) or hasattr(member, "__spec__")
            place = member.__name__ if module else f"{name}.{public}"
            if place not in described:
                missing.append(place)
    assert not missing


def test_procedures_are_described(site):
    text = site[1].describe_members("jaxro.rejection")
    assert ".. autodata:: jaxro.rejection.PROCEDURES" in text
    for procedure in jaxro.rejection.PROCEDURES.values():
        assert f".. autoclass:: jaxro.rejection.{type(procedure).__name__}\n" in text


def test_help_of_every_command_is_shown(site):
    pytest.importorskip("typer", reason="the command line needs typer and rich")
    text = site[1].describe_commands("jaxro")
    headings = re.findall(r"^## (.*)$", text, re.M)
    assert headings[0] == "jaxro" and "jaxro orient" in headings
    assert text.count("Usage: jaxro") == len(headings)


def test_docstrings_are_text(site):
    lines = """Σ |r| of x_left * 2, as `orient` does.

        r = a * b_1

    * one item, of x_left
    * another

    heights    of single points
    legs       between points""".replace("\n    ", "\n").splitlines()
    assert site[1].to_rest(lines) == [
        r"Σ \|r\| of x\_left \* 2, as ``orient`` does.",
        "",
        "::",
        "",
        "        r = a * b_1",
        "",
        "",
        r"* one item, of x\_left",
        "",
        "* another",
        "",
        "::",
        "",
        "    heights    of single points",
        "    legs       between points",
        "",
    ]


@pytest.mark.slow
def test_site_builds_without_warnings(tmp_path):
    """Links, contents and reference. The cells are not executed here: `.ci/run` builds the
    site with them."""
    options = ["nb_execution_mode=off", "suppress_warnings=myst-nb.lexer"]
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    for option in options:
        command += ["-D", option]
    built = subprocess.run(
        [*command, str(DOCS), str(tmp_path / "site")], capture_output=True, text=True
    )
    assert built.returncode == 0, built.stderr
    page = (tmp_path / "site" / "api" / "jaxro.html").read_text(encoding="utf-8")
    assert 'id="jaxro.orient_batch"' in page
