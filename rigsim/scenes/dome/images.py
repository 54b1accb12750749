"""Keep the images of each light for later exposures, in memory and in a file."""

import os
import tempfile
import threading
import weakref
from bisect import bisect_left, insort
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Final

import numpy as np

from rigsim.arrays import Float32Array
from rigsim.caching import LruCache
from rigsim.render.lens_kernels import MOSAIC_LIGHTS
from rigsim.scenes.dome.ahead import CameraLights, RenderAhead

MAX_CACHED_IMAGES: Final = 16
"""Cached images of any size: one light of all cameras, so that a second exposure costs nothing."""
IMAGE_CACHE_BYTES: Final = 2**29
SMALL_IMAGE_BYTES: Final = 2**22
"""Images up to this size fill the cache, so that a small session's second pass costs nothing."""

ImageKey = tuple[str, int, float]
"""Camera, light, and time of the head's pose."""
RenderLights = Callable[[str, Sequence[int], float], Sequence[Float32Array]]
"""Returns a camera's images of up to `MOSAIC_LIGHTS` lights at a time, s."""


class LightImages:
    """Images of single lights: the latest in memory, later requests' in a file if there is one.

    Parameters
    ----------
    render
        Renders images that are not stored.
    """

    def __init__(self, render: RenderLights) -> None:
        self._render = render
        self._latest: LruCache[ImageKey, Float32Array] = LruCache(
            lambda image: max(
                MAX_CACHED_IMAGES,
                IMAGE_CACHE_BYTES // image.nbytes if image.nbytes <= SMALL_IMAGE_BYTES else 0,
            )
        )
        self._groups: dict[tuple[str, int], CameraLights] = {}
        self._requests_left: Counter[tuple[str, int]] = Counter()
        self._file: ImageFile | None = None
        self._ahead: RenderAhead | None = None
        self._lock = threading.RLock()  # clients of a served rig have threads of their own

    def expect(self, requests: Iterable[tuple[str, int]]) -> None:
        """Render a camera's lights in groups: a request of one renders its group.

        Memory must keep the images of all cameras, see `IMAGE_CACHE_BYTES`, or `render_ahead` them.

        Parameters
        ----------
        requests
            Camera and light of each request, in order.
        """
        self._requests_left = Counter(requests)
        lights: defaultdict[str, list[int]] = defaultdict(list)
        for camera, light in self._requests_left:
            lights[camera].append(light)
        self._groups = {}
        for camera, ordered in lights.items():
            for k in range(0, len(ordered), MOSAIC_LIGHTS):
                group = camera, tuple(ordered[k : k + MOSAIC_LIGHTS])
                self._groups |= {(camera, light): group for light in group[1]}

    @contextmanager
    def render_ahead(self, folder: Path, most_bytes: int) -> Iterator[None]:
        """Render the expected images of a fixed head before they are requested.

        They are stored in a file until their last request, see `ImageFile`.

        Parameters
        ----------
        folder, most_bytes
            As for `ImageFile`.
        """
        file = self._file = ImageFile(folder, most_bytes)
        groups = list(dict.fromkeys(self._groups[one] for one in self._requests_left))
        try:
            with RenderAhead(groups, lambda one: self._store(file, *one)) as self._ahead:
                yield
        finally:  # until its thread ended, requests wait for it
            with self._lock:
                self._ahead = None

    @contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Do not render ahead meanwhile: renderers are called by one thread at a time."""
        with self._lock:
            ahead = self._ahead
            with nullcontext() if ahead is None else ahead.exclusive():
                yield

    def get(self, key: ImageKey) -> Float32Array:
        """Return the image of a key; it is rendered unless it is stored."""
        with self._lock:
            image = self._latest.get(key, lambda: self._find(key))
            if left := self._requests_left[key[:2]]:
                self._requests_left[key[:2]] = left - 1
                if left == 1 and self._file is not None:
                    self._file.remove(key)
            return image

    def _find(self, key: ImageKey) -> Float32Array:
        camera, light, t_s = key
        _, group = self._groups.get((camera, light), (camera, (light,)))
        if self._file is None:
            images = dict(zip(group, self._render(camera, group, t_s), strict=True))
            for other, image in images.items():
                self._latest.put((camera, other, t_s), image)
            return images[light]
        if (stored := self._file.load(key)) is not None:
            return stored
        with self.undisturbed():
            self._store(self._file, camera, group)
            stored = self._file.load(key)
            if stored is None:
                return self._render(camera, [light], t_s)[0]
        if (ahead := self._ahead) is not None:
            ahead.begin_after((camera, group))
        return stored

    def _store(self, file: "ImageFile", camera: str, group: Sequence[int]) -> None:
        """Render and store a group's images that requests need; none without room."""
        needed = [light for light in group if self._requests_left[camera, light]]
        missing = [light for light in needed if not file.has((camera, light, 0.0))]
        if missing and file.has_room(len(missing)):
            for light, image in zip(missing, self._render(camera, missing, 0.0), strict=True):
                file.add((camera, light, 0.0), image)


