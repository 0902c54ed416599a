"""Procedures that find wrong points, one file each.

Each is an object with its tolerances as fields: `procedure(pair) -> Rejection`, under jit and vmap as well. PROCEDURES
is the one list of them.
"""

from .base import OUTCOMES as OUTCOMES, AbstractProcedure as AbstractProcedure, Log as Log, Rejection as Rejection
from .dorozhinsky import Dorozhinsky as Dorozhinsky
from .leave_one_out_grubbs import LeaveOneOutGrubbs as LeaveOneOutGrubbs, calibrated as calibrated
from .mean_parallax import MeanParallax as MeanParallax
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
}
"""Every procedure by its name on the command line, with the tolerances of its source."""
