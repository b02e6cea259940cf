"""Detection and ``measure`` on the machines of a Dask cluster.

Alternatives considered: Ray and MPI need a cluster of their own, and no worker may join, leave or die during the work.
Jobs of a batch system are separate programs; the cache by content takes the files that they leave in a shared folder.
"""

import asyncio
import contextlib
import logging
import re
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from importlib import metadata
from typing import Any

import stcal
from stcal.errors import InputError
from stcal.io.image_jobs import spread

ANSWER_S = 10
"""Longest time that a scheduler, and the first worker, may take to answer, in s."""
AT_ONCE = 4
"""Number of images handed over for each thread of the workers, so that the next ones are there when one is done."""
ADDRESS = re.compile(r"((tcp|tls)://)?([\w.-]+|\[[\da-fA-F:]+\]):\d{1,5}")
SAME = ("stcal", "numpy", "scipy", "opencv-python-headless")
"""Packages on which a result depends, bit by bit."""


@contextlib.contextmanager
def dask_cluster(address: str, send_images: bool = False) -> Iterator[None]:
    """Hand the work on single images to a Dask cluster within the context. ``address`` : ``tcp://host:8786`` of its
    scheduler; ``send_images`` : by content, else by path on shared storage.

    Raises InputError: no extra ``dask``, no scheduler, no workers, or a worker of other versions.
    """
    with _connected(address) as workers, spread(workers, AT_ONCE * workers.threads, send_images):
        yield


@contextlib.contextmanager
def executor_of(address: str | None = None) -> Iterator[Executor]:
    """Yield the workers of a Dask cluster or, without an address, of this machine, one per core; raises as
    :func:`dask_cluster`."""
    with ProcessPoolExecutor() if address is None else _connected(address) as executor:
        yield executor


@contextlib.contextmanager
def _connected(address: str) -> Iterator["_Workers"]:
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError(
            "E-EXTRA-MISSING", "--scheduler: needs Dask; install stereo-target-calibration[dask]"
        ) from error
    _require_address(address)
    with _silent("distributed"), Client(address, timeout=ANSWER_S, set_as_default=False) as client:
        try:
            client.wait_for_workers(1, timeout=ANSWER_S)
        except OSError as error:
            raise InputError(
                "E-CLUSTER-WORKERS",
                f"--scheduler {address}: no worker within {ANSWER_S} s; start one with `dask worker {address}`",
            ) from error
        _require_same(dict[str, dict[str, str]](client.run(versions)), address)  # type: ignore[arg-type]
        yield _Workers(client, sum(dict[str, int](client.nthreads()).values()))  # type: ignore[arg-type]


@contextlib.contextmanager
def _silent(package: str) -> Iterator[None]:
    """Silence the logs of a package, such as Dask's on each lost worker; a fault shows by its effect."""
    every = logging.root.manager.loggerDict.items()
    logs = [log for name, log in every if isinstance(log, logging.Logger) and name.split(".")[0] == package]
    levels = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for log, level in zip(logs, levels, strict=True):
            log.setLevel(level)


def _require_address(address: str) -> None:
    """Refuse addresses without a scheduler, for some of which Dask's client waits for ever."""
    from distributed.core import rpc
    from distributed.security import Security

    async def ask() -> None:
        async with rpc(address, timeout=ANSWER_S, connection_args=Security().get_connection_args("client")) as peer:
            await peer.identity()

    if not ADDRESS.fullmatch(address):
        raise InputError(
            "E-OPTION-VALUE", f"--scheduler {address}: no address of a scheduler; give one like tcp://host:8786"
        )
    try:
        asyncio.run(asyncio.wait_for(ask(), ANSWER_S))
    except Exception as error:  # a program that is not a scheduler may answer anything
        raise InputError(
            "E-CLUSTER-SCHEDULER",
            f"--scheduler {address}: no scheduler answers within {ANSWER_S} s; start one with `dask scheduler`, and "
            "give the address that it prints",
        ) from error


def versions() -> dict[str, str]:
    """Returns the versions of packages on which a result depends; empty for those not installed by name."""
    version_of = {"stcal": stcal.__version__}
    for name in SAME[1:]:
        try:
            version_of[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            version_of[name] = ""
    return version_of


def _require_same(found: dict[str, dict[str, str]], address: str) -> None:
    local = versions()
    for worker, theirs in found.items():
        for name, version in local.items():
            if theirs[name] != version:
                raise InputError(
                    "E-CLUSTER-VERSIONS",
                    f"--scheduler {address}: worker {worker} has {name} {theirs[name] or 'none'}, {version or 'none'} "
                    "here; results would differ; install the same versions",
                )


class _Workers(Executor):
    """The workers of a cluster. Dask gives the jobs of a lost worker to another one, three times at most."""

    def __init__(self, client, threads: int):
        self._client, self.threads = client, threads

    def submit(self, function: Callable, /, *arguments, **_) -> Future:
        answer: Future = Future()
        answer.set_running_or_notify_cancel()  # the client drops futures that nobody waits for
        future = self._client.submit(_alone, function, *arguments, pure=False)

        def done(inner) -> None:
            try:
                result = inner.result()
            except Exception as error:
                if inner.status == "error" and not type(error).__module__.startswith("distributed"):
                    answer.set_exception(error)
                else:
                    # A scheduler that ends cancels the jobs, or resets the connection while a result is on its way.
                    lost = inner.status == "cancelled" or isinstance(error, OSError)
                    why = "the connection to the scheduler was lost" if lost else error
                    answer.set_exception(BrokenExecutor(f"the cluster gave a job up: {why}"))
            else:
                answer.set_result(result)

        future.add_done_callback(done)
        return answer


_limit: Any = None


def _alone(function: Callable, *arguments):
    """Execute a job on a worker, with one thread for BLAS from the first job on, as in processes of this machine."""
    global _limit
    if _limit is None:
        from threadpoolctl import threadpool_limits

        _limit = threadpool_limits(1)
    return function(*arguments)
