"""What an oriented pair is worth: assessment beyond its residuals."""

from .correlated import (
    Correlated as Correlated,
    correlated_covariance as correlated_covariance,
)
from .neighbours import Pattern as Pattern, pattern as pattern, pooled as pooled
