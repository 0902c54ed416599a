"""jaxro: differentiable least-squares adjustment and relative orientation of stereo pairs, on JAX.

Importing it switches JAX to 64 bit, unless JAX_ENABLE_X64 is set in the environment.
"""

import os as _os

import jax as _jax

if "JAX_ENABLE_X64" not in _os.environ:
    _jax.config.update("jax_enable_x64", True)

from . import (
    assessment as assessment,
    budget as budget,
    coplanarity as coplanarity,
    correlations as correlations,
    critical_values as critical_values,
    familywise as familywise,
    height_accuracy as height_accuracy,
    height_planning as height_planning,
    heights as heights,
    layout_design as layout_design,
    levelling as levelling,
    mock_surveys as mock_surveys,
    planes as planes,
    propagation as propagation,
    rejection as rejection,
    reliability as reliability,
    rotations as rotations,
    sensitivity as sensitivity,
    simulation as simulation,
    starts as starts,
    surveys as surveys,
    table_noise as table_noise,
    variance_components as variance_components,
)
from .adjustment import Adjustment as Adjustment, GaussNewton as GaussNewton, adjust as adjust, losses as losses
from .assessment import identification as identification
from .assessment.after_cleaning import AfterCleaning as AfterCleaning, after_cleaning as after_cleaning
from .batch import clean_batch as clean_batch, map_batch as map_batch, orient_batch as orient_batch
from .elements import (
    AbstractElements as AbstractElements,
    DependentElements as DependentElements,
    IndependentElements as IndependentElements,
    RelativePose as RelativePose,
    convert as convert,
    essential_matrix as essential_matrix,
    to_pose as to_pose,
    vertical as vertical,
)
from .orientation import Orientation as Orientation, orient as orient
from .pairs import (
    Camera as Camera,
    Pair as Pair,
    pad as pad,
    pair as pair,
    stack as stack,
    swapped as swapped,
    unstack as unstack,
)
from .ragged import (
    Ragged as Ragged,
    clean_ragged as clean_ragged,
    join as join,
    orient_ragged as orient_ragged,
)
from .reliability import Reliability as Reliability, assess as assess
from .results import RESULTS as RESULTS, is_usable as is_usable

__version__ = "0.1.0"
