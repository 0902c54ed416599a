"""Calls of the command line, and what they say and write."""

import csv

from typer.testing import CliRunner

from jaxro.cli import app


def run(*arguments, columns=200):
    environment = {"COLUMNS": str(columns)}
    result = CliRunner().invoke(app, [*map(str, arguments)], env=environment)
    assert result.exception is None or isinstance(result.exception, SystemExit), (
        result.exception
    )
    return result


def words(text):
    return " ".join(text.split())


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
