"""A picture as text or bytes: SVG to stand in a page, PNG, PDF.

The same picture gives the same bytes: there are no dates in it.
"""

import hashlib
import io
import re
from html import escape
from typing import Any

SHARP = 200
"""Dots per inch of a PNG."""

NOTHING = dict.fromkeys(("Creator", "Date", "Format", "Type"))
"""Metadata that SVG leaves out."""

IDS = re.compile(r'(\bid="|url\(#|href="#)')
"""Where SVG writes the name of a part of itself."""


def to_svg(drawn: Any) -> str:
    """A figure, or the figure of axes, as an `<svg>` element. Text is text, which can be
    read aloud and searched. Names of its parts have a prefix that is made of the whole
    picture, so that different pictures can stand in one page."""
    from matplotlib import rc_context

    file = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "jaxro"}):
        figure_of(drawn).savefig(file, format="svg", metadata=NOTHING)
    text = file.getvalue()
    text = text[text.index("<svg") :]
    name = hashlib.sha256(text.encode()).hexdigest()[:8]
    text = IDS.sub(rf"\g<1>p{name}-", text)
    told = escape(" / ".join(titles_of(figure_of(drawn))), quote=True)
    return text.replace("<svg", f'<svg role="img" aria-label="{told}"', 1)


def to_png(drawn: Any, dots_per_inch: float = SHARP) -> bytes:
    """A figure, or the figure of axes, as PNG."""
    return _bytes(drawn, format="png", dpi=dots_per_inch, metadata={"Software": None})


def to_pdf(drawn: Any) -> bytes:
    """A figure, or the figure of axes, as PDF with vectors."""
    return _bytes(drawn, format="pdf", metadata={"CreationDate": None})


WRITERS = {
    ".png": to_png,
    ".svg": lambda drawn: to_svg(drawn).encode(),
    ".pdf": to_pdf,
}
"""Formats by the endings of files."""


def figure_of(drawn: Any) -> Any:
    """The figure of axes, of several axes, or the figure itself."""
    if isinstance(drawn, tuple | list) or hasattr(drawn, "ravel"):
        drawn = next(iter(drawn))
    return getattr(drawn, "figure", None) or drawn


def titles_of(figure: Any) -> list[str]:
    """What the titles of a figure say, in one line each."""
    written = [figure.get_suptitle(), *(axes.get_title() for axes in figure.axes)]
    plain = (title.replace(r"\$", "$") for title in written if title)
    return [" ".join(title.split()) for title in plain]


def _bytes(drawn: Any, **how: Any) -> bytes:
    file = io.BytesIO()
    figure_of(drawn).savefig(file, **how)
    return file.getvalue()
