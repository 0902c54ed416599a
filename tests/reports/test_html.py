"""Reports as pages: one file, the figures of the terminal, and what a browser makes of
it."""

import html
import re

import examples
import numpy as np
import pytest
from command_line import run, words
from tiers import seldom

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from browser import browser, column, errors, open_page

from jaxro.reports.html.page import Page, Prose, Row, Section, Table
from jaxro.reports.html.render import to_html

LARGEST = 10_000_000
"""Bytes of a report of 10,000 pairs."""

HEADER = "pair,point,x_left,y_left,x_right,y_right\n"


ODD_NAME = "<b onclick=x>&[red]"
"""A point of the first pair of `many`."""


def simulated(pairs: int, points: int, seed: int = 1) -> str:
    """A table of near-vertical pairs, errors of .005 mm, a wrong point in every tenth."""
    random = np.random.default_rng(seed)
    size = (pairs, points)
    focal, base = 150.0, np.array([90.0, 3.0, -2.0])
    x, y = random.uniform(-45, 105, size), random.uniform(-80, 80, size)
    places = np.stack([x, y, -150 * random.uniform(0.9, 1.1, size)], axis=-1)
    turned = (places - base) @ np.array(
        [[1, 0.02, 0.01], [-0.02, 1, 0.03], [-0.01, -0.03, 1]]
    )
    both = [-focal * p[..., :2] / p[..., 2:] for p in (places, turned)]
    numbers = np.concatenate(both, axis=-1) + random.normal(0, 0.005, (*size, 4))
    numbers[::10, 0, 3] += 0.3
    return HEADER + "".join(
        f"{k + 1},{i + 1}," + ",".join(f"{v:.4f}" for v in numbers[k, i]) + "\n"
        for k in range(pairs)
        for i in range(points)
    )


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    """The report of 400 pairs."""
    folder = tmp_path_factory.mktemp("many")
    table = simulated(400, 12).replace("\n1,7,", f"\n1,{ODD_NAME},")
    (folder / "table.csv").write_text(table)
    result = run(
        *("orient", folder / "table.csv", "--focal", "150", "--sigma", "0.005"),
        *("--report", folder / "report.html"),
    )
    assert result.exit_code == 0
    return folder / "report.html", result.stdout


def shown(page: str) -> str:
    """The text of a page, without its script, style and pictures."""
    page = re.sub(r"<(script|style|svg)\b.*?</\1>", " ", page, flags=re.S)
    return words(html.unescape(re.sub(r"<[^>]+>", " ", page)))


@pytest.mark.parametrize("name", seldom(examples.ARGUMENTS, ["block"]))
def test_page_is_whole_and_says_what_the_terminal_says(example, name):
    assert example(name).exit_code == 0
    told, page = example(name).stdout, example(name).report.read_text(encoding="utf-8")
    assert not re.search(
        r"(src|href)=(?![\"']?(#|data:))", re.sub(r"xlink:href", "", page)
    )
    assert "url(http" not in page and "@import" not in page
    text = shown(page)
    # every number of the terminal's tables with decimals
    numbers = set(re.findall(r"(?<![\w.])-?\d+\.\d{2,}(?![\w.])", told))
    assert len(numbers) > 15
    missing = {n for n in numbers if n not in text}
    assert len(missing) <= 0.02 * len(numbers), missing
    for sentence in re.findall(r"Mind: (.*)", told):
        assert words(sentence)[:60] in text
    assert "How to repeat this" in text and "jaxro" in text


@pytest.mark.slow
def test_names_are_no_markup(many):
    page = many[0].read_text(encoding="utf-8")
    assert "<b onclick" not in page
    assert ODD_NAME in shown(page)


@pytest.mark.slow
def test_report_of_many_pairs_details_the_worst(many):
    page, told = many[0].read_text(encoding="utf-8"), many[1]
    assert page.count("id=pair-") == 100
    links = re.findall(r"<td><a href=\"#(pair-\d+)", page)
    assert len(links) == 100 and all(f"id={link}>" in page for link in links)
    assert (
        len(re.findall(r"<tr[^>]*><td>(?:<a [^>]*>)?\d+(?:</a>)?<td class=n>12", page))
        == 400
    )
    assert "contradict their sigma" in page
    assert "jaxro clean finds" in words(told)


@pytest.mark.slow
def test_report_of_10000_pairs_is_bounded(tmp_path):
    """Its size, and the rows that a browser has to lay out."""
    random = np.random.default_rng(0)
    rows = [
        Row(
            [
                f"{k // 100}-{k % 100}",
                "15",
                *(f"{v:.4f}" for v in numbers),
                "successful",
            ]
        )
        for k, numbers in enumerate(random.normal(size=(10_000, 8)))
    ]
    heads = ["pair", "points", *"abcdefgh", "result"]
    table = Table("All pairs", heads, [False, *[True] * 9, False], rows)
    page = Page("Many", "", Prose("Good."), (), [Section("Overview", [table])])
    file = tmp_path / "report.html"
    file.write_text(to_html(page), encoding="utf-8")
    assert file.stat().st_size < LARGEST / 4
    with browser() as driver:
        open_page(driver, file)
        assert len(column(driver, "section table", 0)) == 300
        driver.find_elements("css selector", "section th button")[2].click()
        first = column(driver, "section table", 2)
        assert len(first) == 300
        assert float(first[0]) == min(float(row.cells[2]) for row in rows)
        assert not errors(driver)


def test_browser_sorts_searches_and_follows_links(many):
    with browser() as driver:
        open_page(driver, many[0])
        table = "section table"
        place = driver.execute_script(
            "return Array.from(document.querySelector('section table').tHead.rows[0].cells)"
            ".findIndex(cell => cell.textContent.startsWith('sigma0'))"
        )
        first = column(driver, table, place)
        assert len(first) == 300
        head = driver.find_elements("css selector", f"{table} th button")[place]
        head.click()
        rising = np.array(column(driver, table, place), float)
        assert np.all(np.diff(rising) >= 0) and rising[0] < 0.1 * float(first[0])
        head.click()
        falling = np.array(column(driver, table, place), float)
        assert np.all(np.diff(falling) <= 0) and falling[0] == max(map(float, first))
        search = driver.find_element("css selector", "section input")
        search.send_keys("successful 399")
        found = column(driver, table, 0)
        assert "399" in found and len(found) < 5
        search.clear()
        search.send_keys("no such pair")
        assert not column(driver, table, 0)
        target = driver.execute_script(
            "const a = document.querySelector(\"section a[href^='#pair-']\");"
            "a.click(); return a.hash.slice(1)"
        )
        part = driver.find_element("id", target)
        assert part.get_attribute("open") is not None
        assert not errors(driver)


@pytest.mark.parametrize("name", seldom(["clean", "block", "calibrate"], ["block"]))
def test_pages_fit_a_phone(example, name):
    """Nothing but the tables, in their own frames, is wider than the window."""
    with browser(width=500) as driver:
        open_page(driver, example(name).report)
        wide, window = driver.execute_script(
            "return [document.documentElement.scrollWidth, innerWidth]"
        )
        assert wide <= window
        assert not errors(driver)


def test_refused_before_anything_is_calculated(tmp_path):
    refused = run("orient", "--report", tmp_path / "report.txt")
    assert refused.exit_code == 2 and ".html" in refused.stderr
    (tmp_path / "there.html").write_text("mine")
    refused = run("orient", "--report", tmp_path / "there.html")
    assert refused.exit_code == 2 and "--force" in refused.stderr
    assert (tmp_path / "there.html").read_text() == "mine"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["there.html"]
