"""Two tiers of tests: what is quick runs always, what is marked slow by `pytest -m slow`.

A capability has at least one quick test; its further combinations are slow.
"""

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def seldom(cases: Iterable[Any], often: Collection[Any]) -> list[Any]:
    """Cases as parameters, slow but for those with a name of `often`; the name of a case
    of several values is the first one."""

    def mark(case: Any) -> Any:
        values = case if isinstance(case, tuple) else (case,)
        marks = [] if values[0] in often else [pytest.mark.slow]
        return pytest.param(*values, marks=marks)

    return [mark(case) for case in cases]
