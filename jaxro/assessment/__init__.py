"""Assessment of an oriented pair: how much its results can be trusted.

Everything is computed from the conditions linearised at the solution
(`geometry.linear.linearise`); tests that are those of any adjustment stand in
`statistics`.

    reliability            tests of single points, detectable errors and their effects
      internal_            redundancy numbers, w, sizes of detectable errors
      external_            effects of errors on elements, heights and m_q
    correlations           which points the tests can tell apart
      undecided            points that could change places with rejected ones
      identification       errors that are attributed to the right point
    neighbours             test of correlation between the errors of neighbouring points
      correlated           accuracy of the elements under such correlation
    likelihood             regions and intervals where deviations do not say it all
    variance_components    standard deviations of groups, from many pairs
    sensitivity            derivatives of results by the measurements, influence of points
      budget               variance of a result by sources of error
    layout_design          positions of points that minimise a criterion
      layout_criteria      the criteria
"""

from .correlated import (
    Correlated as Correlated,
    allow_for_neighbours as allow_for_neighbours,
    correlated_covariance as correlated_covariance,
)
from .neighbours import Pattern as Pattern, pattern as pattern, pool as pool
