"""Procedures that find wrong points, one file each.

Each is an object with its tolerances as fields: `procedure(pair) -> Rejection`, under
jit and vmap as well. PROCEDURES is the one list of them.
"""

from ..adjustment import losses
from .all_subsets import AllSubsets as AllSubsets
from .base import (
    OUTCOMES as OUTCOMES,
    AbstractProcedure as AbstractProcedure,
    Log as Log,
    Rejection as Rejection,
)
from .data_snooping import DataSnooping as DataSnooping
from .dorozhinsky import Dorozhinsky as Dorozhinsky
from .graduated_non_convexity import GraduatedNonConvexity as GraduatedNonConvexity
from .least_median import LeastMedian as LeastMedian
from .leave_one_out_grubbs import (
    LeaveOneOutGrubbs as LeaveOneOutGrubbs,
    calibrated as calibrated,
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
