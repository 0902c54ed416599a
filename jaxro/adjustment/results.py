"""Every way an adjustment can end.

A result is a value, never an exception: inside a batch one failure must not harm its
neighbours. Packages with conditions of their own extend it (`jaxro.RESULTS`: what else
can be wrong with a pair of photos).
"""

import optimistix as optx


class RESULTS(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """How an adjustment ended."""

    successful = ""
    rank_deficient = (
        "The measurements do not determine the parameters: a combination of these can "
        "change without changing any residual. Measure more, and elsewhere (not all on "
        "one line, not all in one zone)."
    )
    diverged = (
        "The iterations did not converge. Look for gross errors in what was measured "
        "and in what was given (constants, the directions of axes), or give a better "
        "start."
    )
