"""Ways to begin, one file each; every one needs nothing but the pair.

| start | points | what it does |
|---|---|---|
| `Vertical` | 5 | parallel axes, base along x: the normal case of aerial photos |
| `General` | 5 | any position: five-point and eight-point solutions |
| `Auto` | 5 | `Vertical` where two steps from it fit, `General` for the rest |
| `SixPoints` | 6 | closed form of near-vertical photos from their six standard zones (1971) |

Known elements are a start, too: pass them instead.
"""

from .auto import Auto as Auto
from .base import AbstractStart as AbstractStart, StartingPose as StartingPose
from .general import General as General
from .six_points import SixPoints as SixPoints
from .vertical import Vertical as Vertical
