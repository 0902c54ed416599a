"""What every orientation must obey, whatever the numbers: symmetries, transformations
of JAX, solvers, isolation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import oracles
import problems
import pytest
from tiers import seldom

import jaxro
from jaxro import (
    DependentElements,
    IndependentElements,
    RelativePose,
    convert,
    orient_batch,
    pad,
    pair,
    stack,
)
from jaxro.geometry import coplanarity, rotations
from jaxro.geometry.pairs import swapped
from jaxro.orientation import starts
from jaxro.orientation.results import is_usable

BASE = 70.0
every_system = pytest.mark.parametrize(
    "system", problems.SYSTEMS, ids=lambda s: s.__name__
)
every_kind = pytest.mark.parametrize(
    ("system", "residual"),
    [
        *((system, coplanarity.rigorous) for system in problems.SYSTEMS),
        pytest.param(IndependentElements, coplanarity.parallax, marks=pytest.mark.slow),
    ],
    ids=lambda kind: kind.__name__,
)
heavy_kind = pytest.mark.parametrize(
    ("system", "residual"),
    [
        (RelativePose, coplanarity.rigorous),
        *(
            pytest.param(*kind, marks=pytest.mark.slow)
            for kind in (
                (IndependentElements, coplanarity.parallax),
                (IndependentElements, coplanarity.rigorous),
                (DependentElements, coplanarity.rigorous),
            )
        ),
    ],
    ids=lambda kind: kind.__name__,
)
"""The same, most of them left out where each compiles programs of its own."""


every_case = pytest.mark.parametrize(
    "case", problems.CASES.values(), ids=problems.CASES
)


def oriented(measured, system=RelativePose, base=BASE, **keywords):
    """Compiled once per kind; the general start has its laws in test_any_position."""
    keywords = {"start": starts.Vertical()} | keywords
    return problems.orient(
        measured, elements=system, base=jnp.asarray(base), **keywords
    )


def solved(case, system=RelativePose, *, measured=None, scale=1.0, **keywords):
    """A case from its true pose, which is an argument: one program for all cases."""
    measured = case.measure() if measured is None else measured
    base = scale * base_of(case, system)
    return oriented(measured, system, base=base, start=case.pose, **keywords)


def base_of(case, system):
    """The length that is given of the base; bx of dependent elements has its sign."""
    return BASE * (np.sign(case.base[0]) if system is DependentElements else 1.0)


def numbers(elements):
    """All fields of the elements as one array (for RelativePose quaternion and
    base)."""
    return np.array([np.asarray(leaf) for leaf in jax.tree.leaves(elements)])


def same_elements(first, second, atol):
    """Every element the same; quaternions up to their common sign."""
    one, two = numbers(first), numbers(second)
    if isinstance(first, RelativePose):
        one[:4] *= np.sign(one[:4] @ two[:4])
    np.testing.assert_allclose(one, two, atol=atol)


def close(first, second, atol):
    """Every number of two orientations within atol of its size; results equal."""
    for path, a in jax.tree.leaves_with_path(first):
        b = dict(jax.tree.leaves_with_path(second))[path]
        a, b = np.asarray(a), np.asarray(b)
        name = jax.tree_util.keystr(path)
        if name == ".iterations":
            continue
        np.testing.assert_allclose(
            a,
            b,
            rtol=atol,
            atol=atol * max(1.0, np.max(np.abs(b), initial=0.0)),
            err_msg=name,
        )


corrections = jax.jit(jaxro.Orientation.corrections)


def v(orientation, measured):
    """The corrections as one array (coordinate, point)."""
    return np.stack(corrections(orientation, measured))


@every_case
@every_kind
def test_photo_swap(case, system, residual):
    """Left and right exchanged: R' = Rᵀ, b' = -Rᵀ b, the corrections change places, the
    accuracy stays."""
    measured, other = case.measure(), case.swap()
    one = solved(case, residual=residual)
    two = solved(other, system, measured=swapped(measured), residual=residual)
    two.check()
    if residual is coplanarity.rigorous:
        inverse = problems.pose_of(*inverted(one.pose))
        back = base_of(other, system)
        expected = convert(inverse, system, jnp.asarray(back))
        same_elements(two.elements, expected, 1e-9)
        np.testing.assert_allclose(two.sigma0, one.sigma0, rtol=1e-9)
        np.testing.assert_allclose(two.redundancy, one.redundancy, atol=1e-9)
        np.testing.assert_allclose(
            v(two, swapped(measured)), v(one, measured)[[2, 3, 0, 1]], atol=1e-9
        )
    else:
        # the frame parallel to the base is level with the left photo, so the parallaxes
        # are others by its cross tilt
        turn, shift = problems.difference(two.pose, *inverted(one.pose))
        limit = 1e-4 if case.rotation[2, 2] > 0.9 else 1e-3
        assert turn < limit and shift < limit


def inverted(pose):
    r, b = problems.rotation_base(pose)
    return r.T, -r.T @ b


@every_case
@every_system
def test_scale(case, system):
    """Coordinates and focal lengths in another unit: angles stay, lengths follow,
    redundancy numbers stay."""
    measured = case.measure()
    larger = pair(
        *(3.0 * c for c in measured.coordinates), focal=3.0 * measured.focal_left
    )
    one = solved(case, system)
    two = solved(case, system, measured=larger, scale=3.0)
    lengths = np.array([3.0 if not angle else 1.0 for angle in system.angles])
    values = [np.array(o.elements.values()) for o in (one, two)]
    np.testing.assert_allclose(values[1], values[0] * lengths, atol=1e-9)
    np.testing.assert_allclose(two.deviations, one.deviations * lengths, rtol=1e-8)
    np.testing.assert_allclose(two.sigma0, 3 * one.sigma0, rtol=1e-9)
    np.testing.assert_allclose(two.redundancy, one.redundancy, atol=1e-9)
    np.testing.assert_allclose(v(two, larger), 3 * v(one, measured), atol=1e-9)


def bundle_turned(measured, turn):
    """The pair with the bundle of rays of its left photo turned, as if the camera had
    been held otherwise."""
    p = (
        oracles.vectors(
            np.asarray(measured.x_left),
            np.asarray(measured.y_left),
            float(measured.focal_left),
        )
        @ turn.T
    )
    f = float(measured.focal_left)
    x, y = -f * p[:, 0] / p[:, 2], -f * p[:, 1] / p[:, 2]
    return pair(x, y, measured.x_right, measured.y_right, focal=measured.focal_left)


@every_case
@every_kind
def test_model_rotation(case, system, residual):
    """Errorless: the left bundle turned by Q gives R' = Q R, b' = Q b."""
    turn = oracles.wolf(0.05, -0.1, 0.2)
    measured = case.measure(sigma=0.0)
    one = solved(case, system, measured=measured, residual=residual)
    other = case.turn_left(turn)
    seen = bundle_turned(measured, turn)
    found = solved(other, system, measured=seen, residual=residual)
    r, b = problems.rotation_base(one.pose)
    assert max(problems.difference(found.pose, turn @ r, turn @ b)) < 1e-9


@every_case
def test_turn_in_the_photo_plane(case):
    """With errors: turned about the photo axis the accuracy of a coordinate is the
    same, so everything is."""
    turn = oracles.r3(0.3)
    one = solved(case)
    seen = bundle_turned(case.measure(), turn)
    two = solved(case.turn_left(turn), measured=seen)
    r, b = problems.rotation_base(one.pose)
    assert max(problems.difference(two.pose, turn @ r, turn @ b)) < 1e-9
    np.testing.assert_allclose(two.sigma0, one.sigma0, rtol=1e-9)
    np.testing.assert_allclose(two.redundancy, one.redundancy, atol=1e-9)


@every_case
@every_kind
def test_point_order(case, system, residual):
    measured = case.measure()
    order = np.random.default_rng(0).permutation(16)
    shuffled = pair(
        *(c[order] for c in measured.coordinates), focal=measured.focal_left
    )
    one, two = (
        solved(case, system, measured=p, residual=residual)
        for p in (measured, shuffled)
    )
    np.testing.assert_allclose(numbers(two.elements), numbers(one.elements), atol=1e-10)
    np.testing.assert_allclose(two.cofactor, one.cofactor, rtol=1e-7, atol=1e-14)
    for name in ("parallax", "residuals", "redundancy"):
        np.testing.assert_allclose(
            getattr(two, name), getattr(one, name)[order], atol=1e-9, err_msg=name
        )
    for a, b in zip(
        (*v(one, measured), *one.model), (*v(two, shuffled), *two.model), strict=True
    ):
        np.testing.assert_allclose(b, a[order], atol=1e-6)


@every_case
@heavy_kind
def test_padding(case, system, residual):
    measured = case.measure()
    one, two = (
        solved(case, system, measured=p, residual=residual)
        for p in (measured, pad(measured, 23))
    )
    np.testing.assert_allclose(numbers(two.elements), numbers(one.elements), atol=1e-11)
    np.testing.assert_allclose(two.sigma0, one.sigma0, rtol=1e-9)
    assert int(two.degrees_of_freedom) == 11 and bool(two.result == one.result)
    for per_point in (
        two.parallax,
        two.residuals,
        two.redundancy,
        two.in_front,
        *v(two, pad(measured, 23)),
        *two.model,
    ):
        assert per_point.shape == (23,) and not np.any(np.asarray(per_point)[16:])


def test_masked_points_may_hold_anything():
    measured = problems.tilted()
    some = measured.with_mask(jnp.arange(16) < 14)
    rubbish = eqx.tree_at(
        lambda p: (p.x_left, p.y_right),
        some,
        replace_fn=lambda c: c.at[14:].set(jnp.nan),
    )
    close(oriented(rubbish), oriented(some), 0.0)


@heavy_kind
def test_jit_is_eager(system, residual):
    of_case = problems.jit(
        lambda measured, pose, base: jaxro.orient(
            measured, elements=system, base=base, residual=residual, start=pose
        )
    )
    for case in problems.CASES.values():
        inside = of_case(case.measure(), case.pose, base_of(case, system))
        close(solved(case, system, residual=residual), inside, 1e-9)


def one_of(tree, i):
    """Number i of what stands one after the other in every leaf."""
    return jax.tree.map(lambda leaf: leaf[i], tree)


@heavy_kind
def test_vmap_is_a_loop(system, residual):
    cases = list(problems.CASES.values())
    of_one = lambda p, pose, base: problems.orient(
        p, elements=system, base=base, residual=residual, start=pose
    )
    poses = jax.tree.map(lambda *a: jnp.stack(a), *(case.pose for case in cases))
    bases = jnp.array([base_of(case, system) for case in cases])
    measured = stack([case.measure() for case in cases])
    together = problems.jit(jax.vmap(of_one))(measured, poses, bases)
    for i, case in enumerate(cases):
        alone = solved(case, system, residual=residual)
        close(one_of(together, i), alone, 1e-9)


@heavy_kind
def test_a_batch_is_a_loop(system, residual):
    """Of near-vertical photos, from the vertical."""
    pairs = [problems.tilted(seed=seed) for seed in range(4)]
    kind = {"elements": system, "residual": residual, "start": starts.Vertical()}
    batch = orient_batch(stack(pairs), base=BASE, **kind)
    for i, measured in enumerate(pairs):
        alone = oriented(measured, system, residual=residual)
        close(one_of(batch, i), alone, 1e-9)


@pytest.mark.slow
@heavy_kind
def test_three_derivatives_agree(system, residual):
    """d elements / d measured coordinates: forward, reverse and finite differences, at
    residuals far from zero."""
    measured = problems.tilted(sigma=0.1)

    def values(coordinates):
        found = oriented(pair(*coordinates, focal=70.0), system, residual=residual)
        return jnp.stack(jax.tree.leaves(found.elements))

    x = jnp.stack(measured.coordinates)
    forward, reverse = problems.jit(
        lambda x: (jax.jacfwd(values)(x), jax.jacrev(values)(x))
    )(x)
    np.testing.assert_allclose(
        forward, reverse, rtol=1e-9, atol=1e-12 * np.max(np.abs(forward))
    )

    for seed in range(3):
        direction = jnp.asarray(np.random.default_rng(seed).normal(size=x.shape))
        step = 2e-3
        slope = [
            (values(x + h * direction) - values(x - h * direction)) / (2 * h)
            for h in (step, 2 * step)
        ]
        numeric = (4 * slope[0] - slope[1]) / 3
        exact = jnp.tensordot(forward, direction, 2)
        np.testing.assert_allclose(
            exact, numeric, rtol=1e-6, atol=1e-6 * np.max(np.abs(exact))
        )


@pytest.mark.parametrize(
    "system",
    seldom([IndependentElements, DependentElements], [IndependentElements]),
    ids=lambda s: s.__name__,
)
def test_accuracy_agrees_with_the_oracle(system):
    """The cofactors are those of the constrained adjustment in the elements themselves,
    to the second order in v."""
    placed = (
        oracles.independent
        if system is IndependentElements
        else oracles.dependent(BASE)
    )
    for seed in range(8):
        measured = problems.tilted(seed=seed)
        found = oriented(measured, system)
        judge = oracles.gauss_helmert(
            problems.arrays(measured), 70.0, placed, np.array(found.elements.values())
        )
        unit = np.where(system.angles, 1.0, BASE)
        np.testing.assert_allclose(
            np.array(found.elements.values()) / unit,
            judge.elements / unit,
            rtol=0,
            atol=1e-7,
        )
        size = np.sqrt(np.outer(np.diag(judge.cofactor), np.diag(judge.cofactor)))
        np.testing.assert_allclose(
            found.cofactor / size, judge.cofactor / size, rtol=0, atol=1e-5
        )
        np.testing.assert_allclose(found.sigma0, judge.sigma0, rtol=1e-5)
        np.testing.assert_allclose(
            found.redundancy, judge.redundancy, rtol=0, atol=1e-5
        )


SOLVERS = {
    "Gauss-Newton": optx.GaussNewton(rtol=1e-12, atol=1e-12),
    "Levenberg-Marquardt": optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12),
    "dogleg": optx.Dogleg(rtol=1e-12, atol=1e-12),
}


@pytest.mark.parametrize(
    ("solver", "system"),
    [
        pytest.param(
            solver,
            system,
            marks=[] if i == j == 0 else pytest.mark.slow,
            id=f"{name}-{system.__name__}",
        )
        for i, (name, solver) in enumerate(SOLVERS.items())
        for j, system in enumerate(problems.SYSTEMS)
    ],
)
def test_solvers_of_optimistix_agree(solver, system):
    """To 1e-9, angles in rad and the base in units of bx."""
    measured = problems.tilted()
    one, two = (
        oriented(measured, system, base=1.0, **k)
        for k in ({}, {"solver": solver, "max_steps": 200})
    )
    two.check()
    np.testing.assert_allclose(
        numbers(two.elements), numbers(one.elements), rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(two.sigma0, one.sigma0, rtol=1e-9)


def spoiled(measured):
    """Pairs that cannot be oriented, each padded like the good one."""
    nothing = jnp.zeros_like(measured.x_left)
    row = jnp.linspace(-60.0, 60.0, measured.x_left.shape[-1])
    few = jnp.arange(measured.x_left.shape[-1]) < 4
    f = measured.focal_left
    return [
        eqx.tree_at(lambda p: p.x_left, measured, measured.x_left.at[3].set(jnp.nan)),
        eqx.tree_at(lambda p: p.focal_right, measured, jnp.asarray(jnp.inf)),
        pair(nothing, nothing, nothing, nothing, focal=f),
        pair(row, 0.5 * row, row - 70.0, 0.5 * row, focal=f),
        pair(
            measured.x_left, measured.y_left, measured.x_left, measured.y_left, focal=f
        ),
        measured.with_mask(few),
        pair(
            *(
                1e6 * c[::-1] if i == 1 else c
                for i, c in enumerate(measured.coordinates)
            ),
            focal=f,
        ),
    ]


@pytest.mark.parametrize(
    ("system", "start"),
    [
        (DependentElements, starts.Vertical()),
        *(
            pytest.param(system, starts.Auto(), marks=pytest.mark.slow)
            for system in (RelativePose, DependentElements, IndependentElements)
        ),
    ],
    ids=lambda kind: getattr(kind, "__name__", type(kind).__name__),
)
def test_failures_leave_their_neighbours_alone(system, start):
    """Bit for bit: in a batch, good pairs come out the same whatever the others are."""
    good = [problems.tilted(seed=seed) for seed in range(14)]
    mixed = list(good)
    mixed[::2] = spoiled(good[0])
    clean, spoilt = (
        orient_batch(stack(b), elements=system, base=BASE, start=start)
        for b in (good, mixed)
    )
    assert not np.any(is_usable(spoilt.result)[::2])
    for a, b in zip(jax.tree.leaves(clean), jax.tree.leaves(spoilt), strict=True):
        np.testing.assert_array_equal(np.asarray(a)[1::2], np.asarray(b)[1::2])


@pytest.mark.slow
def test_failures_leave_their_neighbours_gradients_alone():
    good = [problems.tilted(seed=seed) for seed in range(14)]
    mixed = list(good)
    mixed[::2] = spoiled(good[0])

    @problems.jit
    def gradient(batch):
        def total(coordinates):
            measured = eqx.tree_at(
                lambda p: (p.x_left, p.y_left, p.x_right, p.y_right), batch, coordinates
            )
            found = eqx.filter_vmap(lambda p: oriented(p))(measured)
            return jnp.sum(
                jnp.where(
                    jnp.arange(14) % 2 == 1, found.elements.qx + found.elements.by, 0.0
                )
            )

        return jnp.stack(jax.grad(total)(batch.coordinates))

    clean, spoilt = gradient(stack(good)), gradient(stack(mixed))
    assert np.all(np.isfinite(spoilt[:, 1::2])) and np.any(clean[:, 1::2])
    np.testing.assert_array_equal(clean[:, 1::2], spoilt[:, 1::2])


@pytest.mark.slow
def test_cofactors_do_not_depend_on_which_way_the_base_was_found():
    """The right photo on the left: from the vertical the base is found the wrong way
    round, and turned."""
    measured = jaxro.swapped(problems.dewitt())
    near, general = (
        problems.orient(measured, start=start)
        for start in (jaxro.starts.Auto(), jaxro.starts.General())
    )
    assert near.pose.bx < -0.9
    np.testing.assert_allclose(near.cofactor, general.cofactor, rtol=1e-6, atol=1e-12)
    of = lambda pose: jnp.stack(
        jaxro.convert(pose, IndependentElements, jnp.asarray(BASE)).values()
    )
    propagate = jaxro.propagation.propagate_adjusted
    propagated = jax.jit(lambda found: propagate(of, found).deviations)(near)
    np.testing.assert_allclose(
        propagated,
        problems.orient(measured, elements=IndependentElements).deviations,
        rtol=1e-6,
    )


@pytest.mark.slow
def test_a_known_start_does_not_change_what_is_given():
    """Elements, their deviations and the model have one scale: that of the base given,
    or of the start."""
    zero = jnp.zeros(())
    start = DependentElements(*(zero,) * 5, jnp.asarray(50.0))
    free = problems.orient(problems.dewitt(), elements=DependentElements, base=91.9825)
    given = problems.orient(
        problems.dewitt(), elements=DependentElements, base=91.9825, start=start
    )
    alone = problems.orient(problems.dewitt(), elements=DependentElements, start=start)
    for found, scale in ((given, 1.0), (alone, 50 / 91.9825)):
        lengths = np.array([scale, scale, 1, 1, 1])
        np.testing.assert_allclose(found.elements.bx, 91.9825 * scale, rtol=1e-12)
        np.testing.assert_allclose(
            jnp.stack(found.elements.values()),
            lengths * jnp.stack(free.elements.values()),
            rtol=1e-8,
        )
        np.testing.assert_allclose(
            found.deviations, lengths * free.deviations, rtol=1e-6
        )
        np.testing.assert_allclose(found.model[2], scale * free.model[2], rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("system", [IndependentElements, DependentElements])
def test_a_pose_has_its_cofactors_whatever_elements_were_iterated(system):
    """They are those of its own local parameters, not of the start's."""
    measured = problems.tilted()
    plain = problems.orient(measured)
    start = jaxro.convert(plain.pose, system, jnp.asarray(60.0))
    found = problems.orient(measured, start=start)
    np.testing.assert_allclose(found.pose.base, plain.pose.base, atol=1e-9)
    np.testing.assert_allclose(found.cofactor, plain.cofactor, rtol=1e-6, atol=1e-14)


