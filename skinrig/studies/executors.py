"""Open the executor of independent tasks: this process, processes of this machine, or a cluster.

Tasks get paths and settings, never arrays: what is large passes through a file system that all
workers share. Scheduling, restarts of lost workers and repetition of their tasks are those of Dask.
"""

import logging
import re
import sys
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Any, Final

from skinrig.errors import MissingExtra, UnusableError

SERIAL_EXECUTOR: Final = "threads"
"""Name of the executor that runs one task after the other in this process, on its threads."""
ONE_THREAD: Final = dict.fromkeys(
    ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
"""Environment of a worker process: N workers use N threads."""
LOCAL_SETTINGS: Final = {
    "distributed.deploy.lost-worker-timeout": "1h",
    "distributed.worker.profile.enabled": False,
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.admin.system-monitor.gil.enabled": False,
    "distributed.admin.tick.interval": "500ms",
    "distributed.worker.memory.monitor-interval": "500ms",
}
"""Settings of local processes: Dask waits an hour for a worker to be started again, and samples
stacks, memory and event loops less often. On a busy machine a start takes more than Dask's 15 s,
after which it gives the worker up, and the command waits for ever.
"""
CONNECT_TIMEOUT_S: Final = 10
_LOCAL: Final = re.compile(r"local:([1-9]\d{0,3})")
_REMOTE: Final = re.compile(r"(tcp|tls)://\S+:\d+")


class ExecutorLost(ConnectionError):
    """The scheduler cannot be reached, or its connection was lost."""


def check_executor(text: str) -> str:
    """Return an executor's text, or raise for one that is malformed.

    Parameters
    ----------
    text
        ``threads``, ``local:N`` or ``tcp://HOST:PORT`` (``tls://`` alike).

    Examples
    --------
    >>> check_executor("local:4")
    'local:4'
    """
    if text != SERIAL_EXECUTOR and not (_LOCAL.fullmatch(text) or _REMOTE.fullmatch(text)):
        raise UnusableError(
            f"--executor: got {text!r}, expected threads, local:N with N from 1 to 9999, or "
            "tcp://HOST:PORT; correct it"
        )
    return text


def count_local_processes(text: str) -> int:
    """Return how many processes of this machine an executor uses; 0: those of other machines.

    Examples
    --------
    >>> count_local_processes("local:4"), count_local_processes("threads")
    (4, 1)
    """
    local = _LOCAL.fullmatch(text)
    return int(local[1]) if local else int(text == SERIAL_EXECUTOR)


@contextmanager
def open_executor(text: str) -> Iterator[Executor | None]:
    """Yield the executor of a text; None for `SERIAL_EXECUTOR`, where the caller runs its tasks.

    Parameters
    ----------
    text
        See `check_executor`. ``local:N`` starts N worker processes of one thread each under
        nannies, which restart a worker that ends. ``tcp://`` connects to a running scheduler.

    Raises
    ------
    UnusableError
        For another text.
    MissingExtra
        If `distributed` is not installed.
    ExecutorLost
        Without a scheduler at the address.
    """
    if check_executor(text) == SERIAL_EXECUTOR:
        yield None
        return
    try:
        import dask
        import distributed
    except ImportError as error:
        raise MissingExtra(f"--executor {text}", "cluster") from error
    if not logging.getLogger().isEnabledFor(logging.INFO):  # it prints each step of a start
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
    local = _LOCAL.fullmatch(text)
    where: Any = text
    if local is not None:
        dask.config.set(LOCAL_SETTINGS)  # for this process: it has the scheduler, and ends with it
        where = distributed.LocalCluster(
            n_workers=int(local[1]),
            threads_per_worker=1,
            dashboard_address="127.0.0.1:0",
            env=ONE_THREAD,
            silence_logs="CRITICAL",
        )
    try:
        client = distributed.Client(where, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except OSError as error:
        raise ExecutorLost(
            f"--executor: got no scheduler at {text}, expected one; start `dask scheduler`, or "
            "correct the address"
        ) from error
    try:
        yield client.get_executor(pure=False)
    finally:
        # what still runs after an error or Ctrl-C ends with its worker, not before this command
        client.close(timeout=1)
        if local is not None:
            where.close(timeout=10)


def ended_workers(error: BaseException) -> bool:
    """Return whether an executor gave a task up because it ended several workers.

    Examples
    --------
    >>> ended_workers(ValueError("no memory"))
    False
    """
    distributed = sys.modules.get("distributed")  # loaded where its errors occur
    return distributed is not None and isinstance(error, distributed.KilledWorker)


def describe_lost_task(error: BaseException) -> str:
    """Return why an executor could not run a task, for the task's row.

    Examples
    --------
    >>> describe_lost_task(ValueError("no memory"))
    'the worker failed (ValueError: no memory)'
    """
    if ended_workers(error):
        return (
            "the task ended several worker processes, by lack of memory or a crash; give workers "
            "more memory, or run it alone with --executor threads"
        )
    return f"the worker failed ({type(error).__name__}: {error})"
