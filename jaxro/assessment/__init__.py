"""What can be said of a pair after its orientation."""

from .correlated import Correlated as Correlated, correlated_covariance as correlated_covariance
from .neighbours import Pattern as Pattern, pattern as pattern, pooled as pooled
