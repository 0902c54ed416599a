"""Numbers printed by others: Dewitt's relative-orientation program, and the tables of
Dorozhinsky (1971)."""

import jax.numpy as jnp
import numpy as np
import oracles
import problems
import pytest

from jaxro import DependentElements, IndependentElements, pad
from jaxro.experiments import dorozhinsky1971_first_order as first_order
from jaxro.geometry import coplanarity, mock_pairs

# Dewitt's program on its own sample: photo residuals and object coordinates, Z counted
# from f below the left station
DEWITT_RESIDUALS = """
a  0.0000  0.0019 -0.0000 -0.0018
b -0.0000 -0.0018  0.0000  0.0018
c -0.0000 -0.0010  0.0000  0.0010
d  0.0000  0.0010 -0.0000 -0.0010
e -0.0000 -0.0009 -0.0000  0.0008
f -0.0000  0.0009  0.0000 -0.0008
"""
DEWITT_MODEL = """
a   -4.8433    1.9618    1.0824
b   89.0766    2.7002    0.3923
c    0.2590   83.5083    1.1473
d   89.2623   82.8493    1.8047
e   -4.6281  -86.0801    1.2995
f   89.3199  -85.9670   -1.2378
"""
HALF = 0.5e-4 + 1e-9
"""Half a unit of the fourth decimal."""


def columns(text):
    return np.array(
        [[float(v) for v in line.split()[1:]] for line in text.strip().splitlines()]
    ).T


@pytest.fixture(scope="module")
def dewitt():
    return problems.orient(problems.dewitt(), elements=DependentElements)


def test_dewitt_elements(dewitt):
    dewitt.check()
    e = dewitt.elements
    found = np.array([e.by, e.bz, *np.rad2deg([e.omega, e.phi, e.kappa])])
    np.testing.assert_allclose(
        found, [-1.7187, 148.3025 - 152.113, 2.4077, 0.5550, -0.2053], rtol=0, atol=HALF
    )
    np.testing.assert_allclose(e.bx, 91.9825, atol=1e-12)


def test_dewitt_accuracy(dewitt):
    sd = np.asarray(dewitt.deviations)
    np.testing.assert_allclose(
        [*sd[:2], *np.rad2deg(sd[2:])],
        [0.0209, 0.0075, 0.0065, 0.0069, 0.0032],
        atol=HALF,
    )
    np.testing.assert_allclose(dewitt.sigma0, 0.0045, atol=HALF)
    assert int(dewitt.degrees_of_freedom) == 1


def test_dewitt_residuals(dewitt):
    np.testing.assert_allclose(
        np.stack(dewitt.corrections(problems.dewitt())),
        columns(DEWITT_RESIDUALS),
        rtol=0,
        atol=HALF,
    )


def test_dewitt_model(dewitt):
    x, y, z = dewitt.model
    np.testing.assert_allclose(
        np.stack([x, y, z + 152.113]), columns(DEWITT_MODEL), rtol=0, atol=HALF
    )


def test_dewitt_agrees_with_the_rigorous_oracle(dewitt):
    """To the second order in v: the oracle linearises at the adjusted measurements, the
    engine at the measured ones."""
    judge = oracles.gauss_helmert(
        problems.DEWITT, 152.113, oracles.dependent(91.9825), np.zeros(5)
    )
    np.testing.assert_allclose(dewitt.elements.values(), judge.elements, rtol=1e-6)
    np.testing.assert_allclose(dewitt.deviations, judge.deviations, rtol=1e-3)
    np.testing.assert_allclose(dewitt.sigma0, judge.sigma0, rtol=1e-3)
    corrections = np.stack(dewitt.corrections(problems.dewitt()))
    np.testing.assert_allclose(corrections, judge.corrections, atol=1e-6)
    np.testing.assert_allclose(dewitt.redundancy, judge.redundancy, atol=1e-4)


# residual parallaxes in hundredths of mm, their mean and m_q, of the recovered table 1
TABLE_1 = {
    7: ("14 -20 96 10 -8 10 -101", 37, 101),
    8: ("-8 -4 100 109 2 2 -95 -107", 54, 119),
    9: ("-27 23 106 104 -115 -11 -89 -115 125", 80, 136),
    10: ("-7 8 102 108 -119 -97 -95 -112 120 93", 86, 134),
    16: ("47 31 80 64 -89 -109 -121 -159 147 78 47 31 64 80 -31 -160", 84, 113),
}


