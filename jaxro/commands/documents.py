"""What a call makes for people beside its tables: a report as a page, and pictures."""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields, is_dataclass
from hashlib import file_digest
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ..reports.files import json_text
from ..reports.html.page import Page
from ..reports.rows import ON_PAGE, showing
from ..reports.terminal import say_what
from ..tables import whole
from ..tables.fields import TableError

NEEDS = {"jinja2": "report", "matplotlib": "plots", "weasyprint": "pdf"}
"""Packages that documents need, and the extras that install them."""

Pictures = Mapping[str, bytes]
"""Pictures by the names of their files."""


@dataclass(frozen=True)
class Documents:
    """What is wanted: `report`: a file .html or .pdf; `plots`: a folder; `json`: a
    summary on standard output in place of the report there."""

    report: Path | None = None
    plots: Path | None = None
    json: bool = False

    def __bool__(self) -> bool:
        """Whether files are wanted."""
        return self.report is not None or self.plots is not None

    @contextmanager
    def claimed(
        self,
        *others: tuple[Path | None, whole.Check],
        force: bool,
        read: Sequence[Path | None],
    ) -> Iterator[None]:
        """Within the block no other process writes there, nor to the `others` that the
        call writes to; `force`: what is there may be replaced, but nothing that is
        `read`. Raises TableError where they may not be written or cannot be made."""
        if self.report is not None:
            _check_report(self.report)
        if self.plots is not None:
            _need("--plots", "matplotlib")
        own = (self.report, whole.check_file), (self.plots, whole.check_target)
        with whole.claim_all([*others, *own], force, read):
            yield

    def write(
        self,
        page: Callable[[], Page],
        pictures: Callable[[], Pictures],
        read: Sequence[Path | None] = (),
    ) -> str:
        """Make and write what is wanted; where it is, a line for each. Raises
        TableError."""
        lines = []
        if self.report is not None:
            with say_what("Making the report ..."), showing(ON_PAGE):
                _write_report(self.report, page())
            lines.append(f"Report written to {self.report}\n")
        if self.plots is not None:
            with say_what("Drawing ..."):
                drawn = pictures()
            if drawn:
                whole.write(self.plots, drawn, read)
            told = ", ".join(drawn) or "nothing, because nothing can be drawn"
            lines.append(f"Pictures written to {self.plots}: {told}\n")
        return "".join(lines)


NO_DOCUMENTS = Documents()


def _check_report(file: Path) -> None:
    """Raises TableError where no report of this kind can be made."""
    kind = file.suffix.lower()
    if kind not in (".html", ".pdf"):
        raise TableError(
            "--report",
            found=f"the name {file.name!r}",
            expected="a file that ends with .html, or with .pdf",
        )
    for package in (
        "jinja2",
        "matplotlib",
        *(["weasyprint"] if kind == ".pdf" else []),
    ):
        _need("--report", package)


def _need(option: str, package: str) -> None:
    if find_spec(package) is None:
        raise TableError(
            option,
            found=f"no package {package}",
            expected=f"it installed: pip install 'jaxro[{NEEDS[package]}]'",
        )


def _write_report(file: Path, page: Page) -> None:
    from ..reports.html.render import to_html, to_pdf

    if file.suffix.lower() == ".pdf":
        whole.write_file(file, to_pdf(page))
    else:
        whole.write_file(file, to_html(page))


def show_json(summary: dict[str, Any]) -> None:
    """A summary on standard output, which nothing else is written to."""
    sys.stdout.write(json_text(summary))


# -------------------------------------------------------------------------------------
# what repeats a call

NOT_TOLD = ("file", "out", "force", "documents")
"""Options that change nothing in the numbers, and the table, which is told apart."""


def settings(
    options: Any, read: Sequence[Path | None] = (), **more: str | None
) -> list[tuple[str, str]]:
    """What a report tells so that a call can be repeated: the files that were read, with
    their checksums, the options that are not the default, and what else is known."""
    files = [_with_checksum(file) for file in read if file is not None]
    told = [f"--{name.replace('_', '-')} {value}" for name, value in _given(options)]
    entries = {
        "Read": "\n".join(files) or "the embedded example",
        "Options": "\n".join(told) or "none",
    }
    return [*entries.items(), *((k, v) for k, v in more.items() if v)]


def _given(options: Any) -> Iterator[tuple[str, str]]:
    """The options that are not the default, those of parts among them."""
    for field in fields(options):
        value = getattr(options, field.name)
        default = None if field.default is MISSING else field.default
        if is_dataclass(value) and field.name not in NOT_TOLD:
            yield from _given(value)
        elif value in (default, (), []) or field.name in NOT_TOLD:
            continue
        elif isinstance(value, tuple | list):
            yield field.name, " ".join(map(str, value))
        else:
            yield field.name, "" if value is True else str(value)


def _with_checksum(file: Path) -> str:
    """A file with what tells whether it is still the same; a folder without."""
    if file.is_dir():
        return str(file)
    with file.open("rb") as opened:
        return f"{file} (SHA-256 {file_digest(opened, 'sha256').hexdigest()})"
