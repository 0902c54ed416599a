"""Workloads in processes of their own, without any compiled program at hand."""

import json
import subprocess
import sys

from .metrics import Metric


def in_new_process(module: str, call: str) -> list[Metric]:
    """What a function of a module of this package measures in a new process."""
    names = f"import json, dataclasses as d; from benchmarks import {module} as m"
    code = f"{names}; print(json.dumps([d.astuple(metric) for metric in m.{call}]))"
    output = subprocess.check_output([sys.executable, "-c", code], text=True)
    return [Metric(*row) for row in json.loads(output.splitlines()[-1])]
