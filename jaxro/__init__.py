"""jaxro: differentiable least-squares adjustment and relative orientation of stereo
pairs, on JAX.

Importing it switches JAX to 64 bit, unless JAX_ENABLE_X64 is set in the environment.
"""

import os as _os

import jax as _jax

if "JAX_ENABLE_X64" not in _os.environ:
    _jax.config.update("jax_enable_x64", True)

from . import (
    adjustment as adjustment,
    assessment as assessment,
    block as block,
    calibration as calibration,
    exchange as exchange,
    orientation as orientation,
    plots as plots,
    rejection as rejection,
    statistics as statistics,
    surveys as surveys,
)
from .adjustment import (
    Adjustment as Adjustment,
    GaussNewton as GaussNewton,
    adjust as adjust,
    critical_values as critical_values,
    losses as losses,
    propagation as propagation,
)
from .assessment import (
    budget as budget,
    identification as identification,
    layout_design as layout_design,
    likelihood as likelihood,
    reliability as reliability,
    sensitivity as sensitivity,
    variance_components as variance_components,
)
from .assessment.reliability import Reliability as Reliability, assess as assess
from .batches import (
    table_neighbours as table_neighbours,
    table_noise as table_noise,
)
from .batches.after_cleaning import (
    AfterCleaning as AfterCleaning,
    after_cleaning as after_cleaning,
)
from .batches.batch import (
    clean_batch as clean_batch,
    map_batch as map_batch,
    orient_batch as orient_batch,
)
from .batches.closures import Closures as Closures, close_triplets as close_triplets
from .batches.ragged import (
    Ragged as Ragged,
    clean_ragged as clean_ragged,
    join as join,
    orient_ragged as orient_ragged,
)
from .geometry import (
    coplanarity as coplanarity,
    mock_pairs as mock_pairs,
    rotations as rotations,
)
from .geometry.elements import (
    AbstractElements as AbstractElements,
    DependentElements as DependentElements,
    IndependentElements as IndependentElements,
    RelativePose as RelativePose,
    convert as convert,
    essential_matrix as essential_matrix,
    to_pose as to_pose,
    vertical as vertical,
)
from .geometry.pairs import (
    Camera as Camera,
    Pair as Pair,
    pad as pad,
    pair as pair,
    stack as stack,
    swapped as swapped,
    unstack as unstack,
)
from .orientation import planes as planes, starts as starts
from .orientation.orient import orient as orient
from .orientation.pure_rotation import (
    PureRotation as PureRotation,
    orient_rotation as orient_rotation,
)
from .orientation.result import Orientation as Orientation
from .orientation.results import RESULTS as RESULTS, is_usable as is_usable
from .statistics.promise import Promise as Promise, promise as promise
from .xla.notices import announce as announce
from .xla.settings import compiler_options as compiler_options
from .xla.store import keep_programs as keep_programs

__version__ = "0.1.0"
