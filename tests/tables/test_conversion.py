"""CSV tables as Parquet tables: what is read of one, line by line, is in the other."""

import pytest

from jaxro.tables import csv as tables

pq = pytest.importorskip("pyarrow.parquet")
conversion = pytest.importorskip("jaxro.tables.conversion")

ODD_TEXTS = {
    "blank lines first": "\n  \n,,,,,\npair,point,x_left,y_left,x_right,y_right\n7,001,1,2,3,4\n",
    "short header below a blank line": "\nid,xl,yl,xr,yr\n001,1,2,3,4\n",
    "quoted behind a blank": 'pair, "point",x_left,y_left,x_right,y_right\n'
    'p0, "pt 1",1,2,3,4\np0,"b ""c""",1,2,3,4\n',
    "lines of commas": "point,x_left,y_left,x_right,y_right,sigma\n"
    "a,1,2,3,4,5\n,,,,,\n\nb,6,7,8,9,10\n",
    "other digits": "point,x_left,y_left,x_right,y_right\na,\u0661,2,3,4\n",
}


@pytest.mark.parametrize("text", ODD_TEXTS.values(), ids=ODD_TEXTS)
def test_an_odd_table_is_converted_to_what_is_read_of_it(text, tmp_path):
    source, target = tmp_path / "odd.csv", tmp_path / "odd.parquet"
    source.write_text(text)
    conversion.convert(source, target)
    found = pq.read_table(target)
    expected = [
        (m.name, point, *row)
        for m in tables.read(source).pairs
        for point, row in zip(m.points, m.rows, strict=True)
    ]
    pair = (
        found.column("pair").to_pylist()
        if "pair" in found.column_names
        else ["odd"] * len(found)
    )
    numbers = [
        found.column(name).to_pylist()
        for name in tables.NUMBERS
        if name in found.column_names
    ]
    assert (
        list(zip(pair, found.column("point").to_pylist(), *numbers, strict=True))
        == expected
    )
    assert {p.name for p in tmp_path.iterdir()} == {"odd.csv", "odd.parquet"}
