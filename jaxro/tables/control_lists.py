"""Lists of control points as other programs write them, as lines of our tables:

Pix4D       no header: name, X, Y, Z, and optionally the accuracies in plan and in height
Metashape   lines of comments, #Label,X/Easting,Y/Northing,Z/Altitude, and columns of
            accuracies (which are read) and of errors and estimates (which are not)
ODM         gcp_list.txt: a line with the coordinate system, then X Y Z and a place in an
            image, its file, and the name of the point, apart by spaces

Lines keep their numbers: what is not read becomes a blank line.
"""

import csv
import io
import re
from typing import NamedTuple

from .fields import TableError, find_separator

PLAIN = ("point", "x", "y", "z")
WITH_ACCURACY = (*PLAIN, "sxy", "sz")

SYSTEM = re.compile(r"\s*(\+proj|epsg:|wgs ?84|utm)", re.IGNORECASE)
"""How the first line of ODM's list begins."""

READ = re.compile(
    r"#?label|[xyz]/(easting|northing|altitude)|[xyz]|accuracy.*",
    re.IGNORECASE,
)
"""The columns of Metashape that are read; an accuracy of another kind than those below
is an unknown column, and none that is lost."""

SHORT = {
    "e": "x",
    "easting": "x",
    "x/easting": "x",
    "n": "y",
    "northing": "y",
    "y/northing": "y",
    "h": "z",
    "height": "z",
    "elevation": "z",
    "altitude": "z",
    "z/altitude": "z",
    "name": "point",
    "label": "point",
    "accuracy_x": "sx",
    "accuracy_y": "sy",
    "accuracy_z": "sz",
    "accuracy_xy": "sxy",
    "accuracy_x/y/z": "sigma",
}
"""Columns of points on the ground by the names that they have elsewhere."""


class Lines(NamedTuple):
    """The text of a table, and its header where the text has none."""

    text: str
    header: tuple[str, ...] | None = None


def as_table(text: str, file: str) -> Lines:
    """The lines of a list of control points in the words of our tables; other text as it
    is. Raises TableError."""
    lines = text.splitlines()
    first = next((line for line in lines if line.strip()), "")
    if SYSTEM.match(first):
        return _of_odm(lines, file)
    heads = [k for k, line in enumerate(lines) if line.lower().startswith("#label")]
    if heads:
        return _of_metashape(lines, heads[0])
    separator, _ = find_separator([first])
    cells = next(csv.reader([first], delimiter=separator), [])
    numbers = len(cells) - 1
    if numbers in (3, 5) and all(map(_is_number, cells[1:])):
        return Lines(text, PLAIN if numbers == 3 else WITH_ACCURACY)
    return Lines(text)


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _of_metashape(lines: list[str], head: int) -> Lines:
    """The columns that are read, from the header on."""
    separator, _ = find_separator([lines[head]])
    header = next(csv.reader([lines[head]], delimiter=separator))
    use = [k for k, name in enumerate(header) if READ.fullmatch(name.strip())]
    found = [""] * head
    for k, line in enumerate(lines[head:]):
        if k > 0 and line.startswith("#"):
            found.append("")
            continue
        cells = next(csv.reader([line], delimiter=separator), [])
        cells = [cells[j] for j in use if j < len(cells)]
        if k == 0:
            cells = [_plain(name) for name in cells]
        found.append(_line(cells, separator))
    return Lines("\n".join(found))


def _plain(name: str) -> str:
    """A column of Metashape without marks and units: Accuracy_X/Easting_(m) is
    accuracy_x."""
    name = re.sub(r"_\(.*\)", "", name.strip().lower().lstrip("#"))
    return re.sub(r"^(accuracy_[xyz])/(easting|northing|altitude)$", r"\1", name)


def _of_odm(lines: list[str], file: str) -> Lines:
    """The points of ODM's list, each on the line where it comes first. Raises
    TableError for a line without a name, and for a point at two places."""
    found, first = [], {}
    system = False
    for number, line in enumerate(lines, 1):
        cells = line.split()
        if not cells or not system:
            system = system or bool(cells)
            found.append("")
            continue
        if len(cells) < 7:
            raise TableError(
                file,
                line=number,
                found=f"{len(cells)} entries",
                expected="X Y Z, the place x y in an image, its file, and the name of "
                "the point: lines without names do not tell which are one point",
            )
        name, at = cells[6], cells[:3]
        if first.setdefault(name, (number, at))[1] != at:
            raise TableError(
                file,
                line=number,
                column="point",
                found=f"{name!r} at {' '.join(at)}, and on line {first[name][0]} at "
                f"{' '.join(first[name][1])}",
                expected="one place on the ground for each point",
            )
        is_new = first[name][0] == number
        found.append(_line([name, *at], ",") if is_new else "")
    return Lines("\n".join(found), PLAIN)


def _line(cells: list[str], separator: str) -> str:
    """One line of a table."""
    out = io.StringIO()
    csv.writer(out, delimiter=separator, lineterminator="").writerow(cells)
    return out.getvalue()