class ImageFile:
    """Images in a temporary file without a name, which ends with the process.

    Dark rows above and below an image are not stored. Places of removed images are used again.
    After a failed write nothing more is stored. One thread adds images at a time; another one may
    load and remove them.

    Parameters
    ----------
    folder
        Folder of the file.
    most_bytes
        Maximum size of the file.

    Examples
    --------
    >>> images = ImageFile(Path(tempfile.gettempdir()), 1000)
    >>> images.add(("C00", 0, 0.0), np.ones((4, 3), np.float32))
    >>> float(images.load(("C00", 0, 0.0)).sum()), images.load(("C00", 1, 0.0))
    (12.0, None)
    """

    def __init__(self, folder: Path, most_bytes: int) -> None:
        # a name would outlive a killed process
        file = tempfile.TemporaryFile(dir=folder, buffering=0)
        weakref.finalize(self, file.close)
        self._file = file.fileno()
        self._most_bytes, self._end, self._largest = most_bytes, 0, 0
        self._stored: dict[ImageKey, tuple[tuple[int, int], tuple[int, ...], int, int]] = {}
        """Place, shape, first row and number of rows by key."""
        self._free: list[tuple[int, int]] = []
        """Sizes and offsets of places without images, ascending."""
        self._lock = threading.Lock()

    def has(self, key: ImageKey) -> bool:
        """Return whether an image is stored."""
        return key in self._stored

    def has_room(self, count: int) -> bool:
        """Return whether some images of the largest size so far fit."""
        with self._lock:
            places = len(self._free) - bisect_left(self._free, (self._largest, 0))
            return self._end + max(0, count - places) * self._largest <= self._most_bytes

    def load(self, key: ImageKey) -> Float32Array | None:
        """Return a stored image; None when there is none, or when the file cannot be read."""
        if key not in self._stored:
            return None
        (_, offset), shape, top, count = self._stored[key]
        out = np.zeros(shape, np.float32)
        rows = out[top : top + count]
        with suppress(OSError):
            if not rows.nbytes or os.preadv(self._file, [rows.data], offset) == rows.nbytes:
                return out
        return None

    def add(self, key: ImageKey, image: Float32Array) -> None:
        """Store an image unless it does not fit."""
        lit = np.flatnonzero(image.reshape(len(image), -1).any(axis=1))
        top, end = (int(lit[0]), int(lit[-1]) + 1) if len(lit) else (0, 0)
        rows = np.ascontiguousarray(image[top:end])
        self._largest = max(self._largest, rows.nbytes)
        place = self._reserve(rows.nbytes)
        if place is None:
            return
        written = 0
        with suppress(OSError):  # of a full disk
            written = os.pwrite(self._file, rows.data, place[1]) if rows.nbytes else 0
        if written < rows.nbytes:
            self._most_bytes = 0
            return
        self._stored[key] = place, image.shape, top, end - top

    def remove(self, key: ImageKey) -> None:
        """Remove an image if it is stored."""
        if (stored := self._stored.pop(key, None)) is not None and stored[0][0]:
            with self._lock:
                insort(self._free, stored[0])

    def _reserve(self, size: int) -> tuple[int, int] | None:
        """Return size and offset of the smallest free place, or of one at the end; None: full."""
        if not size:
            return 0, 0
        with self._lock:
            if self._end > self._most_bytes:  # a write failed
                return None
            if (found := bisect_left(self._free, (size, 0))) < len(self._free):
                return self._free.pop(found)
            if self._end + size > self._most_bytes:
                return None
            self._end += size
            return size, self._end - size
