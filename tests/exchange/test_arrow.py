"""Arrow tables: what pandas, polars and duckdb read, beside the CSV files of --out."""

import csv
import io
from dataclasses import replace

import jax
import numpy as np
import pytest

import jaxro
from jaxro import block
from jaxro.batches.ragged import Ragged
from jaxro.block.adjust_chained import start_from
from jaxro.exchange import to_arrow
from jaxro.reports import block_files, files
from jaxro.reports.block_model import Done
from jaxro.reports.columns import TABLES, Units
from jaxro.tables import csv as tables
from jaxro.tables.examples import pair as example
from jaxro.tables.measured import to_ragged

pytest.importorskip("pyarrow", reason="Arrow tables need pyarrow")


@pytest.fixture(scope="module")
def results():
    """The example pair twice, the second time with too few points."""
    from jaxro.commands.solve import Task, make_results, solve

    table = tables.parse(example.TABLE, "a.csv", "a")
    camera = jaxro.Camera(example.FOCAL)
    few = table.choose(np.arange(4))
    both = replace(
        table,
        names=np.array(["a", "b"], object),
        begins=np.concatenate([table.begins, [table.begins[-1] + 4]]),
        points=np.concatenate([table.points, few.points]),
        numbers={
            n: np.concatenate([a, few.numbers[n]]) for n, a in table.numbers.items()
        },
    )
    cameras = camera, camera
    pairs = to_ragged(both, cameras, 1.0)
    task = Task(system=jaxro.DependentElements, tables=TABLES, sigma_known=False)
    units = Units(photo="mm", model="base_units", sigma0="mm")
    from jaxro.batches.padding import plan_for

    found = solve(pairs, task, plan_for(both.lengths))
    return make_results(both, cameras, found, task, units)


def of_csv(text):
    """Columns of a CSV file as texts."""
    header, *rows = csv.reader(io.StringIO(text))
    return dict(zip(header, zip(*rows, strict=True), strict=True))


def same(table, text):
    """Every value is the one of the CSV file, null or infinite where a cell is
    empty."""
    expected = of_csv(text)
    assert table.column_names == list(expected)
    for name, cells in expected.items():
        for own, cell in zip(table.column(name).to_pylist(), cells, strict=True):
            if cell == "":
                assert own in (None, "", float("inf"))
            elif isinstance(own, bool):
                assert str(own).lower() == cell
            elif isinstance(own, str):
                assert own == cell
            else:
                assert float(own) == float(cell)


@pytest.mark.parametrize("name", TABLES)
def test_tables_are_the_csv_files(results, name):
    table = to_arrow(results, name)
    same(table, files.table_text(*results.written(name), results.units))
    units = {
        f.name: (f.metadata or {}).get(b"unit", b"").decode() for f in table.schema
    }
    for column, unit in units.items():
        assert not unit or column.endswith(f"_{unit}")
    expected = {
        "elements": ("omega_deg", "deg"),
        "residuals": ("q_mm", "mm"),
        "points": ("X_base_units", "base_units"),
        "reliability": ("w", ""),
    }[name]
    assert units[expected[0]] == expected[1]


def test_other_programs_read_them(results):
    """The same numbers in pandas, polars and duckdb, by the PyCapsule interface."""
    table = to_arrow(results, "residuals")
    assert hasattr(table, "__arrow_c_stream__")
    own = table.column("q_mm").to_numpy(zero_copy_only=False)

    class Stream:
        """Nothing but the interface."""

        def __arrow_c_stream__(self, requested_schema=None):
            return table.__arrow_c_stream__(requested_schema)

    read = 0
    for program in ("pandas", "polars", "duckdb"):
        try:
            module = __import__(program)
        except ModuleNotFoundError:
            continue
        if program == "pandas":
            if not hasattr(module.DataFrame, "from_arrow"):
                continue
            values = module.DataFrame.from_arrow(Stream())["q_mm"].to_numpy()
        elif program == "polars":
            values = module.DataFrame(Stream())["q_mm"].to_numpy()
        else:
            pairs = table  # duckdb finds it by its name
            values = module.sql("SELECT q_mm FROM pairs").fetchnumpy()["q_mm"]
            values = np.ma.filled(values, np.nan)
            assert pairs.num_rows == len(values)
        np.testing.assert_array_equal(values, own)
        read += 1
    if not read:
        pytest.skip("needs pandas 3, polars or duckdb")


def test_orientations_of_a_batch(results):
    """An orientation has the elements of the file, but for what takes the pair as well;
    of a pair that is not usable there are none."""
    pairs = to_ragged(results.table, results.cameras, 1.0)
    assert isinstance(pairs, Ragged)
    found = jaxro.orient_ragged(pairs, elements=jaxro.DependentElements)
    units = Units(photo="mm", model="base_units", sigma0="mm")
    own = to_arrow(found, units=units).to_pydict()
    file = to_arrow(results, "elements").to_pydict()
    of_pair = ("pair", "points", "curvature", "causes")
    assert list(own) == [name for name in file if name not in of_pair]
    for name, values in own.items():
        for a, b in zip(values, file[name], strict=True):
            assert a == b or a == pytest.approx(b, rel=1e-6)
    assert own["omega_deg"][1] is None and own["result"][1] != "successful"
    single = jax.tree.map(lambda a: np.asarray(a)[0], found)
    assert to_arrow(single).num_rows == 1


def test_blocks_and_what_has_no_tables(results):
    mock = block.mock_block(1, block.Flight(models=3))
    start = start_from(mock.block, mock.photos)
    found = block.adjust_without_wrong(block.Given(mock.block, mock.ground), start)
    oriented = block.OrientedBlock(*found, {}, None, np.ones(1, bool))
    done = Done("block", "m", "mm", "given", ["1-2"], oriented, mock.ground)
    columns = block_files.tables(done)
    for name in columns:
        text = files.columns_text(block_files._python(columns[name]))
        same(to_arrow(done, name), text)
    assert to_arrow(done).column_names[0] == "photo"
    with pytest.raises(ValueError, match="there are photos, points"):
        to_arrow(done, "elements")
    with pytest.raises(ValueError, match="no table 'photos'; there are elements"):
        to_arrow(results, "photos")
    with pytest.raises(TypeError, match="list has no tables"):
        to_arrow([])
