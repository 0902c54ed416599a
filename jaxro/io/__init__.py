"""Reading measured pairs, reporting and writing orientations: the edges of the engine, plain NumPy and text."""

from .cameras import Cameras as Cameras, to_pair as to_pair
from .fields import TableError as TableError
from .solutions import Solution as Solution, Units as Units
from .tables import Measurements as Measurements, Table as Table
