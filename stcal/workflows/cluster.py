"""Detection and ``measure`` on the machines of a Dask cluster."""

import asyncio
import contextlib
import logging
import re
from collections.abc import Iterator
from concurrent.futures import CancelledError
from importlib import metadata
from typing import Any

import stcal
from stcal.errors import DetectionError, InputError
from stcal.io.images import spread
from stcal.parallel import AT_ONCE

ANSWER_S = 10  # longest time that a scheduler, and the first worker, may take to answer, in s
ADDRESS = re.compile(r"((tcp|tls)://)?([\w.-]+|\[[\da-fA-F:]+\]):\d{1,5}")


@contextlib.contextmanager
def dask_cluster(address: str, send_images: bool = False) -> Iterator[None]:
    """Hand the work on single images to the Dask cluster at ``tcp://host:8786`` for the duration of the context.
    ``send_images`` : whether images are sent by content, and not by their path on storage that all workers share.
    Raises InputError: the extra ``dask`` is not installed, no scheduler or worker answers, or a worker has other
    versions. Raises DetectionError: the scheduler was lost, or an image ended several workers."""
    with connected(address) as client:
        from distributed.comm.core import CommClosedError
        from distributed.scheduler import KilledWorker

        try:
            with spread(client.get_executor(pure=False), AT_ONCE * sum(client.nthreads().values()), send_images):
                yield
        except (CancelledError, KilledWorker, CommClosedError, ConnectionError) as error:
            lost = "its workers were" if isinstance(error, KilledWorker) else "the connection to it was"
            fault = f"--scheduler {address}: {lost} lost"
            raise DetectionError("E-WORKER-DIED", f"{fault}; run the same command again") from error


@contextlib.contextmanager
def connected(address: str) -> Iterator[Any]:
    """Yields the client of a cluster whose workers have the versions of this machine and one thread for BLAS."""
    try:
        from distributed import Client
    except ImportError as error:
        missing = "--scheduler: needs Dask; install stereo-target-calibration[dask]"
        raise InputError("E-EXTRA-MISSING", missing) from error
    for name in ("distributed", "distributed.client"):  # Dask logs each lost worker; a fault shows by its effect
        logging.getLogger(name).setLevel(logging.CRITICAL)
    _require_scheduler(address)
    with Client(address, timeout=ANSWER_S, set_as_default=False) as client:
        try:
            client.wait_for_workers(1, timeout=ANSWER_S)
        except OSError as error:
            none = f"--scheduler {address}: no worker within {ANSWER_S} s; start one with `dask worker {address}`"
            raise InputError("E-CLUSTER-WORKERS", none) from error
        _require_same(client.run(versions), address)
        client.register_worker_callbacks(_limit_threads)
        yield client


def _require_scheduler(address: str) -> None:
    """Refuses addresses without a scheduler, for some of which Dask's client waits for ever."""
    from distributed.core import rpc
    from distributed.security import Security

    async def ask() -> None:
        async with rpc(address, timeout=ANSWER_S, connection_args=Security().get_connection_args("client")) as peer:
            await peer.identity()

    if not ADDRESS.fullmatch(address):
        none = f"--scheduler {address}: no address of a scheduler; give one like tcp://host:8786"
        raise InputError("E-OPTION-VALUE", none)
    try:
        asyncio.run(asyncio.wait_for(ask(), ANSWER_S))
    except Exception as error:  # a program that is not a scheduler may answer anything
        none = f"--scheduler {address}: no scheduler answers within {ANSWER_S} s"
        remedy = "start one with `dask scheduler`, and give the address that it prints"
        raise InputError("E-CLUSTER-SCHEDULER", f"{none}; {remedy}") from error


def versions() -> str:
    """Returns the versions here of the packages on which a result depends, bit by bit."""
    found = [f"stcal {stcal.__version__}"]
    for name in ("numpy", "scipy", "opencv-python-headless"):
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            found.append(f"{name} none")
    return ", ".join(found)


def _require_same(found: dict[str, str], address: str) -> None:
    for worker, theirs in found.items():
        if theirs != versions():
            differ = f"worker {worker} has {theirs}, here {versions()}; results would differ"
            raise InputError("E-CLUSTER-VERSIONS", f"--scheduler {address}: {differ}; install the same versions")


def _limit_threads() -> None:
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
