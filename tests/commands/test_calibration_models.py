"""How models and zones are named on the command line of `jaxro calibrate`."""

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
from jaxro.commands.calibration_models import MODELS, parse_zones, select_models
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
