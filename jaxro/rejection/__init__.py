"""Procedures that find wrong points, one file each.

Each is an object with its tolerances as fields: `procedure(pair) -> Rejection`, under
jit and vmap as well. PROCEDURES is the one list of them: the command line, the tests
and the README's table read it. A new procedure is a new file with a subclass of
`AbstractProcedure`, and a line in PROCEDURES.

What procedures share, from the bottom up:

* base, rounds: the result, and the log of the rounds that lead to it
* masked, subsets: sums over the points in use, random subsets of them
* parallaxes: the adjustment of the papers of 1971 and 1989
* steps, agreement, visibility: Gauss-Newton steps of a pose, and the points that agree
  with it
* verdict: the result of a procedure that finds the pose first
* hypotheses: orientations of random subsets, for `Ransac` and `LeastMedian`
* search, five_points, neighbours: the search for photos in any position
* evidence, noise, fading: whether points agree by chance, the noise of their residuals,
  and their weights where this is not normal
* stages, quick, thorough: the stages of `Recommended`
* homographies, carried, unchecked, rivals: what is asked of the pose that it believes
"""

from ..adjustment import losses
from .all_subsets import AllSubsets as AllSubsets
from .base import (
    OUTCOMES as OUTCOMES,
    AbstractProcedure as AbstractProcedure,
    Log as Log,
    Rejection as Rejection,
    Rivals as Rivals,
)
from .data_snooping import DataSnooping as DataSnooping
from .dorozhinsky import Dorozhinsky as Dorozhinsky
from .graduated_non_convexity import GraduatedNonConvexity as GraduatedNonConvexity
from .least_median import LeastMedian as LeastMedian
from .leave_one_out_grubbs import (
    LeaveOneOutGrubbs as LeaveOneOutGrubbs,
    calibrate as calibrate,
)
from .mean_parallax import MeanParallax as MeanParallax
from .noise import Noise as Noise, noise_of as noise_of, pooled as pooled
from .ransac import Ransac as Ransac
from .recommended import Recommended as Recommended
from .reweighting import Reweighting as Reweighting
from .three_sigma import ThreeSigma as ThreeSigma
from .two_stage import TwoStage as TwoStage
from .worst_point import WorstPoint as WorstPoint

PROCEDURES: dict[str, AbstractProcedure] = {
    "mean-parallax": MeanParallax(),
    "three-sigma": ThreeSigma(),
    "worst-point": WorstPoint(),
    "dorozhinsky": Dorozhinsky(),
    "grubbs": LeaveOneOutGrubbs(),
    "two-stage": TwoStage(),
    "data-snooping": DataSnooping(),
    "tau": DataSnooping(estimated=True),
    "huber": Reweighting(losses.Huber()),
    "cauchy": Reweighting(losses.Cauchy()),
    "tukey": Reweighting(losses.Tukey()),
    "danish": Reweighting(losses.Danish()),
    "igg3": Reweighting(losses.IggThree()),
    "least-absolute": Reweighting(losses.LeastAbsolute()),
    "least-median": LeastMedian(),
    "ransac": Ransac(),
    "graduated": GraduatedNonConvexity(),
    "all-subsets": AllSubsets(),
    "recommended": Recommended(),
}
"""Every procedure by its name on the command line, with the tolerances of its
source."""
