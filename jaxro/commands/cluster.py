"""Tables of any size on a cluster: the parts of `stream`, worked on by actors of
Ray Data.

Every actor keeps its compiled programs, has a GPU to itself where the cluster has some,
reads its parts from the table and writes them below the folder of the job: both must be
on a file system that all machines share. Ray starts an actor that died anew and gives
its part to another; the journal stays with the caller, so that a run on a cluster that
was stopped is resumed like any other, here or there.
"""

import json
import logging
import os
import socket
from collections.abc import Callable, Iterator
from typing import Any

from ..tables.fields import TableError
from ..xla import store
from .journal import Job
from .stream import Part, Work, Worker

WAIT = 10.0
"""Seconds in which a cluster answers."""


def actor(work: Work) -> type:
    """The class of workers of a cluster, each with one core or GPU."""

    class Actor:
        # the work is part of the class, which Ray keeps: an argument could be lost
        # before an actor is started anew
        def __init__(self):
            store.keep_programs()
            self._worker = Worker(work, threads=1)

        def __call__(self, batch: dict[str, Any]) -> dict[str, list[str]]:
            """The lines of these parts for the journal, as JSON."""
            parts = zip(batch["number"], batch["begins"], strict=True)
            return {
                "entry": [
                    json.dumps(self._worker(Part(int(number), begins)))
                    for number, begins in parts
                ]
            }

    return Actor


def on_ray(job: Job, told: Callable[[int], None]) -> Iterator[dict[str, Any]]:
    """The lines of all parts that are left, in the order in which they are finished.

    On the cluster of the environment variable RAY_ADDRESS, or on one of this machine's
    cores.
    """
    try:
        import ray
        import ray.data
        from ray.exceptions import RayError
    except ModuleNotFoundError:
        raise SystemExit("A cluster needs Ray: pip install 'jaxro[cluster]'") from None
    if not job.left:
        return
    own = not ray.is_initialized()
    if own:
        address = os.environ.get("RAY_ADDRESS")
        _check_address(address)
        ray.init(address=address, log_to_driver=False, logging_level=logging.WARNING)
    ray.data.DataContext.get_current().enable_progress_bars = False
    logging.getLogger("ray.data").setLevel(logging.ERROR)
    having = ray.cluster_resources()
    gpus, cores = int(having.get("GPU", 0)), int(having.get("CPU", 1))
    each: dict[str, Any] = {"num_gpus": 1} if gpus else {"num_cpus": 1}
    actors = min(gpus or cores, len(job.left))
    pool = ray.data.ActorPoolStrategy(min_size=actors, max_size=actors)
    items = [{"number": part.number, "begins": part.begins} for part in job.left]
    entries = ray.data.from_items(items, override_num_blocks=len(items)).map_batches(
        actor(job.work), batch_size=1, batch_format="numpy", compute=pool, **each
    )
    done = job.done
    try:
        for row in entries.iter_rows():
            entry = json.loads(row["entry"])
            done += entry["pairs"]
            told(done)
            yield entry
    except KeyboardInterrupt:
        if own:
            ray.shutdown()
        raise
    except RayError as error:
        found = str(error).strip().splitlines()[-1]
        expected = (
            f"a table and a folder {job.work.folder} on a file system that all "
            "machines share"
        )
        raise TableError(
            job.work.file,
            found=found,
            expected=f"{expected}; what is finished --resume keeps",
        ) from None


def _check_address(address: str | None) -> None:
    """Raises TableError where nothing answers at host:port, which Ray would go on
    trying."""
    host, _, port = (address or "").removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal():
        return
    try:
        socket.create_connection((host, int(port)), WAIT).close()
    except (OSError, OverflowError) as error:
        expected = (
            "the address of a cluster that runs; or leave it unset for the cores of "
            "this machine"
        )
        raise TableError(
            "RAY_ADDRESS", found=f"{address}: {error}", expected=expected
        ) from None