@pytest.mark.slow
def test_vertical_start_is_enough_for_vertical_photos():
    """Independent elements start from zero and end where the general start ends."""
    measured = problems.tilted()
    zero = IndependentElements(*(jnp.zeros(()),) * 5)
    one, two = (
        oriented(measured, IndependentElements),
        oriented(measured, IndependentElements, start=zero),
    )
    np.testing.assert_allclose(numbers(two.elements), numbers(one.elements), atol=1e-9)


def test_slopes_of_a_bilinear_function_are_those_of_any_function():
    key = jax.random.split(jax.random.key(8), 2)
    pose = jaxro.to_pose(IndependentElements(*(0.4 * jax.random.normal(key[0], (5,)))))
    x = tuple(0.3 * jax.random.normal(key[1], (5,)))
    focals = jnp.asarray(100.0), jnp.asarray(150.0)
    fundamental = lambda *pose: coplanarity.fundamental_matrix(*pose, *focals)
    for step in (x, ()):
        known = pose.slopes(fundamental, step, bilinear=True)
        found = pose.slopes(fundamental, step)
        for one, other in zip(*map(jax.tree.leaves, (known, found)), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-9)
    still = pose.slopes(fundamental, pose.origin)
    for one, other in zip(*map(jax.tree.leaves, (known, still)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-9)


@every_system
def test_slopes_are_derivatives_along_further_steps(system):
    """Of R and b without their scale, which an unnormalised pose leaves open."""
    key = jax.random.split(jax.random.key(5), 3)
    pose = jaxro.to_pose(IndependentElements(*(0.4 * jax.random.normal(key[0], (5,)))))
    centre = convert(pose, system, jnp.asarray(BASE))
    x = tuple(0.3 * jax.random.normal(key[1], (5,)))

    def directions(rotation, base):
        size = rotations.length(
            rotation[0][0], rotations.length(rotation[1][0], rotation[2][0])
        )
        return jnp.stack(
            [entry / size for row in rotation for entry in row]
            + list(rotations.unit(base))
        )

    def after(*step):
        return directions(*centre.move(centre.further(x, step)).relative())

    value, slopes = centre.slopes(directions, x)
    np.testing.assert_allclose(value, after(*jnp.zeros(5)), atol=1e-14)
    np.testing.assert_allclose(
        jnp.stack(slopes),
        jnp.stack(jax.jacfwd(after, argnums=tuple(range(5)))(*jnp.zeros(5))),
        atol=1e-13,
    )
