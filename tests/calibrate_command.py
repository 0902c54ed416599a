"""Calls of `jaxro calibrate`, the tables it reads, and those that it writes."""

import re

import numpy as np
from bad_tables import write
from oracles_calibration import rotation

SIGMA = 0.006
"""Standard deviation of a coordinate of the simulated photos, mm."""


def told(text, name):
    """Value and standard deviation of a number in a report."""
    found = re.search(rf"\b{name} +(\S+) +(\S+)", text)
    assert found, f"{name} is not in the report"
    return float(found[1]), float(found[2])


def numbers(table, *columns):
    return np.array([[float(row[c]) for c in columns] for row in table])


def table(header, *columns):
    """CSV text of columns of names and of numbers."""
    lines = [header]
    for row in zip(*columns, strict=True):
        lines.append(",".join(c if isinstance(c, str) else f"{c:.5f}" for c in row))
    return "\n".join(lines) + "\n"


def taken(rng, points, station, angles, film=0.0, y=-1.0, noise=SIGMA):
    """Places in mm of a photo with f = 60 mm, its principal place at (100, 50), y
    downwards; `film`: its largest displacement."""
    seen = (points - station) @ rotation(*angles).T
    ideal = -60 * seen[:, :2] / seen[:, 2:]
    u = ideal / 30
    apart = [np.sin(u[:, 0] + 0.3) * np.cos(u[:, 1]), -np.sin(u[:, 1] - 0.4)]
    places = ideal + film * np.stack(apart, axis=1)
    return places * [1.0, y] + [100.0, 50.0] + rng.normal(0, noise, places.shape)


def names_of(letter, points):
    return [f"{letter}{k + 1}" for k in range(len(points))]


def one_image(tmp_path, places, points, header="point,x,y", *more):
    """The tables of one image."""
    names = names_of("c", points)
    return (
        write(tmp_path, table(header, names, *places.T, *more), "image.csv"),
        write(tmp_path, table("point,X,Y,Z", names, *points.T), "points.csv"),
    )