def by_parallax(pair, **keywords):
    """The strict solution of the papers: residual parallaxes of unit weight,
    independent elements, from zero. All pairs are padded to 16 points."""
    keywords = {"start": IndependentElements(*(jnp.zeros(()),) * 5)} | keywords
    return problems.orient(
        pad(pair, 16),
        elements=IndependentElements,
        residual=coplanarity.parallax,
        **keywords,
    )


@pytest.mark.parametrize("points", TABLE_1)
def test_table_1(points):
    printed, mean, m_q = TABLE_1[points]
    found = by_parallax(problems.table_1(points))
    parallax = np.asarray(found.parallax)[:points]
    np.testing.assert_allclose(
        100 * parallax, [float(v) for v in printed.split()], atol=1.0
    )
    np.testing.assert_allclose(100 * np.mean(np.abs(parallax)), mean, atol=1.0)
    np.testing.assert_allclose(100 * found.m_q, m_q, atol=1.0)
    judge, _ = oracles.gauss_newton(problems.arrays(problems.table_1(points)), 70.0, 15)
    np.testing.assert_allclose(parallax, judge[-1], atol=1e-9)


def test_table_1_without_errors():
    found = by_parallax(problems.table_1(6))
    assert np.max(np.abs(found.parallax)) < 1e-12 and found.m_q < 1e-12


# parallaxes in hundredths of mm before each iteration; alpha, chi, alpha', omega', chi'
# in minutes after it
TABLE_2 = (
    ("-127 -107 -216 -162 -102 -117 -326 -282", "29.1 16.1 45.9 -37.5 23.4"),
    ("-5 0 48 58 2 2 -58.5 -59", "29.9 15.4 48.2 -37.8 24.3"),
    ("-3 -1 54 59 1 0 -52 -58", "30.0 15.4 48.3 -37.8 24.3"),
)


def test_table_2_and_its_steps():
    """Every iteration by itself, from where the one before ended: print and oracle. All
    three at once end where they do."""
    pair, before = problems.table_2(), {}
    _, judge = oracles.gauss_newton(problems.arrays(pair), 70.64, 3)
    for (parallaxes, elements), step in zip(TABLE_2, judge, strict=True):
        found = by_parallax(pair, max_steps=0, **before).parallax[:8]
        printed = [float(v) for v in parallaxes.split()]
        np.testing.assert_allclose(100 * found, printed, rtol=0, atol=0.6)
        after = by_parallax(pair, max_steps=1, **before).elements
        found = after.phi1, after.kappa1, after.phi2, after.omega2, after.kappa2
        printed = [float(v) for v in elements.split()]
        np.testing.assert_allclose(np.rad2deg(found) * 60, printed, rtol=0, atol=0.2)
        np.testing.assert_allclose(after.values(), step, atol=1e-12)
        before = {"start": after}
    last = by_parallax(pair, max_steps=3).elements
    np.testing.assert_allclose(last.values(), judge[-1], atol=1e-12)


# exact least squares in 36ths of the error at point 7
EQUATION_9 = (3.13, -3.13, -1.57, -17.22, -1.57, 1.57, 18.78)
EQUATION_10 = (-3.27, 3.27, -17.18, -0.82, 1.64, -1.64, 18.82, -0.82)


@pytest.mark.parametrize(
    ("zones", "wrong", "exact"),
    [
        ((1, 2, 3, 4, 5, 6, 4), 6, EQUATION_9),
        ((1, 2, 3, 4, 5, 6, 3, 4), 6, EQUATION_10),
    ],
    ids=("equation 9", "equation 10"),
)
def test_first_order_distribution_of_one_error(zones, wrong, exact):
    """How one small error spreads over the residuals, f = b = y: strict solution,
    linear algebra and print agree."""
    design = oracles.first_order(zones)
    hat = np.eye(len(zones)) - design @ np.linalg.pinv(design)
    np.testing.assert_allclose(36 * hat[:, wrong], exact, atol=0.006)

    places = [mock_pairs.ZONES[zone] for zone in zones]
    layout = mock_pairs.Layout(
        tuple(x for x, _ in places), tuple(y for _, y in places), zones
    )
    small = 1e-5 * (np.arange(len(zones)) == wrong)
    found = by_parallax(mock_pairs.plant(mock_pairs.mock_pair(layout), y_right=-small))
    own = found.parallax[: len(zones)]
    np.testing.assert_allclose(36e5 * own, exact, atol=0.006)


