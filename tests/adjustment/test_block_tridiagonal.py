"""Factor, solution and selected inverse of sparse matrices, against dense ones."""

import numpy as np
import pytest

from jaxro.adjustment import block_tridiagonal as sparse


def strip(rng, count, reach, size):
    """Blocks in random order, each of which meets those up to `reach` away."""
    first, second = np.array(
        [(i, j) for i in range(count) for j in range(max(0, i - reach), i + 1)]
    ).T
    names = rng.permutation(count)
    return names[first], names[second]


def grid(rng, rows, columns):
    """A block of photos, each of which meets its eight neighbours."""
    at = np.array([(r, c) for r in range(rows) for c in range(columns)])
    apart = np.max(np.abs(at[:, None] - at[None]), axis=2)
    first, second = np.nonzero(np.tril(apart <= 1))
    names = rng.permutation(rows * columns)
    return names[first], names[second]


def dense(first, second, blocks, count, size):
    """The matrix of the blocks."""
    n = np.zeros((count, size, count, size))
    n[first, :, second, :] = blocks
    n[second, :, first, :] = np.swapaxes(blocks, 1, 2)
    return n.reshape(count * size, -1)


@pytest.mark.parametrize("shape", ["strip", "grid", "apart"])
def test_solution_and_selected_inverse_are_those_of_a_dense_matrix(shape):
    """Also where two parts of the blocks do not meet at all."""
    rng, size = np.random.default_rng(3), 6
    if shape == "grid":
        count = 63
        first, second = grid(rng, 7, 9)
    else:
        count = 80
        first, second = strip(rng, count, 2, size)
    if shape == "apart":
        near = (first < 30) == (second < 30)
        first, second = first[near], second[near]
    blocks = rng.normal(0, 0.1, (len(first), size, size))
    own = first == second
    random = rng.normal(size=(own.sum(), size, 2 * size))
    blocks[own] = random @ np.swapaxes(random, 1, 2)
    # rows of different units
    unit = 10.0 ** rng.uniform(-3, 3, (count, size))
    blocks *= unit[first][:, :, None] * unit[second][:, None, :]
    n = dense(first, second, blocks, count, size)

    levels = sparse.arrange(first, second, count, size)
    assert levels.begin[-1] == count and len(levels.begin) > 3
    factor = sparse.factorise(*sparse.assemble(levels, first, second, blocks))
    by_place = (levels.order[:, None] * size + np.arange(size)).ravel()
    right = rng.normal(size=(len(n), 2)) * unit.reshape(-1, 1)
    solved = np.empty_like(right)
    solved[by_place] = sparse.solve(factor, right[by_place])
    expected = np.linalg.inv(n * (1 / np.outer(unit, unit))) / np.outer(unit, unit)
    scale = unit.reshape(-1, 1)
    np.testing.assert_allclose(scale * solved, scale * (expected @ right), atol=1e-10)

    selected = sparse.select_inverse(factor)
    found = sparse.read_blocks(levels, selected, first, second, size)
    both = expected.reshape(count, size, count, size)
    of_slots = unit[first][:, :, None] * unit[second][:, None, :]
    np.testing.assert_allclose(
        of_slots * found, of_slots * both[first, :, second, :], atol=1e-10
    )


def test_a_singular_matrix_is_refused():
    blocks = np.ones((1, 2, 2))
    zero = np.zeros(1, int)
    levels = sparse.arrange(zero, zero, 1, 2)
    whole = sparse.assemble(levels, zero, zero, blocks - np.eye(2)[None])
    with pytest.raises(sparse.Singular):
        sparse.factorise(*whole)
