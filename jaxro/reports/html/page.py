"""What a page consists of, whatever it reports: a verdict, sentences, tables, pictures.

Every command makes a `Page` of what it found; `render.to_html` turns it into one file.
Texts are plain: the template escapes them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum


class Tone(Enum):
    """What a text or a row says of itself: a page shows it by a sign and a colour."""

    plain = ""
    good = "good"
    mind = "mind"
    bad = "bad"


@dataclass(frozen=True)
class Prose:
    """A sentence or several; lines stay lines."""

    text: str
    tone: Tone = Tone.plain
    kind = "prose"


@dataclass(frozen=True)
class Row:
    """The cells of a row; `link`: the anchor of the section that tells more of it."""

    cells: Sequence[str]
    tone: Tone = Tone.plain
    link: str = ""


@dataclass(frozen=True)
class Table:
    """A table that may be sorted by any column and, if it is long, searched. `numbers`:
    which columns are numbers, which stand right."""

    title: str
    heads: Sequence[str]
    numbers: Sequence[bool]
    rows: Sequence[Row]
    note: str = ""
    kind = "table"


@dataclass(frozen=True)
class Figure:
    """A picture as SVG text, and what it shows."""

    svg: str
    caption: str
    kind = "figure"


@dataclass(frozen=True)
class Facts:
    """Names with what belongs to them: settings, or definitions."""

    entries: Sequence[tuple[str, str]]
    kind = "facts"


Block = Prose | Table | Figure | Facts


@dataclass(frozen=True)
class Section:
    """Blocks under a heading. `anchor`: where links to it lead; `level`: 2 for a part of
    the page, 3 for a part of it, shown when it is asked for."""

    heading: str
    blocks: Sequence[Block]
    anchor: str = ""
    level: int = 2


@dataclass(frozen=True)
class Page:
    """A report: title, what it is about, the verdict in one sentence, what to mind, the
    sections, and the settings that repeat it."""

    title: str
    about: str
    verdict: Prose
    mind: Sequence[str] = ()
    sections: Sequence[Section] = ()
    settings: Sequence[tuple[str, str]] = field(default_factory=tuple)
