"""Statistics of any solution: the rows of a net against plain NumPy."""

import jax
import numpy as np
import pytest

from jaxro.adjustment import Term, adjust
from jaxro.statistics import familywise, identification
from jaxro.statistics.rows import normalise_rows, rows

FROM = np.array([1, 1, 1, 2, 0, 4, 4, 5, 5, 3, 2])
TO = np.array([0, 0, 2, 3, 3, 2, 5, 0, 1, 5, 6])
VARIANCE = np.array([72, 40, 44, 20, 61, 26, 59, 30, 35, 50, 25.0])
POINTS = 7


def net(rise):
    """Legs of a net of levelling; nothing checks the last one."""
    return Term(
        lambda begin, end, rise: end - begin - rise,
        rise,
        VARIANCE,
        touches=[("height", FROM), ("height", TO)],
    )


@pytest.fixture(scope="module")
def rise():
    return np.random.default_rng(1).normal(size=len(FROM)) * np.sqrt(VARIANCE)


@pytest.fixture(scope="module")
def known(rise):
    """The normalised residuals where the height of point 0 is held, and where nothing
    is known."""
    start, held = {"height": np.zeros(POINTS)}, {"height": np.arange(POINTS) == 0}
    term = net(rise)
    found = adjust(term, start, held=held)
    return (
        normalise_rows(rows(term, found.parameters, held=held)),
        normalise_rows(rows(term, found.parameters)),
    )


def dense():
    """Whitened design, its projection on residuals, and redundancy numbers."""
    a = np.zeros((len(FROM), POINTS))
    a[np.arange(len(FROM)), TO] += 1
    a[np.arange(len(FROM)), FROM] -= 1
    a = a[:, 1:] / np.sqrt(VARIANCE)[:, None]
    left = np.eye(len(FROM)) - a @ np.linalg.inv(a.T @ a) @ a.T
    return left, np.diag(left)


def test_w_and_correlations_are_those_of_dense_matrices(rise, known):
    left, redundancy = dense()
    r = left @ (-rise / np.sqrt(VARIANCE))
    tested = redundancy > 1e-6
    root = np.sqrt(redundancy[tested])
    for one in known:
        assert one.parameters == POINTS - 1 and one.freedom == len(FROM) - POINTS + 1
        np.testing.assert_array_equal(one.tested, tested)
        assert not one.tested[-1]
        np.testing.assert_allclose(one.w[tested], r[tested] / root, atol=1e-9)
        np.testing.assert_allclose(
            np.asarray(one.matrix())[np.ix_(tested, tested)],
            left[np.ix_(tested, tested)] / root / root[:, None],
            atol=1e-9,
        )


@pytest.mark.parametrize("level", [0.01, 0.05])
def test_the_largest_w_exceeds_its_limit_as_often_as_asked(known, level):
    """Of 50,000 errorless nets."""
    left, redundancy = dense()
    tested = redundancy > 1e-6
    errors = np.random.default_rng(2).normal(size=(50_000, len(FROM)))
    w = np.abs(errors @ left)[:, tested] / np.sqrt(redundancy[tested])
    share = np.mean(np.max(w, axis=1) > float(familywise.largest_w(level, known[0])))
    assert abs(share - level) < 4 * np.sqrt(level / 50_000) + 0.02 * level


def test_an_identifiable_error_is_attributed_to_its_leg(known):
    """As often as the wanted power says; legs that nothing tells apart never."""
    found = identification.identify(
        known[0], jax.random.key(0), level=0.05, familywise=True
    )
    chances = identification.chances(
        known[0],
        jax.random.key(1),
        np.where(np.isfinite(found.identified), found.identified, 0.0),
        level=0.05,
        familywise=True,
    )
    able = np.isfinite(np.asarray(found.identified))
    np.testing.assert_allclose(np.asarray(chances.correct)[able], 0.8, atol=0.02)
    alone = np.abs(np.asarray(found.correlation)) > 1 - 1e-6
    np.testing.assert_array_equal(able, known[0].tested & ~alone)
    assert 1 < np.sum(able) < len(FROM) - 1
