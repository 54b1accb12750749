"""Render images on a thread of their own, before they are requested."""

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final, TypeAlias

from numba import get_num_threads, set_num_threads, threading_layer

logger = logging.getLogger(__name__)

CameraLights: TypeAlias = tuple[str, tuple[int, ...]]
"""A camera, and lights that are rendered together."""

THREAD_NAME: Final = "images of lights"
"""Name of the thread."""

CONCURRENT_LAYERS: Final = ("omp", "tbb")
"""Numba's threading layers whose kernels several threads may call at once; others abort."""


class RenderAhead:
    """Thread that renders groups of images in order while their requests are served.

    Only one thread renders at a time. A request that needs a renderer goes first. Without one of
    `CONCURRENT_LAYERS` nothing is rendered ahead.

    Parameters
    ----------
    groups
        Groups in the order of their requests.
    render
        Renders and stores a group, unless it is stored.

    Examples
    --------
    >>> rendered = threading.Event()
    >>> with RenderAhead([("C00", (0,)), ("C00", (1,))], lambda group: rendered.set()) as ahead:
    ...     ahead.begin_after(("C00", (0,)))
    ...     rendered.wait(10.0)
    True
    """

    def __init__(
        self, groups: Sequence[CameraLights], render: Callable[[CameraLights], object]
    ) -> None:
        self._threads = get_num_threads()  # starts them, which chooses their layer
        self._groups = tuple(groups) if threading_layer() in CONCURRENT_LAYERS else ()
        self._render, self._next = render, len(self._groups)
        self._changed = threading.Condition()
        self._is_busy, self._is_stopped, self._waiting = False, False, 0
        self._thread = threading.Thread(target=self._run, name=THREAD_NAME, daemon=True)

    def __enter__(self) -> "RenderAhead":
        """Start the thread."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop after the group that is being rendered."""
        with self._changed:
            self._is_stopped = True
            self._changed.notify_all()
        self._thread.join()

    def begin_after(self, group: CameraLights) -> None:
        """Render the groups after this one, unless earlier ones are not finished."""
        with self._changed:
            if self._next == len(self._groups) and group in self._groups:
                self._next = self._groups.index(group) + 1
                self._changed.notify_all()

    @contextmanager
    def exclusive(self) -> Iterator[None]:
        """Render nothing ahead meanwhile."""
        with self._changed:
            self._waiting += 1
            try:
                self._changed.wait_for(lambda: not self._is_busy)
                yield
            finally:
                self._waiting -= 1
                self._changed.notify_all()

    def _run(self) -> None:
        set_num_threads(self._threads)
        while (group := self._take()) is not None:
            is_rendered = False
            try:
                self._render(group)
                is_rendered = True
            except Exception as error:  # the request of an image renders it again, and raises this
                logger.warning(
                    "images are rendered when they are requested: %s", error, exc_info=True
                )
            finally:
                self._finish(rest=is_rendered)

    def _take(self) -> CameraLights | None:
        """Wait for the next group; None at the end."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._is_stopped or not (self._waiting or self._next == len(self._groups))
            )
            if self._is_stopped:
                return None
            self._is_busy = True
            self._next += 1
            return self._groups[self._next - 1]

    def _finish(self, *, rest: bool) -> None:
        with self._changed:
            self._is_busy = False
            self._next = self._next if rest else len(self._groups)
            self._changed.notify_all()
