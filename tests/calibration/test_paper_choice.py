"""The paper's two stages: the covariances that they look at, and their rules."""

import numpy as np
import pytest
import simulated_image
from scipy import stats
from simulated_image import LENS, ONE, STRIPS, TURNED, TWO, N

from jaxro import calibration
from jaxro.calibration.paper_choice import Units, choose_as_paper, paper_models

MODELS = (ONE, TWO, STRIPS, TURNED)


def image(mask=None):
    """Of a film that is stretched along x."""
    _, points, places = simulated_image.measured(5, distort=lambda m: m * [1.003, 1.0])
    return simulated_image.image(points, places, mask=mask)


@pytest.mark.slow
def test_the_rules_of_the_paper():
    """With each model's own calibration, in mrad, mm and mm."""
    measured = image()
    found = choose_as_paper(measured, MODELS, units=Units(1e3, 1e3, 1.0), mu=0.5)
    traces, conditions, of_correlations, sizes, freedom = [], [], [], [], []
    for model in MODELS:
        one = calibration.calibrate(measured, model).check()
        units = np.concatenate([[1e3] * 3, [1e3 * one.frame.length] * 3])
        units = np.concatenate([units, [one.frame.size] * (2 + model.focals)])
        chosen = [0, 1, 3, 4, 5, *range(8, 8 + model.focals)]
        k = (one.covariance * np.outer(units, units))[np.ix_(chosen, chosen)]
        deviations = np.sqrt(np.diag(k))
        traces.append(np.trace(k))
        conditions.append(np.linalg.cond(k))
        of_correlations.append(np.linalg.cond(k / np.outer(deviations, deviations)))
        sizes.append(len(k))
        freedom.append(int(one.degrees_of_freedom))
    np.testing.assert_allclose(found.traces, traces, rtol=1e-5)
    np.testing.assert_allclose(found.conditions, conditions, rtol=1e-4)
    np.testing.assert_allclose(found.correlation_conditions, of_correlations, rtol=1e-4)

    best = np.argmin(traces)
    kept = traces / traces[best] <= stats.f.isf(0.03, freedom, freedom[best])
    np.testing.assert_array_equal(found.kept, kept)
    assert 0 < kept.sum() < len(MODELS)

    def least(values):
        return np.argmin(np.where(kept, values, np.inf))

    def equation_2(conditions, traces):
        conditions, traces = np.array(conditions), np.array(traces)
        return conditions / min(conditions[kept]) + 0.5 * traces / min(traces[kept])

    assert found.picks == (
        least(conditions),
        least(equation_2(conditions, traces)),
        least(of_correlations),
        least(equation_2(of_correlations, sizes)),
    )
    assert found.by_score == 1  # the film is stretched along x


@pytest.mark.slow
@pytest.mark.parametrize(
    "models", [MODELS, pytest.param(paper_models(), marks=pytest.mark.slow)]
)
def test_the_units_matter(models):
    measured = image()
    raw, mixed = (
        choose_as_paper(measured, models, units=units)
        for units in (Units(), Units(1e3, 1e3))
    )
    assert raw.depends_on_units and mixed.depends_on_units
    assert raw.picks[:2] != mixed.picks[:2]


@pytest.mark.slow
def test_the_models_of_the_paper_are_the_default():
    assert choose_as_paper(image()).models == paper_models()
    assert len(paper_models()) == 26


def test_what_the_paper_does_not_choose_from():
    with pytest.raises(ValueError, match="focal lengths alone"):
        choose_as_paper(image(), [LENS])
    with pytest.raises(RuntimeError, match="no model can be adjusted"):
        choose_as_paper(image(np.arange(N) < 4), MODELS)
