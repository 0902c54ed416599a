"""A net of sixteen legs of levelling (Gemael), from many studies of procedures for wrong
measurements; variances in mm². The height of the point 0 is known."""

import numpy as np

from jaxro.statistics.rows import Rows

LEGS = """\
1 0 72
1 0 40
1 2 44
2 3 20
0 3 61
4 2 26
4 5 59
5 3 60
6 4 83
6 7 26
5 7 74
6 8 248
8 9 111
7 9 67
8 10 108
10 9 147
"""


def rows_of_net():
    """The whitened design of the net, without residuals."""
    legs = [[float(v) for v in line.split()] for line in LEGS.splitlines()]
    design = np.zeros((len(legs), 11))
    for k, (a, b, variance) in enumerate(legs):
        design[k, int(a)] -= 1 / np.sqrt(variance)
        design[k, int(b)] += 1 / np.sqrt(variance)
    design[:, 0] = 0
    n = len(legs)
    return Rows(np.zeros(n), design, np.ones(n, bool), np.zeros(n, int), np.arange(n))


def as_tables():
    """The net for `jaxro adjust`, with differences of zero, and its known point."""
    legs = [line.split() for line in LEGS.splitlines()]
    lines = "".join(
        f"{a},{b},0,{np.sqrt(float(variance)) / 1000}\n" for a, b, variance in legs
    )
    return "from,to,difference,sigma\n" + lines, "point,Z\n0,0\n"
