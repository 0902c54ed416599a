"""Angles of rotation matrices, also where one turn cannot be told from another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxro
from jaxro import DependentElements, IndependentElements, RelativePose
from jaxro.geometry import rotations


@pytest.mark.parametrize(
    ("compose", "decompose"),
    [
        (rotations.m_omega_phi_kappa, rotations.omega_phi_kappa),
        (
            lambda alpha, omega, chi: rotations.product(
                rotations.r_alpha(alpha),
                rotations.product(rotations.r_omega(omega), rotations.r_chi(chi)),
            ),
            rotations.alpha_omega_chi,
        ),
    ],
    ids=["omega phi kappa", "alpha omega chi"],
)
def test_angles_say_the_same_rotation_however_near_the_middle_one_is_to_a_right_angle(
    compose, decompose
):
    distance = np.array([0.0, 1e-16, 1e-14, 1e-12, 1e-10, 1e-8, 1e-4, 0.1, 1.0])
    angles = np.random.default_rng(3).uniform(-np.pi, np.pi, (3, 200, 9))
    angles[1] = np.where(angles[1] < 0, -1, 1) * (np.pi / 2 - distance)
    there = jax.vmap(lambda a: rotations.as_array(compose(*a)))(
        jnp.asarray(angles.reshape(3, -1)).T
    )
    again = jax.vmap(
        lambda m: rotations.as_array(compose(*decompose(rotations.as_matrix(m))))
    )(there)
    np.testing.assert_allclose(again, there, rtol=0, atol=2e-15)
    far = np.broadcast_to(distance > 0.05, (200, 9)).ravel()
    found = jax.vmap(lambda m: jnp.stack(decompose(rotations.as_matrix(m))))(there)[far]
    np.testing.assert_allclose(found, angles.reshape(3, -1).T[far], atol=1e-13)


@pytest.mark.parametrize("system", [DependentElements, IndependentElements])
def test_a_photo_turned_by_a_right_angle_keeps_its_pose(system):
    """phi (omega2) of 90 degrees: single angles are undefined, what they say together
    is not."""
    angles = (
        (0.3, np.pi / 2, 0.2) if system is DependentElements else (np.pi / 2, 0.2, 0.3)
    )
    before = system(
        *map(jnp.asarray, (0.1, -0.2, *angles)),
        *([jnp.asarray(70.0)] * (system is DependentElements)),
    )
    after = jaxro.convert(
        jaxro.convert(before, RelativePose, jnp.asarray(1.0)), system, jnp.asarray(70.0)
    )
    for one, other in zip(
        jaxro.to_pose(before).relative(), jaxro.to_pose(after).relative(), strict=True
    ):
        np.testing.assert_allclose(
            rotations.as_array(other), rotations.as_array(one), rtol=0, atol=1e-15
        )
