"""How models and zones are named on the command line of `jaxro calibrate`."""

import numpy as np
import pytest

from jaxro.calibration import (
    Brown,
    Model,
    Whole,
    default_models,
    models_of_cameras,
    rectangles,
    rings,
    stereographic,
    strips_along_x,
    strips_along_y,
)
from jaxro.commands.calibration_models import (
    MODELS,
    limit_choice,
    parse_zones,
    select_models,
)
from jaxro.tables import images
from jaxro.tables.fields import TableError


@pytest.mark.parametrize(
    ("text", "zones"),
    [
        ("whole", Whole()),
        ("rectangles:2x3", rectangles(2, 3)),
        ("rectangles:0,1,4x2:quadratic", rectangles([0, 1, 4], 2, 2)),
        ("strips-x:3:linear", strips_along_x(3, 1)),
        ("strips-y:0,1,3,4", strips_along_y([0, 1, 3, 4])),
        ("rings:2:cubic", rings(2, 3)),
    ],
)
def test_zones_by_their_text(text, zones):
    assert parse_zones("--zones", text) == zones


@pytest.mark.parametrize(
    "text", ["", "rings", "rings:0", "rings:2:flat", "rectangles:4", "whole:2", "x:2"]
)
def test_other_texts_are_no_zones(text):
    with pytest.raises(TableError, match="--zones: found"):
        parse_zones("--zones", text)


def options(model=None, zones=None, zones_y=None, fisheye=False, together=False):
    return select_models(model, zones, zones_y, fisheye=fisheye, together=together)


def test_every_name_stands_for_models():
    assert options() == default_models()
    assert options(together=True) == models_of_cameras()
    assert options("brown") == (Model(brown=Brown()),)
    for name in MODELS:
        assert options(name) and options(name, together=True)
    assert options(zones="rings:2") == (Model(x=rings(2)),)
    both = options("two-f", "rings:2", "strips-y:3")
    assert both == (Model(x=rings(2), y=strips_along_y(3)),)
    assert all(model.rays is stereographic for model in options(fisheye=True))


@pytest.mark.parametrize(
    ("number", "photos", "cameras", "unknown", "have_choice"),
    [
        (12, "a", "x", 0, False),
        (13, "a", "x", 0, True),
        (7, "ab", "xx", 0, False),
        (8, "ab", "xx", 0, True),
        (8, "ab", "xx", 1, False),
        (11, "ab", "xx", 4, True),
        (10, "ab", "xy", 0, False),
        (11, "ab", "xy", 0, True),
    ],
)
def test_ten_degrees_of_freedom_are_left_by_the_largest_model_of_a_choice(
    number, photos, cameras, unknown, have_choice
):
    """Brown's lens has ten unknowns, a station six, an unknown point three."""
    places, points = ["image,camera,point,x,y"], ["point,X,Y,Z"]
    for k in range(number):
        points.append(f"{k},{',,' if k < unknown else '1,2,3'}")
        for photo, camera in zip(photos, cameras, strict=True):
            places.append(f"{photo},{camera},{k},1,2")
    named = images.assemble(
        images.places("\n".join(places), "i", ""), images.points("\n".join(points), "p")
    )
    every = models_of_cameras()
    rows = np.arange(number * len(photos))
    expected = every if have_choice else every[:1]
    assert limit_choice(every, named, rows) == expected
