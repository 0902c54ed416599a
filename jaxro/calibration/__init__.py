"""Self-calibration of images by zones, by a displacement field or by Brown's
coefficients (Yurchenko 2002, and beyond)."""

from ..camera.brown import Brown as Brown
from ..camera.condition import (
    perspective as perspective,
    stereographic as stereographic,
)
from ..camera.field import Field as Field
from ..camera.pieces import Pieces as Pieces, pieces as pieces
from ..camera.zones import (
    AbstractZones as AbstractZones,
    Numbered as Numbered,
    Rectangles as Rectangles,
    Rings as Rings,
    Whole as Whole,
    rectangles as rectangles,
    rings as rings,
    strips_along_x as strips_along_x,
    strips_along_y as strips_along_y,
)
from .calibrate import calibrate as calibrate
from .choice import (
    Comparison as Comparison,
    choose as choose,
    compare as compare,
    default_models as default_models,
)
from .choice_together import (
    choose_together as choose_together,
    compare_together as compare_together,
    models_of_cameras as models_of_cameras,
)
from .components import (
    Components as Components,
    estimate_components as estimate_components,
)
from .correct import Corrected as Corrected, correct as correct
from .difference import Difference as Difference, difference as difference
from .images import MeasuredImage as MeasuredImage, image as image
from .known import Known as Known, known as known
from .measured_images import MeasuredImages as MeasuredImages, images as images
from .models import Model as Model
from .paper_choice import (
    PaperChoice as PaperChoice,
    Units as Units,
    choose_as_paper as choose_as_paper,
    paper_models as paper_models,
)
from .result import Calibration as Calibration
from .results import RESULTS as RESULTS, is_usable as is_usable
from .together import (
    Together as Together,
    calibrate_together as calibrate_together,
)
from .triangulate import Triangulated as Triangulated, triangulate as triangulate
from .zone_test import ZoneTest as ZoneTest, test_zones as test_zones