PAPERS_RULE = {
    9: (0, -2, -6, -17, -6, 1, 19),
    10: (-3, 3, -16.5, -1.5, 1.5, -1.5, 19.5, -1.5),
}
"""36ths of the error at point 7: the paper's averages put into its equations (5) and
(7)."""


@pytest.mark.parametrize("equation", PAPERS_RULE)
def test_equations_9_and_10_by_the_papers_own_rule(equation):
    """What the rule gives differs from the print in its misprints alone: v2 and v5 of
    (9), the sign of v5 of (10)."""
    zones, printed = first_order.EQUATIONS[equation]
    q = np.eye(len(zones))[6]
    v = oracles.first_order(zones) @ first_order.average(zones, q) + q
    np.testing.assert_allclose(36 * v, PAPERS_RULE[equation], atol=1e-12)
    np.testing.assert_allclose(
        first_order.by_the_papers_rule(equation), PAPERS_RULE[equation], atol=1e-12
    )
    differing = np.flatnonzero(~np.isclose(36 * v, printed)) + 1
    assert list(differing) == {9: [2, 5], 10: [5]}[equation]


def test_the_printed_equation_9_belongs_to_no_elements():
    """Points 3 and 5 differ by alpha' alone, which the paper's (8) leaves at zero; the
    print has -6 and 6.

    With no restriction at all the printed vector is off the space of the five columns
    as well.
    """
    zones, printed = first_order.EQUATIONS[9]
    design = oracles.first_order(zones)
    change = np.array(printed) / 36 - np.eye(7)[6]
    left = change - design @ np.linalg.pinv(design) @ change
    assert np.max(np.abs(left)) > 0.05
    own = first_order.by_the_papers_rule(9) / 36 - np.eye(7)[6]
    np.testing.assert_allclose(
        own - design @ np.linalg.pinv(design) @ own, 0, atol=1e-12
    )
    np.testing.assert_allclose(design[4] - design[2], [0, 0, 0, -2, 0])


def test_equations_6_7_and_8_for_any_focal_length_base_and_y():
    """(8), (7') for the error at point 7, (6') for any parallaxes; (6) solves the six
    equations (5) but for omega'."""
    f, b, y = 152.0, 71.0, 83.0
    zones, _ = first_order.EQUATIONS[9]
    alpha, chi, omega, alpha_right, chi_right = first_order.average(
        zones, np.eye(7)[6], f, b, y
    )
    np.testing.assert_allclose(alpha, -f / (4 * b * y))
    np.testing.assert_allclose(omega, f / (6 * y * y))
    np.testing.assert_allclose([alpha_right, chi_right], [0, f / b * omega])
    np.testing.assert_allclose(chi, (f**2 / y**2 - 1 / 3) / (6 * b))
    q = np.array([0.3, -0.2, 0.5, 0.1, -0.4, 0.7, 0.2])
    _, chi, omega, *_ = first_order.average(zones, q, f, b, y)
    printed = (f / b + 2 * y * y / (3 * f * b)) * omega - (
        q[3] + 2 * q[1] + 2 * q[5] + q[6]
    ) / (6 * b)
    np.testing.assert_allclose(chi, printed)
    # equation (7): the residual of a seventh point without an error is that of point 4,
    # its neighbour
    a = first_order.coefficients(zones, f, b, y)
    np.testing.assert_array_equal(a[6], a[3])
    # six parallaxes that five elements cause are explained by (6) exactly
    true = np.array([0.01, -0.02, 0.03, 0.015, -0.005])
    six = zones[:6]
    a = first_order.coefficients(six, f, b, y)
    np.testing.assert_allclose(
        first_order.average(six, -a @ true, f, b, y), true, rtol=1e-12
    )


def test_three_m_q_rejects_nothing():
    """Nine residuals of 0.01 mm and one of 0.10 mm: m_q = 0.0467 (printed 0.045), 3 m_q
    = 0.14 (printed 0.13)."""
    q = np.array([0.01] * 9 + [0.10])
    np.testing.assert_allclose(oracles.m_q(q), 0.0467, atol=5e-5)
    np.testing.assert_allclose(3 * oracles.m_q(q), 0.14, atol=5e-4)
    assert not np.any(np.abs(q) > 3 * oracles.m_q(q))


def test_m_q_is_equation_2():
    found = by_parallax(problems.table_1(10))
    np.testing.assert_allclose(
        found.m_q, oracles.m_q(np.asarray(found.parallax)[:10]), rtol=1e-12
    )
