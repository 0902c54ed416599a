"""A page as one self-contained HTML file, by jinja2."""

from __future__ import annotations

import platform
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

from ...tables.fields import tell_lines
from .page import Page

PROGRAMS = ("jaxro", "jax", "optimistix", "numpy")
"""Programs whose versions a report tells."""

LONG = 12
"""Rows from which on a table can be searched."""

SHOWN = 300
"""Rows that page.css shows of a table, in the order that is asked for."""


def to_html(page: Page) -> str:
    """The whole file. Raises ModuleNotFoundError where jinja2 is missing."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    jinja = Environment(
        loader=PackageLoader("jaxro.reports", "html"),
        autoescape=True,
        finalize=_plain,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return jinja.get_template("page.html").render(
        page=page, versions=versions(), made=_now(), long=LONG, shown=SHOWN
    )


def _plain(value: Any) -> Any:
    """Text without control characters and marks of direction; markup as it is."""
    is_text = isinstance(value, str) and not hasattr(value, "__html__")
    return tell_lines(value) if is_text else value


def to_pdf(page: Page) -> bytes:
    """The page as it is printed, by weasyprint."""
    from weasyprint import HTML  # pyright: ignore[reportMissingImports]

    found = HTML(string=to_html(page)).write_pdf()
    assert found is not None
    return found


def versions() -> list[tuple[str, str]]:
    """The programs that calculated, with their versions."""
    found = [(name, version(name)) for name in PROGRAMS]
    return [*found, ("Python", platform.python_version())]


def _now() -> str:
    return f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
