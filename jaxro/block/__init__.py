"""One model, strips and blocks of oriented pairs on the ground."""

from ..camera.inner import Inner as Inner
from .absolute import orient_model as orient_model, solutions as solutions
from .absolute_model import (
    MeasuredModel as MeasuredModel,
    model as model,
    model_of_pair as model_of_pair,
)
from .absolute_result import AbsoluteOrientation as AbsoluteOrientation
from .adjust import BlockAdjustment as BlockAdjustment, adjust_block as adjust_block
from .bars import Bars as Bars, bars as bars
from .chain import Unjoined as Unjoined, chain as chain, models_of as models_of
from .classical import (
    ClassicalAdjustment as ClassicalAdjustment,
    adjust_models as adjust_models,
    deviations_of as deviations_of,
)
from .classical_comparison import (
    along_strips as along_strips,
    compare_estimators as compare_estimators,
)
from .classical_models import (
    ModelCoordinates as ModelCoordinates,
    measure_models as measure_models,
)
from .conditions import (
    ConditionAdjustment as ConditionAdjustment,
    adjust_conditions as adjust_conditions,
)
from .covariance import (
    difference as difference,
    joint_covariance as joint_covariance,
    relative_covariance as relative_covariance,
)
from .datum_of_points import refer_to_points as refer_to_points
from .given import Given as Given, Wrong as Wrong
from .measured_block import (
    Ground as Ground,
    MeasuredBlock as MeasuredBlock,
    from_pairs as from_pairs,
    ground as ground,
)
from .mock_block import Flight as Flight, mock_block as mock_block, pairs_of as pairs_of
from .orient_block import OrientedBlock as OrientedBlock, orient_block as orient_block
from .place import TooLittleControl as TooLittleControl, place as place
from .plan import (
    plan_block as plan_block,
    plan_rays as plan_rays,
    where_control_helps as where_control_helps,
)
from .reliability import assess_block as assess_block
from .sensitivity import differentiate as differentiate
from .wrong import adjust_without_wrong as adjust_without_wrong
