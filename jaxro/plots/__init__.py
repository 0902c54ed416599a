"""Pictures of results, each on axes of matplotlib (pip install 'jaxro[plots]').

Every function takes its data and `axes` to draw on, and returns these axes; without them
it makes a figure of its own, 160 mm wide. Those that draw several pictures, side by side
or one below the other, take and return several axes. `to_svg`, `to_png` and `to_pdf`
make files of what was drawn:

    axes = plots.draw_photos(pair, orientation)
    Path("residuals.png").write_bytes(plots.to_png(axes))

Matplotlib is imported when the first picture is drawn.
"""

from .block import (
    KnownPoints as KnownPoints,
    draw_accuracy as draw_accuracy,
    draw_block as draw_block,
    draw_block_residuals as draw_block_residuals,
    draw_differences as draw_differences,
)
from .calibration import (
    CorrectionMap as CorrectionMap,
    draw_calibration as draw_calibration,
    draw_corrections as draw_corrections,
    draw_uncertainty as draw_uncertainty,
    draw_variants as draw_variants,
    draw_vectors as draw_vectors,
    map_corrections as map_corrections,
)
from .convergence import (
    draw_convergence as draw_convergence,
    draw_sums as draw_sums,
    sums_by_step as sums_by_step,
)
from .distribution import draw_distribution as draw_distribution
from .export import (
    WRITERS as WRITERS,
    figure_of as figure_of,
    to_pdf as to_pdf,
    to_png as to_png,
    to_svg as to_svg,
)
from .influence import (
    draw_hidden as draw_hidden,
    draw_influence as draw_influence,
    draw_influences as draw_influences,
    draw_redundancy as draw_redundancy,
)
from .labels import place_labels as place_labels
from .layout import draw_layout as draw_layout
from .model import (
    draw_height_errors as draw_height_errors,
    draw_model as draw_model,
    draw_model_errors as draw_model_errors,
    draw_plan_errors as draw_plan_errors,
)
from .model_accuracy import model_covariances as model_covariances
from .points import (
    draw_bars as draw_bars,
    draw_leave_one_out as draw_leave_one_out,
    draw_round as draw_round,
    draw_tests as draw_tests,
)
from .power import Curve as Curve, draw_power as draw_power
from .residuals import (
    Zone as Zone,
    draw_both_photos as draw_both_photos,
    draw_photos as draw_photos,
    draw_residuals as draw_residuals,
    find_zones as find_zones,
)
from .style import RED as RED, TITLE as TITLE, new_figure as new_figure, plain as plain
from .surface import (
    draw_deviations as draw_deviations,
    draw_heights as draw_heights,
    draw_surface as draw_surface,
)
from .zones import draw_zones as draw_zones
