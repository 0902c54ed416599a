"""The tables of --out of `jaxro calibrate`, in full precision. Angles are degrees;
places and focal lengths are in the unit of the image, stations and points in that of
the object."""

from typing import Any

import numpy as np

from .. import __version__
from ..plots import CorrectionMap
from . import files
from .calibration_model import (
    BROWN,
    Distances,
    Done,
    Photo,
    describe,
    zone_names,
)
from .calibration_tests import Compared

AXES = ("X", "Y", "Z")
ANGLES = ("omega", "phi", "kappa")

Row = dict[str, Any]


def tables(done: Done) -> dict[str, list[Row]]:
    """The rows of the tables by the names of their files; of those that have any."""
    found: dict[str, list[Row]] = {
        "cameras.csv": [
            _camera(done, one) | _zone_test(done, one) for one in done.photos
        ],
        "stations.csv": [_station(one) for one in done.photos],
        "zones.csv": [row for one in done.cameras for row in _zones(one)],
        "residuals.csv": [row for one in done.photos for row in _residuals(done, one)],
        "variants.csv": [
            row for name in done.variants for row in _variants(done, name)
        ],
        "corrections.csv": [
            row for name, one in done.maps.items() for row in _corrections(name, one)
        ],
        "points.csv": _points(done),
        "difference.csv": [row for one in done.differences for row in _map(one)],
        "difference_tests.csv": [_difference(one) for one in done.differences],
        "distances.csv": [] if done.distances is None else _distances(done.distances),
    }
    return {name: rows for name, rows in found.items() if rows}


def contents(done: Done) -> dict[str, str]:
    """The files by name."""
    texts = {name: files.rows_text(rows) for name, rows in tables(done).items()}
    return texts | {"summary.json": files.json_text(summary(done))}


def summary(done: Done) -> Row:
    """What summary.json says."""
    return {
        "program": f"jaxro {__version__}",
        "file": done.title,
        "unit": done.unit,
        "together": done.together,
        "usable": done.usable,
        "images": [
            _camera(done, one) | _zone_test(done, one) | _station(one)
            for one in done.photos
        ],
    }


def _pairs(names, values: np.ndarray, deviations: np.ndarray, usable: bool) -> Row:
    """Columns of values, each with its standard deviation beside it; empty where the
    numbers must not be used."""
    row: Row = {}
    for name, value, deviation in zip(names, values, deviations, strict=True):
        row[name] = float(value) if usable else None
        row[f"s_{name}"] = float(deviation) if usable else None
    return row


def _camera(done: Done, one: Photo) -> Row:
    figures, usable = one.figures, one.usable
    number = lambda value: value if usable else None
    return {
        "image": one.name,
        "camera": one.camera,
        "result": one.result,
        "model": describe(one.found.model),
        "points": len(one.names),
        "degrees_of_freedom": int(figures.degrees_of_freedom),
        "sigma0": number(float(figures.sigma0)),
        "y_down": bool(figures.y_down),
        **_pairs(("x0", "y0"), figures.principal, figures.principal_deviations, usable),
        "mean_focal": number(float(np.mean(figures.focal))),
        **_pairs(BROWN, figures.brown, figures.brown_deviations, usable),
        "field_parameters": number(float(figures.in_field)),
        "expected_error": None if done.together else number(one.expected_error),
    }


def _zone_test(done: Done, one: Photo) -> Row:
    """Whether the zones of an image differ."""
    tested = done.zones.get(one.name)
    if tested is None or not np.isfinite(tested.probability):
        return dict.fromkeys(("zones_F", "zones_above", "zones_below", "zones_p"))
    return {
        "zones_F": tested.f,
        "zones_above": tested.above,
        "zones_below": tested.below,
        "zones_p": tested.probability,
    }


def _difference(one: Compared) -> Row:
    """The test of two distortions, and what was taken out of their difference."""
    found = one.found
    value = lambda read: None if found is None else read(found)
    turns = {
        f"turn_{axis}_deg": value(lambda d, k=k: float(np.degrees(d.turn[k])))
        for k, axis in enumerate("xyz")
    }
    shifts = {
        f"shift_{axis}": value(lambda d, k=k: float(d.shift[k]))
        for k, axis in enumerate("xy")
    }
    return {
        "first": one.first,
        "second": one.second,
        "model": describe(one.model),
        "refocused": one.refocused,
        "F": value(lambda d: d.f),
        "above": value(lambda d: d.above),
        "below": value(lambda d: d.below),
        "p": value(lambda d: d.probability),
        **turns,
        **shifts,
        "scale": value(lambda d: d.scale) if one.refocused else None,
    }


