"""The tables of --out of `jaxro block`, as columns by name in full precision, and
summary.json. Angles are degrees; residuals and places have the unit of the photo
coordinates."""

from typing import Any

import numpy as np

from .. import __version__
from ..adjustment import RESULTS
from . import files
from .block_model import STATION_OF, Done
from .control import AXES, Compared

ANGLES = ("omega", "phi", "kappa")
POSE = (*ANGLES, *AXES)
Columns = dict[str, Any]


def tables(done: Done) -> dict[str, Columns]:
    """The tables by name; none where the numbers may not be used."""
    if not done.usable:
        return {}
    found = {
        "photos": _photos(done),
        "points": _points(done),
        "control": _control(done),
        "residuals": _residuals(done),
        "cameras": _cameras(done),
        "fields": _fields(done),
        "bars": _bars(done),
        "photo_covariances": _photo_covariances(done),
        "point_covariances": _point_covariances(done),
    }
    return {name: table for name, table in found.items() if len(_first(table))}


def contents(done: Done, parquet: bool = False) -> dict[str, str | bytes]:
    """The files by name: the tables as CSV text, or as Parquet."""
    found: dict[str, str | bytes] = {}
    for name, columns in tables(done).items():
        if parquet:
            found[f"{name}.parquet"] = _parquet(columns)
        else:
            found[f"{name}.csv"] = files.columns_text(_python(columns))
    return found | {"summary.json": files.json_text(summary(done))}


def summary(done: Done) -> dict[str, Any]:
    """What summary.json says."""
    adjusted, wrong = done.adjusted, done.oriented.wrong
    return {
        "program": f"jaxro {__version__}",
        "file": done.title,
        "result": _result(done),
        "usable": done.usable,
        "cause": None if done.oriented.cause is None else done.oriented.cause._asdict(),
        "contradictions": list(done.contradictions),
        "sigma": done.sigma,
        "sigma0": adjusted.sigma0,
        "degrees_of_freedom": adjusted.degrees_of_freedom,
        "probability": done.chance if adjusted.degrees_of_freedom > 0 else None,
        "components": {
            name: one._asdict() for name, one in done.oriented.components.items()
        },
        "iterations": adjusted.adjustment.iterations,
        "pairs": len(done.pairs),
        "pairs_without_orientation": _unoriented(done),
        "photos": len(adjusted.block.photos),
        "points": int(np.sum(done.determined)),
        "points_undetermined": done.lonely,
        "rays": int(np.sum(adjusted.numbered.rays)),
        "rays_left_out": int(np.sum(wrong.rays)),
        "control_coordinates": int(np.sum(done.control.known & ~done.wrong_control)),
        "control_left_out": _names_left_out(done),
        "check_points": len(done.checks.names),
        "unit": done.unit,
        "field": _field(done),
    }


def _field(done: Done) -> dict[str, Any] | None:
    """How smooth and how large the displacement fields of the cameras are."""
    found = done.adjusted.field if done.usable else None
    if found is None:
        return None
    sizes = {
        one.camera: {"rms": one.rms, "largest": one.largest}
        for one in done.adjusted.fields
    }
    return {
        "length": found.length,
        "strength": float(found.strength),
        "cameras": sizes,
    }


def _result(done: Done) -> str:
    """The name of the result, or of what is wrong with what was given as a whole."""
    cause = done.oriented.cause
    if cause is not None and not cause.is_hint:
        return cause.name
    if done.contradictions:
        return "contradicts"
    names = {int(item._value): name for name, item in RESULTS._name_to_item.items()}
    return str(names[int(done.adjusted.result._value)])


def _unoriented(done: Done) -> list[str]:
    pairs = zip(done.pairs, done.oriented.usable.tolist(), strict=True)
    return [name for name, usable in pairs if not usable]


def _names_left_out(done: Done) -> list[str]:
    rows = np.flatnonzero(np.any(done.wrong_control & done.control.known, axis=1))
    return [done.control.names[k] for k in rows]


# -------------------------------------------------------------------------------------
# the tables


def _photos(done: Done) -> Columns:
    adjusted = done.adjusted
    table: Columns = {"photo": list(adjusted.block.photos)}
    table |= _with_names(AXES, adjusted.centres)
    table |= _with_names(AXES, adjusted.centre_deviations, "s")
    degrees = [f"{name}_deg" for name in ANGLES]
    table |= _with_names(degrees, np.degrees(adjusted.angles))
    table |= _with_names(degrees, np.degrees(adjusted.angle_deviations), "s_")
    return table | {"rays": done.points_of_photos}


def _cameras(done: Done) -> Columns:
    """The inner parameters that were unknown, one in each row."""
    if done.adjusted.inner is None:
        return {"camera": []}
    found = done.adjusted.cameras
    number = len(found.names)
    return {
        "camera": np.repeat(np.array(found.cameras), number),
        "parameter": list(found.names) * len(found.values),
        "value": found.values.ravel(),
        "sd": found.deviations.ravel(),
    }


