"""What the commands read of files of other programs."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("typer", reason="the command line needs typer and rich")
h5py = pytest.importorskip("h5py", reason="HDF5 files need h5py")

from jaxro.commands import other_programs  # noqa: E402
from jaxro.commands.request import Options  # noqa: E402
from jaxro.tables.fields import TableError  # noqa: E402


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "pairs.h5"
    with h5py.File(path, "w") as file:
        group = file.create_group("a")
        for k in (1, 2):
            group[f"x{k}"] = np.random.default_rng(k).uniform(100, 500, (9, 2))
            group[f"camera{k}"] = np.array([[800.0, 0, 320], [0, 780, 240], [0, 0, 1]])
    return path


def test_a_table_in_pixels_with_its_cameras(path):
    options = Options(file=path)
    assert other_programs.is_asked(options)
    assert not other_programs.is_asked(Options(file=Path("pairs.csv")))
    options, table, cameras = other_programs.read(options)
    assert options.unit == "px"
    assert not table.has_sigma and table.has_covariances and table.relative
    assert cameras.photos["a:1"].focal == 790
    _, table, _ = other_programs.read_for_block(options)
    assert not table.has_sigma and not table.has_covariances
    assert "the mean of" in table.warnings[-1]


@pytest.mark.parametrize(
    ("name", "given"),
    [("--focal", {"focal": 1.0}), ("--y-down", {"y_down": True})],
)
def test_options_that_the_file_answers_are_refused(name, given, path):
    with pytest.raises(TableError, match=f"{name}: found it beside"):
        other_programs.read(Options(file=path, **given))
