"""Numbers of the XML input of gama-local: angles, their units, covariance matrices."""

import re

import numpy as np
from jaxtyping import Float

from .gama_elements import Element

CC = 1e-4
"""A centicentigon, in gons."""

SECOND = 1e-4 / 0.324
"""A second of arc, in gons."""

MM = 1e-3
"""A millimetre, in metres."""

DEGREES = re.compile(r"([-+]?)(\d+)-(\d+)-(\d+(?:\.\d*)?)")


def covariance_matrix(element: Element, count: int) -> Float[np.ndarray, "n n"]:
    """A covariance matrix, whose upper band is written row by row. Raises TableError."""
    dim, band = (int(element.number(key)) for key in ("dim", "band"))
    try:
        numbers = [float(entry) for entry in element.text.split()]
    except ValueError:
        numbers = [np.nan]
    places = [(i, j) for i in range(count) for j in range(i, min(i + band + 1, count))]
    if dim != count or len(numbers) != len(places) or not np.all(np.isfinite(numbers)):
        raise element.error(
            f"a <cov-mat> of dim {dim}, band {band} with {len(numbers)} numbers",
            f"dim {count}, the numbers measured before it, and {len(places)} finite "
            "entries of the upper band",
        )
    matrix = np.zeros((count, count))
    for (i, j), number in zip(places, numbers, strict=True):
        matrix[i, j] = matrix[j, i] = number
    return matrix


def root_of(
    element: Element, matrix: Float[np.ndarray, "m m"]
) -> Float[np.ndarray, "m m"]:
    """The lower triangle of its Cholesky factor. Raises TableError."""
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise element.error(
            "a matrix that is not positive", "variances and covariances"
        ) from None


def angle(element: Element) -> tuple[float, float]:
    """An angle in gons, and the gons of the unit of its deviation. Raises
    TableError."""
    given = element.attributes.get("val", "").strip()
    if match := DEGREES.fullmatch(given):
        sign, degrees, minutes, seconds = match.groups()
        size = float(degrees) + float(minutes) / 60 + float(seconds) / 3600
        return (-size if sign == "-" else size) / 0.9, SECOND
    return element.number("val"), CC
