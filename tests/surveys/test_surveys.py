"""Mock surveys, whose geometry knows no formula of the package: heights come back
within their standard deviations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxro.surveys import grid_survey, mock_surveys

SD = grid_survey.Measured(10.0, 0.5, 0.17, 0.007, 0.0038, 0.004, 0.004, 0.004)
SCENE = mock_surveys.Scene()
DRAWS = 4000


@pytest.fixture(scope="module")
def mock():
    return mock_surveys.mock_survey(SCENE, SD)


@pytest.fixture(scope="module")
def solved(mock):
    return grid_survey.solve(mock.survey)


@pytest.fixture(scope="module")
def drawn(mock):
    """Errors of the heights, and misclosures, of many surveys of the same scene."""
    survey, variances = mock.survey, grid_survey.leg_variances(mock.survey)
    one = lambda key: grid_survey.heights(
        survey, mock_surveys.noisy(survey.measured, survey.deviations, key), variances
    )[0]
    found = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(4), DRAWS))
    return (
        np.asarray(found.value) - mock.truth,
        np.asarray(found.over_grid) - mock.truth,
        np.asarray(found.misclosure),
    )


@pytest.mark.parametrize("size", [(1, 1), (2, 1), (1, 3)])
def test_a_scene_without_traverses_is_told(size):
    with pytest.raises(ValueError, match="two of each"):
        mock_surveys.mock_survey(SCENE._replace(columns=size[0], rows=size[1]), SD)


def test_without_errors_heights_are_the_truth():
    """Vertical photos without distortion to the last digit; tilted and distorted ones
    to a tenth of what readings cost, if the grid is read at the point, and to a third
    where it is read at the nearest side."""
    off = {}
    for name, scene in {
        "vertical": SCENE._replace(tilts=((0.0, 0.0), (0.0, 0.0)), distortion=0.0),
        "tilted": SCENE,
        "nearest": SCENE._replace(nearest=True),
    }.items():
        mock = mock_surveys.mock_survey(scene, SD)
        found = grid_survey.heights(
            mock.survey, mock.survey.measured, grid_survey.leg_variances(mock.survey)
        )[0]
        off[name] = np.abs(
            np.stack([found.value, found.over_grid]) - mock.truth[None, :]
        )
    mean = {
        name: np.max(np.sqrt(np.mean(error**2, axis=1))) for name, error in off.items()
    }
    assert (
        mean["vertical"] < 1e-9
        and mean["tilted"] < 0.15
        and 0.3 < mean["nearest"] < 0.6
    )
    assert np.max(off["tilted"]) < 0.35 and 1.2 < np.max(off["nearest"]) < 1.4


@pytest.mark.slow
def test_heights_come_back_within_their_standard_deviations(mock, solved, drawn):
    known = np.asarray(mock.survey.known)
    for errors, deviations in zip(drawn, solved.deviations, strict=True):
        s = np.asarray(deviations)
        np.testing.assert_allclose(np.std(errors, axis=0)[s > 0], s[s > 0], rtol=0.05)
        free = s > 0
        np.testing.assert_allclose(
            np.sqrt(np.mean((errors[:, free] / s[free]) ** 2)), 1.0, atol=0.03
        )
    assert not np.any(drawn[0][:, known]) and not np.any(
        np.asarray(solved.deviations.value)[known]
    )
    total = sum(np.asarray(share) for share in solved.shares)
    np.testing.assert_allclose(total[~known], 1.0, rtol=1e-12)


def test_what_a_wrong_camera_height_does(mock):
    """30 mm: heights over the grid move by 30 h / H, those read from points of known
    height hardly."""
    survey, variances = mock.survey, grid_survey.leg_variances(mock.survey)
    wrong = survey.measured._replace(camera_height=survey.measured.camera_height + 30)
    right = grid_survey.heights(survey, survey.measured, variances)[0]
    moved = grid_survey.heights(survey, wrong, variances)[0]
    np.testing.assert_allclose(
        moved.over_grid - right.over_grid, mock.truth * 30 / 2100, atol=0.03
    )
    assert np.max(np.abs(moved.value - right.value)) < 0.6
    np.testing.assert_allclose(
        moved.misclosure, right.misclosure, atol=0.2
    )  # 30 / H of 13 mm, shared out


def test_tests_of_traverses_are_those_of_the_network_where_errors_are_the_legs_own(
    mock, solved
):
    one = mock.survey
    measured = mock_surveys.noisy(one.measured, one.deviations, jax.random.key(2))
    alone = jax.tree.map(jnp.zeros_like, one.deviations)._replace(
        back=one.deviations.back, fore=one.deviations.fore
    )
    noisy = lambda deviations: grid_survey.survey(
        measured,
        deviations,
        square=one.square,
        grid=one.grid,
        datum=np.asarray(one.datum),
        known=one.known,
        height=np.asarray(one.height),
        start=one.start,
        end=one.end,
    )
    found = grid_survey.solve(noisy(alone))
    np.testing.assert_allclose(found.w, found.adjusted.w, atol=1e-9)
    np.testing.assert_allclose(found.detectable, found.adjusted.detectable, rtol=1e-9)
    network = found.deviations.value[: len(one.levelled)]
    np.testing.assert_allclose(network, found.adjusted.deviations, atol=1e-9)
    every = grid_survey.solve(noisy(one.deviations))
    assert np.all(
        np.abs(every.w) <= np.abs(found.w) + 1e-12
    )  # errors in common can only add
    np.testing.assert_allclose(every.heights.value, found.heights.value, atol=1e-12)
