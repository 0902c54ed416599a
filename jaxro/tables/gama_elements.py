"""The elements of the XML input of gama-local (schema gama-local.xsd 1.00), each where it
may stand and with the attributes that it may have, or one clear error.

A document type is refused, so that nothing is loaded from elsewhere and no entity is
expanded.
"""

import math
from dataclasses import dataclass, field
from xml.parsers import expat

from .fields import TableError

SIGHT = ("stdev", "from_dh", "to_dh", "extern")
OF_GAMA = (
    *("conf-pr", "tol-abs", "update-constrained-coordinates", "algorithm", "language"),
    *("encoding", "angles", "latitude", "ellipsoid", "cov-band"),
)
ATTRIBUTES = {
    "gama-local": ("xmlns", "version"),
    "network": ("axes-xy", "angles", "epoch"),
    "description": (),
    "parameters": ("sigma-apr", "sigma-act", *OF_GAMA),
    "points-observations": (
        *("distance-stdev", "direction-stdev", "angle-stdev"),
        *("zenith-angle-stdev", "azimuth-stdev"),
    ),
    "point": ("id", "x", "y", "z", "fix", "adj"),
    "obs": ("from", "orientation", "from_dh"),
    "direction": ("to", "val", *SIGHT),
    "distance": ("from", "to", "val", *SIGHT),
    "s-distance": ("from", "to", "val", *SIGHT),
    "z-angle": ("from", "to", "val", *SIGHT),
    "azimuth": ("from", "to", "val", *SIGHT),
    "angle": (
        *("from", "bs", "fs", "val", "stdev", "from_dh", "bs_dh", "fs_dh", "extern"),
    ),
    "height-differences": (),
    "dh": ("from", "to", "val", "stdev", "dist", "extern"),
    "vectors": (),
    "vec": ("from", "to", "dx", "dy", "dz", "from_dh", "to_dh", "extern"),
    "coordinates": ("extern",),
    "cov-mat": ("dim", "band"),
}
"""Elements and their attributes."""

CHILDREN = {
    "": ("gama-local",),
    "gama-local": ("network",),
    "network": ("description", "parameters", "points-observations"),
    "points-observations": (
        *("point", "obs", "height-differences", "vectors", "coordinates"),
    ),
    "obs": (
        *("direction", "distance", "angle", "s-distance", "z-angle", "azimuth"),
        "cov-mat",
    ),
    "height-differences": ("dh", "cov-mat"),
    "vectors": ("vec", "cov-mat"),
    "coordinates": ("point", "cov-mat"),
}
"""Elements and those that stand in them."""


@dataclass
class Element:
    """An element of a document, and where it begins."""

    file: str
    name: str
    line: int
    attributes: dict[str, str]
    children: list["Element"] = field(default_factory=list)
    text: str = ""

    def error(self, found: str, expected: str) -> TableError:
        """The error of this element."""
        return TableError(self.file, line=self.line, found=found, expected=expected)

    def point(self, key: str) -> str:
        """The name of a point. Raises TableError."""
        name = self.attributes.get(key, "").strip()
        if not name:
            raise self.error(f"<{self.name}> without {key}", "the name of a point")
        return name

    def number(self, key: str, usual: float | None = None) -> float:
        """A number, the usual one if there is none. Raises TableError."""
        given = self.attributes.get(key)
        if given is None:
            if usual is not None:
                return usual
            raise self.error(f"<{self.name}> without {key}", "a number")
        try:
            value = float(given)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(f"{key}={given!r} of <{self.name}>", "a number")
        return value

    def positive(self, key: str) -> float:
        """A number above zero. Raises TableError."""
        value = self.number(key)
        if value <= 0:
            raise self.error(f"{key}={value:g} of <{self.name}>", "a number above 0")
        return value


def read_elements(text: str, file: str) -> Element:
    """The elements of a text, each where it may stand, with attributes it may have."""
    root = Element(file, "", 1, {})
    stack = [root]
    parser = expat.ParserCreate()

    def error(found: str, expected: str) -> TableError:
        line = parser.CurrentLineNumber
        return TableError(file, line=line, found=found, expected=expected)

    def begin(name: str, attributes: dict[str, str]) -> None:
        above = stack[-1]
        allowed = CHILDREN.get(above.name, ())
        if name not in allowed:
            where = f" in <{above.name}>" if above.name else ""
            listed = ", ".join(f"<{entry}>" for entry in allowed) or "no element there"
            raise error(f"<{name}>{where}", listed)
        for key in attributes:
            if key not in ATTRIBUTES[name] and not key.startswith(("xmlns", "xsi:")):
                listed = ", ".join(ATTRIBUTES[name]) or "no attribute"
                raise error(f"the attribute {key} of <{name}>", listed)
        element = Element(file, name, parser.CurrentLineNumber, attributes)
        above.children.append(element)
        stack.append(element)

    def end(name: str) -> None:
        stack.pop()

    def write(data: str) -> None:
        element = stack[-1]
        if element.name in ("cov-mat", "description"):
            element.text += data
        elif data.strip():
            raise error(f"the text {data.strip()!r} in <{element.name}>", "elements")

    def refuse(name: str, *rest: object) -> None:
        raise error(
            f"<!DOCTYPE {name}>",
            "no document type: delete it; entities are not expanded, and nothing is "
            "loaded from elsewhere",
        )

    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.CharacterDataHandler = write
    parser.StartDoctypeDeclHandler = refuse
    parser.buffer_text = True
    try:
        parser.Parse(text, True)
    except expat.ExpatError as failure:
        raise TableError(
            file,
            line=failure.lineno,
            found=f"no XML ({expat.ErrorString(failure.code)})",
            expected="the XML input of gama-local",
        ) from None
    return root.children[0]