def _fields(done: Done) -> Columns:
    """The displacement field of each camera over its measured area: what is to be taken
    off a place to have that of a camera without it."""
    fields = done.adjusted.fields
    if not fields:
        return {"camera": []}
    all_ = lambda of: np.concatenate([of(one) for one in fields])
    names = [np.repeat(np.array([one.camera]), len(one.places)) for one in fields]
    table: Columns = {"camera": np.concatenate(names)}
    table |= _with_names(("x", "y"), all_(lambda one: one.places))
    table |= _with_names(("dx", "dy"), all_(lambda one: one.displacements))
    return table | _with_names(("s_dx", "s_dy"), all_(lambda one: one.deviations))


def _bars(done: Done) -> Columns:
    """The scale bars; w is empty where nothing checks them."""
    bars = done.bars
    if bars is None:
        return {"from": []}
    return {
        "from": list(bars.one),
        "to": list(bars.other),
        "length": bars.length,
        "sigma": bars.sigma,
        "v": done.bar_differences[0],
        "redundancy": np.nan_to_num(done.adjusted.bar_redundancy),
        "w": done.bar_tests,
    }


def _points(done: Done) -> Columns:
    there = np.flatnonzero(done.determined)
    adjusted = done.adjusted
    roles = {name: "control" for name in done.control.names}
    roles |= {name: "check" for name in done.checks.names}
    names = [adjusted.block.points[k] for k in there]
    table: Columns = {"point": names}
    table |= _with_names(AXES, adjusted.coordinates[there])
    table |= _with_names(AXES, adjusted.deviations[there], "s")
    return table | {"role": [roles.get(name, "") for name in names]}


def _control(done: Done) -> Columns:
    both = (done.control, done.checks)
    stack = lambda of: np.concatenate([of(one) for one in both])
    known = stack(lambda one: one.known)
    shown = lambda values: np.where(known, values, np.nan)
    blank = np.full(done.checks.w.shape, np.nan)
    redundancy = np.concatenate([done.control_redundancy, blank])
    left_out = np.concatenate([done.wrong_control, np.zeros(blank.shape, bool)])
    table: Columns = {
        "point": [name for one in both for name in one.names],
        "role": [_role(n, "control") for n in both[0].names]
        + [_role(n, "check") for n in both[1].names],
    }
    table |= _with_names(AXES, shown(stack(lambda one: one.given)))
    table |= _with_names(AXES, shown(stack(lambda one: one.differences)), "v")
    table |= _with_names(AXES, shown(redundancy), "redundancy_")
    table |= _with_names(AXES, shown(stack(_tests)), "w_")
    return table | {"left_out": np.any(left_out & known, axis=1).tolist()}


def _finite(values: np.ndarray) -> np.ndarray:
    """The numbers, NaN where nothing checks a coordinate."""
    return np.where(np.isfinite(values), values, np.nan)


def _role(name: str, role: str) -> str:
    return "station" if name.startswith(STATION_OF) else role


def _tests(one: Compared) -> np.ndarray:
    return one.w


def _residuals(done: Done) -> Columns:
    adjusted, block = done.adjusted, done.adjusted.block
    table: Columns = {
        "photo": [block.photos[k] for k in block.photo],
        "point": [block.points[k] for k in block.point],
        "x": block.x,
        "y": block.y,
    }
    table |= _with_names("xy", adjusted.misfits, "v")
    table |= _with_names("xy", adjusted.redundancy, "redundancy_")
    table |= _with_names("xy", done.tested.rays, "w_")
    checked = done.reliability.rays
    table |= _with_names("xy", _finite(checked.detectable), "detectable_")
    table |= {"effect": _finite(checked.largest)}
    return table | {"left_out": done.oriented.wrong.rays.tolist()}


def _photo_covariances(done: Done) -> Columns:
    """The upper half of the covariance of each photo; angles in degrees."""
    units = np.array([np.degrees(1.0)] * 3 + [1.0] * 3)
    full = done.adjusted.photo_covariances * np.outer(units, units)
    return {"photo": list(done.adjusted.block.photos)} | _upper_half(POSE, full)


def _point_covariances(done: Done) -> Columns:
    there = np.flatnonzero(done.determined)
    names = [done.adjusted.block.points[k] for k in there]
    full = done.adjusted.point_covariances[there]
    return {"point": names} | _upper_half(AXES, full)


def _upper_half(names: tuple[str, ...], full: np.ndarray) -> Columns:
    rows, columns = np.triu_indices(len(names))
    pairs = zip(rows, columns, strict=True)
    return {f"{names[i]}_{names[j]}": full[:, i, j] for i, j in pairs}


def _with_names(names: Any, values: np.ndarray, before: str = "") -> Columns:
    """The columns of an array by their names."""
    return {f"{before}{n}": a for n, a in zip(names, values.T, strict=True)}


def _first(columns: Columns) -> Any:
    return next(iter(columns.values()))


def _python(columns: Columns) -> Columns:
    """Columns as Python objects."""
    return {
        name: values.tolist() if isinstance(values, np.ndarray) else values
        for name, values in columns.items()
    }


def _parquet(columns: Columns) -> bytes:
    """A Parquet table; what does not exist is null."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.table(
        {n: pa.array(values, from_pandas=True) for n, values in columns.items()}
    )
    file = pa.BufferOutputStream()
    pq.write_table(table, file)
    return file.getvalue().to_pybytes()
