"""Files in and out: what users read and write, without numerics."""

from .cameras import Cameras as Cameras, to_pair as to_pair
from .fields import TableError as TableError
from .measured import Measurements as Measurements, Table as Table
