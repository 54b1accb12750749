"""Keep the images of each light for later exposures, in memory and in a file."""

import os
import tempfile
import weakref
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np

from rigsim.arrays import Float32Array
from rigsim.caching import LruCache

MAX_CACHED_IMAGES: Final = 16
"""Cached images of any size: one light of all cameras, so that a second exposure costs nothing."""
IMAGE_CACHE_BYTES: Final = 2**29
SMALL_IMAGE_BYTES: Final = 2**22
"""Images up to this size fill the cache, so that a small session's second pass costs nothing."""

ImageKey = tuple[str, int, float]
"""Camera, light, and time of the head's pose."""
Render = Callable[[], Float32Array]


class LightImages:
    """Images of single lights: the latest in memory, and all in a file if there is one."""

    def __init__(self) -> None:
        self._latest: LruCache[ImageKey, Float32Array] = LruCache(
            lambda image: max(
                MAX_CACHED_IMAGES,
                IMAGE_CACHE_BYTES // image.nbytes if image.nbytes <= SMALL_IMAGE_BYTES else 0,
            )
        )
        self._file: ImageFile | None = None

    def store(self, folder: Path, most_bytes: int) -> None:
        """Store all later images in a file, see `ImageFile`."""
        self._file = ImageFile(folder, most_bytes)

    def get(self, key: ImageKey, render: Render) -> Float32Array:
        """Return the image of a key, or render it."""
        file = self._file
        return self._latest.get(key, render if file is None else lambda: file.get(key, render))


class ImageFile:
    """Images in a temporary file without a name, which ends with the process.

    Dark rows above and below an image are not stored. An image that does not fit is rendered each
    time.

    Parameters
    ----------
    folder
        Folder of the file.
    most_bytes
        Maximum size of the file.

    Examples
    --------
    >>> images = ImageFile(Path(tempfile.gettempdir()), 1000)
    >>> first = images.get(("C00", 0, 0.0), lambda: np.ones((4, 3), np.float32))
    >>> bool((images.get(("C00", 0, 0.0), lambda: np.zeros(0, np.float32)) == first).all())
    True
    """

    def __init__(self, folder: Path, most_bytes: int) -> None:
        # a name would outlive a killed process
        file = tempfile.TemporaryFile(dir=folder, buffering=0)
        weakref.finalize(self, file.close)
        self._file = file.fileno()
        self._most_bytes, self._end = most_bytes, 0
        self._stored: dict[ImageKey, tuple[int, tuple[int, ...], int, int]] = {}
        """Offset, shape, first row and number of rows by key."""

    def get(self, key: ImageKey, render: Render) -> Float32Array:
        """Return the stored image of a key, or render and store it."""
        if key in self._stored:
            offset, shape, top, count = self._stored[key]
            out = np.zeros(shape, np.float32)
            rows = out[top : top + count]
            if not rows.nbytes or os.preadv(self._file, [rows.data], offset) == rows.nbytes:
                return out
        image = render()
        self._append(key, image)
        return image

    def _append(self, key: ImageKey, image: Float32Array) -> None:
        lit = np.flatnonzero(image.reshape(len(image), -1).any(axis=1))
        top, end = (int(lit[0]), int(lit[-1]) + 1) if len(lit) else (0, 0)
        rows = np.ascontiguousarray(image[top:end])
        if self._end + rows.nbytes > self._most_bytes:
            return
        with suppress(OSError):  # of a full disk
            if not rows.nbytes or os.pwrite(self._file, rows.data, self._end) == rows.nbytes:
                self._stored[key] = self._end, image.shape, top, end - top
                self._end += rows.nbytes
