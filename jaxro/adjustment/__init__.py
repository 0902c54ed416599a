"""Least squares of any conditions between parameters and measurements. It knows no
photo."""

from .joint import JointAdjustment as JointAdjustment
from .least_squares import Adjustment as Adjustment, adjust as adjust
from .levenberg_marquardt import LevenbergMarquardt as LevenbergMarquardt
from .normal_equations import GaussNewton as GaussNewton
from .parameters import AbstractParameters as AbstractParameters
from .results import RESULTS as RESULTS
from .terms import Term as Term
