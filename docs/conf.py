"""The documentation site: plain Markdown, executed by the build.

    sphinx-build -W --keep-going -b html docs docs/_build/html

The pages read well without the site, too: a `python` block is followed by a `text` block
with what it prints. `prepare` makes cells of the first, which the build executes;
`check_outputs` compares what they print with the second. What stands between `<!--` and
`-->` on a line of its own may ask for a part that the build makes:

    members of: MODULE     the public names of a module, from the docstrings
    help of: jaxro         what every command prints with --help
    text of: FILE          a text from above this folder
"""

import importlib
import os
import re
import sys
from pathlib import Path

HERE = Path(__file__).parent
os.environ["JAXRO_QUIET"] = "1"  # pages show what their code prints, and no more
sys.path.insert(0, str(HERE))

from docutils import nodes  # noqa: E402
from pygments.lexers.special import TextLexer  # noqa: E402
from reference import describe_commands, describe_members, to_rest  # noqa: E402
from sphinx.util import logging  # noqa: E402

logger = logging.getLogger(__name__)

project = "jaxro"
author = "The jaxro authors"
copyright = "The jaxro authors"
version = release = importlib.import_module("jaxro").__version__

extensions = ["myst_nb", "sphinx.ext.autodoc"]
exclude_patterns = ["_build", "jupyter_execute"]
html_theme = "furo"
html_title = f"jaxro {version}"
html_copy_source = False

myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
nb_execution_mode = "cache"
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 400  # seconds of a cell; most of it is compiling
nb_merge_streams = True
autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False
autodoc_typehints = "none"
python_maximum_signature_line_length = 80
linkcheck_ignore = [r"https?://.*"]  # links within the site are checked, no others

HEADER = """---
file_format: mystnb
kernelspec:
  name: python3
---
"""
FIGURES = """```{code-cell}
:tags: [remove-cell]
%matplotlib inline
%config InlineBackend.figure_formats = ["svg"]
```

"""
CELL = re.compile(r"^```python\n(.*?)^```\n(?:\n*^```text\n(.*?)^```\n)?", re.M | re.S)
PART = re.compile(r"^<!-- (members|help|text) of: (\S+) -->$", re.M)
OUTSIDE = re.compile(r"\[([^]]*)\]\(\.\./(?!README|CONTRIBUTING)[^)]*\)")
SHOWN: dict[str, list[str]] = {}
"""What the blocks of each page print, as it is shown there."""
TEXTS = {"README.md": "readme.md", "CONTRIBUTING.md": "contributing.md"}


def to_notebook(text: str) -> str:
    """The page with every `python` block as a cell, without what it prints."""
    cells = CELL.sub(lambda m: f"```{{code-cell}}\n{m[1]}```\n", text)
    if cells == text:
        return text
    return HEADER + (FIGURES if "plots" in text else "") + cells


def to_lines(text: str) -> list[str]:
    """Without trailing blanks and empty lines at the ends."""
    return [line.rstrip() for line in text.strip("\n").splitlines()]


def check_outputs(app, doctree) -> None:
    """A warning, which ends a build with -W, for each cell that prints something else
    than its page shows."""
    cells = [
        part
        for part in doctree.findall(nodes.container)
        if part.get("nb_element") == "cell_code"
    ]
    for cell, expected in zip(cells, SHOWN[app.env.docname], strict=True):
        blocks = cell.findall(nodes.literal_block)
        streams = [block for block in blocks if "stream" in block["classes"]]
        # what is printed slowly comes in several blocks
        lines = [line for block in streams for line in to_lines(block.astext())]
        if lines != to_lines(expected):
            logger.warning(
                "a cell prints:\n%s\nwhere its page shows:\n%s",
                "\n".join(lines),
                expected,
                location=cell,
            )


def fill(text: str) -> str:
    """The page with the parts that it asks for."""
    make = {"members": describe_members, "help": describe_commands, "text": _read}
    return PART.sub(lambda m: make[m[1]](m[2]), text)


def _read(name: str) -> str:
    """A text from above this folder without its heading; links lead to its pages."""
    text = (HERE.parent / name).read_text(encoding="utf-8").split("\n", 1)[1]
    text = re.sub(r"\]\((?!docs/|#|https?:)", "](../", text)
    return text.replace("](docs/", "](")


def prepare(app, page: str, source: list[str]) -> None:
    """What Sphinx reads in place of the file."""
    text = fill(source[0])
    for name, of_site in TEXTS.items():
        text = re.sub(rf"\]\((?:\.\./)?{name}", f"]({of_site}", text)
    text = OUTSIDE.sub(r"\1", text)
    SHOWN[page] = [output for _, output in CELL.findall(text)]
    source[0] = to_notebook(text)


def render_docstring(app, what, name, found, options, lines: list[str]) -> None:
    """Docstrings are plain English: nothing in them is markup but `code`, lists and
    indented formulas."""
    lines[:] = to_rest(lines)


def setup(app) -> None:
    for language in ("csv", "layout"):
        app.add_lexer(language, TextLexer)
    app.connect("source-read", prepare)
    app.connect("doctree-read", check_outputs)
    app.connect("autodoc-process-docstring", render_docstring)