def _map(one: Compared) -> list[Row]:
    """The difference of two distortions on the nodes."""
    found = one.found
    if found is None:
        return []
    return [
        {
            "first": one.first,
            "second": one.second,
            "x": float(found.places[k, 0]),
            "y": float(found.places[k, 1]),
            "dx": float(found.difference[k, 0]),
            "dy": float(found.difference[k, 1]),
            "s_dx": float(found.deviations[k, 0]),
            "s_dy": float(found.deviations[k, 1]),
            "wx": float(found.in_deviations[k, 0]),
            "wy": float(found.in_deviations[k, 1]),
            "inside": bool(one.inside[k]),
        }
        for k in range(len(found.places))
    ]


def _station(one: Photo) -> Row:
    figures, usable = one.figures, one.usable
    angles = np.degrees(figures.angles), np.degrees(figures.angle_deviations)
    return {
        "image": one.name,
        "result": one.result,
        **_pairs(AXES, figures.centre, figures.centre_deviations, usable),
        **_pairs([f"{name}_deg" for name in ANGLES], *angles, usable),
    }


def _zones(one: Photo) -> list[Row]:
    figures = one.figures
    columns = zip(
        zone_names(one.found.model),
        figures.focal.tolist(),
        figures.focal_deviations.tolist(),
        figures.in_zones.tolist(),
        strict=True,
    )
    return [
        {
            "camera": one.camera,
            "axis": axis,
            "zone": zone,
            "focal": focal,
            "s_focal": deviation,
            "points": points,
        }
        for (axis, zone), focal, deviation, points in columns
    ]


def _residuals(done: Done, one: Photo) -> list[Row]:
    if not one.usable:
        return []
    w = done.w(one)
    return [
        {
            "image": one.name,
            "point": name,
            "x": float(one.places[k, 0]),
            "y": float(one.places[k, 1]),
            "vx": float(one.residuals[k, 0]),
            "vy": float(one.residuals[k, 1]),
            "redundancy_x": float(one.redundancy[k, 0]),
            "redundancy_y": float(one.redundancy[k, 1]),
            "wx" if done.sigma_known else "tau_x": float(w[k, 0]),
            "wy" if done.sigma_known else "tau_y": float(w[k, 1]),
            "ahead": bool(one.ahead[k]),
        }
        for k, name in enumerate(one.names)
    ]


def _variants(done: Done, name: str) -> list[Row]:
    return [
        {
            "image": name,
            "model": describe(variant.model),
            "unknowns": variant.unknowns,
            "sigma0": variant.sigma0,
            "left_out": variant.left_out,
            "score_behind_best": variant.behind,
        }
        for variant in done.variants[name]
    ]


def _corrections(camera: str, one: CorrectionMap) -> list[Row]:
    return [
        {
            "camera": camera,
            "x": float(one.places[k, 0]),
            "y": float(one.places[k, 1]),
            "dx": float(one.corrections[k, 0]),
            "dy": float(one.corrections[k, 1]),
            "s_dx": float(one.deviations[k, 0]),
            "s_dy": float(one.deviations[k, 1]),
            "s_x": float(one.total[k, 0]),
            "s_y": float(one.total[k, 1]),
            "inside": bool(one.inside[k]),
        }
        for k in range(len(one.places))
    ]


def _points(done: Done) -> list[Row]:
    points = done.points
    if points is None or not done.usable:
        return []
    return [
        {
            "point": name,
            **_pairs(AXES, points.coordinates[k], points.deviations[k], True),
            "images": int(points.rays[k]),
            "known": bool(points.known[k]),
        }
        for k, name in enumerate(points.names)
    ]


def _distances(found: Distances) -> list[Row]:
    names = [*AXES, *(f"f{k + 1}" for k in range(len(found.focal)))]
    values = np.concatenate([found.centre, found.focal])
    deviations = np.concatenate([found.centre_deviations, found.focal_deviations])
    return [
        {"parameter": name, "value": float(value), "sd": float(deviation)}
        for name, value, deviation in zip(names, values, deviations, strict=True)
    ]
