"""The numbers of a procedure by name, and the same procedure with others."""

import dataclasses
import math
import typing
from typing import Any

import equinox as eqx

from ..rejection import AbstractProcedure
from ..tables.fields import TableError

PROBABILITIES = frozenset({"level", "confidence", "share", "wrong"})

POSITIVE = (PROBABILITIES - {"share"}) | {
    "sigma",
    "limit",
    "scale",
    "last",
    "count",
    "block",
    "shortlist",
    "margin",
}
"""Numbers without which a procedure rejects all points or none."""

Number = bool | int | float | None


def tolerances(part: Any) -> dict[str, Number]:
    """Every number of a procedure; those of its parts behind the name of the part:
    stages.0.search.limit."""
    found: dict[str, Number] = {}
    for name, value in _entries(part).items():
        if isinstance(value, eqx.Module | tuple):
            found |= {
                f"{name}.{below}": number for below, number in tolerances(value).items()
            }
        elif _kind(part, name) is not None:
            found[name] = value
    return found


def change(procedure: AbstractProcedure, changes: list[str]) -> AbstractProcedure:
    """The procedure after changes such as eps3=0.05; the part may be left out where
    only one has such a number.

    Raises TableError for an unknown name or an unusable value.
    """
    for change in changes:
        name, equals, text = (part.strip() for part in change.partition("="))
        known = tolerances(procedure)
        named = [path for path in known if path == name] or [
            path for path in known if path.endswith(f".{name}")
        ]
        if not equals or len(named) != 1:
            listed = (
                ", ".join(f"{path}={_shown(value)}" for path, value in known.items())
                or "none"
            )
            found = f"{name!r}" if equals else f"{change!r} without ="
            if len(named) > 1:
                found += f", which may be {' or '.join(named)}"
            raise TableError(
                "--tolerance", found=found, expected=f"NAME=VALUE with one of: {listed}"
            )
        procedure = _with(procedure, named[0], text)
    return procedure


def judges_by_sigma(part: Any) -> bool:
    """Whether the procedure holds residuals against the standard deviation that the
    pair states."""
    entries = _entries(part)
    if "sigma" in entries:
        return entries["sigma"] is None and not entries.get("estimated", False)
    return any(
        judges_by_sigma(value)
        for value in entries.values()
        if isinstance(value, eqx.Module | tuple)
    )


def check_sigma(name: str, procedure: AbstractProcedure, known: bool) -> None:
    """Raises TableError where the procedure judges by a standard deviation that nobody
    gave."""
    if judges_by_sigma(procedure) and not known:
        expected = (
            f"the standard deviation of a coordinate, by which {name} judges, or a "
            "column sigma in the table"
        )
        raise TableError(
            "--sigma", found="neither --sigma nor a column sigma", expected=expected
        )


def _entries(part: Any) -> dict[str, Any]:
    """The fields of a module or the entries of a tuple by name."""
    if isinstance(part, tuple):
        return {str(place): value for place, value in enumerate(part)}
    return {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}


def _with(part: Any, path: str, text: str) -> Any:
    name, _, rest = path.partition(".")
    value = _entries(part)[name]
    new = _with(value, rest, text) if rest else _value(name, _kind(part, name), text)
    if isinstance(part, tuple):
        return (*part[: int(name)], new, *part[int(name) + 1 :])
    return dataclasses.replace(part, **{name: new})


def _kind(part: Any, name: str) -> type | None:
    """bool, int or float; None for what is no number."""
    value = _entries(part)[name]
    if value is None and not isinstance(part, tuple):
        allowed = typing.get_args(
            next(field.type for field in dataclasses.fields(part) if field.name == name)
        )
        return next((kind for kind in (float, int) if kind in allowed), None)
    return next((kind for kind in (bool, int, float) if isinstance(value, kind)), None)


def _value(name: str, kind: type | None, text: str) -> Number:
    if kind is bool:
        if text.lower() in ("true", "false"):
            return text.lower() == "true"
        raise TableError(
            "--tolerance", found=f"{name}={text}", expected="true or false"
        )
    least, most = (0, 1) if name in PROBABILITIES else (0, math.inf)
    try:
        value = int(text) if kind is int else float(text)
    except ValueError:
        value = math.nan
    if not (least < value < most or (value == 0 and name not in POSITIVE)):
        kinds = "a whole number" if kind is int else "a number"
        size = (
            "between 0 and 1"
            if most == 1
            else "above 0"
            if name in POSITIVE
            else "not negative"
        )
        raise TableError(
            "--tolerance", found=f"{name}={text}", expected=f"{kinds}, {size}"
        )
    return value


def _shown(value: Number) -> str:
    return (
        str(value).lower()
        if isinstance(value, bool)
        else "none"
        if value is None
        else f"{value}"
    )
