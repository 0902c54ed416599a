"""An orientation as a data set of xarray: arrays with named dimensions and units."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..orientation.result import Orientation
from ..reports.columns import RESULT_NAMES


def to_xarray(
    orientation: Orientation,
    *,
    pairs: Sequence[str] | None = None,
    points: Sequence[str] | None = None,
    unit: str = "",
    sigma0_unit: str = "",
) -> Any:
    """An `xarray.Dataset` of an orientation, of one pair or of a batch (one leading
    axis), with the dimensions pair, point, element and element2.

    `pairs`, `points`: their names. `unit`: of the photo coordinates; `sigma0_unit`: of
    sigma0, "" where it is a ratio to given standard deviations. Units stand in the
    attribute `units`; those of `elements`, `deviation`, `cofactor` and `covariance` are
    in the coordinate `element_unit`: rad, or the unit of the base. Of pairs that are not
    usable the numbers are NaN. Needs xarray (the extra `xarray`). Raises ValueError for
    several leading axes, and for names of another count.
    """
    try:
        import xarray as xr
    except ModuleNotFoundError:
        raise ImportError(
            "Data sets of xarray need it: pip install 'jaxro[xarray]'"
        ) from None
    usable = np.asarray(orientation.usable)
    if usable.ndim > 1:
        raise ValueError(
            f"to_xarray: one leading axis of pairs is wanted, got {usable.shape}"
        )
    of_pair = ("pair",)[: usable.ndim]
    of_point, of_element = (*of_pair, "point"), (*of_pair, "element")
    of_two = (*of_element, "element2")
    found = orientation.elements
    values = np.stack([np.asarray(a) for a in found.values()], axis=-1)
    x, y, z = (np.asarray(axis) for axis in orientation.model)

    def column(dimensions: tuple[str, ...], a: Any, unit: str = "") -> tuple:
        """Numbers of the pairs that are usable."""
        a = np.asarray(a, float)
        there = usable.reshape((*usable.shape, *(1,) * (a.ndim - usable.ndim)))
        attributes = {"units": unit} if unit else {}
        return dimensions, np.where(there, a, np.nan), attributes

    names = np.array([RESULT_NAMES[i] for i in range(max(RESULT_NAMES) + 1)])
    variables = {
        "elements": column(of_element, values),
        "deviation": column(of_element, orientation.deviations),
        "cofactor": column(of_two, orientation.cofactor),
        "covariance": column(of_two, orientation.covariance),
        "quaternion": column((*of_pair, "wxyz"), orientation.pose.quaternion),
        "base": column((*of_pair, "axis"), orientation.pose.base),
        "m_q": column(of_pair, orientation.m_q, unit),
        "sigma0": column(of_pair, orientation.sigma0, sigma0_unit),
        "degrees_of_freedom": (of_pair, np.asarray(orientation.degrees_of_freedom)),
        "iterations": (of_pair, np.asarray(orientation.iterations)),
        "result": (of_pair, names[np.asarray(orientation.result._value)]),
        "usable": (of_pair, usable),
        "parallax": column(of_point, orientation.parallax, unit),
        "residuals": column(of_point, orientation.residuals, sigma0_unit),
        "redundancy": column(of_point, orientation.redundancy),
        "model": column((*of_point, "axis"), np.stack([x, y, z], axis=-1)),
        "in_front": (of_point, np.asarray(orientation.in_front)),
    }
    units = ["rad" if angle else "base" for angle in found.angles]
    coordinates: dict[str, Any] = {
        "element": list(found.names),
        "element2": list(found.names),
        "element_unit": ("element", units),
        "axis": ["X", "Y", "Z"],
        "wxyz": ["w", "x", "y", "z"],
    }
    count = orientation.parallax.shape[-1]
    if pairs is not None:
        named = _names(pairs, usable.size, "pairs")
        coordinates["pair"] = named if of_pair else named[0]
    if points is not None:
        coordinates["point"] = _names(points, count, "points")
    attributes = {"system": type(found).__name__}
    return xr.Dataset(variables, coordinates, attributes)


def _names(names: Sequence[str], count: int, kind: str) -> list[str]:
    """The names. Raises ValueError for another count."""
    if len(names) != count:
        raise ValueError(f"to_xarray: {len(names)} names of {count} {kind}")
    return list(names)
