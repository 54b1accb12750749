"""Crop photographs and reduce their size, as raw frames, before they enter a session."""

import re
from dataclasses import dataclass, replace

import numpy as np

from capture import raw
from capture.arrays import UInt16Array
from capture.documents import Fault
from capture.importers.face_finding import find_face, frame_face
from capture.importers.image_checks import PhotoError
from capture.importers.images import Photo

MIN_SIDE_PX = 16
"""Least side of a cropped or reduced photograph, pixels."""
FACE_CROP = "face"
"""Crop that asks for the face's surroundings."""


@dataclass(frozen=True, slots=True)
class Framing:
    """Part of the photographs that is imported, and its size."""

    crop_px: tuple[int, int, int, int] | None = None
    """Left, top, width and height, pixels of the photograph from its upper left corner; None: the
    whole photograph."""
    max_width_px: int | None = None
    """Width that photographs may have; wider ones are reduced by a whole factor. None: any."""
    around_face: bool = False
    """Whether `locate` replaces the crop by one around the face of each photograph."""

    @classmethod
    def parse(cls, crop: str | None, max_width_px: int | None) -> "Framing":
        """Read a crop as the command line has it.

        Parameters
        ----------
        crop
            ``X,Y,WIDTH,HEIGHT`` in pixels, ``face``, or None.
        max_width_px
            See `Framing`.

        Raises
        ------
        PhotoError
            If the crop has another form, or a side is below `MIN_SIDE_PX`.

        Examples
        --------
        >>> Framing.parse("100,50,800,1000", 400).crop_px
        (100, 50, 800, 1000)
        """
        if max_width_px is not None and max_width_px < MIN_SIDE_PX:
            raise PhotoError(f"width: got {max_width_px}, expected {MIN_SIDE_PX} or more pixels")
        if crop is None:
            return cls(None, max_width_px)
        if crop == FACE_CROP:
            return cls(None, max_width_px, around_face=True)
        match = re.fullmatch(r"(\d{1,6}),(\d{1,6}),(\d{1,6}),(\d{1,6})", crop.replace(" ", ""))
        numbers = [int(part) for part in match.groups()] if match else [0] * 4
        if min(numbers[2:]) < MIN_SIDE_PX:
            raise PhotoError(
                f"crop: got {crop!r}, expected X,Y,WIDTH,HEIGHT in pixels, sides of "
                f"{MIN_SIDE_PX} or more, or {FACE_CROP}"
            )
        left, top, width, height = numbers
        return cls((left, top, width, height), max_width_px)

    def locate(self, photo: Photo, *, where: str) -> tuple["Framing", tuple[float, ...]]:
        """Return the framing of one photograph, and its face relative to the cropped image.

        Parameters
        ----------
        photo
            The photograph.
        where
            File name for messages.

        Returns
        -------
        Framing
            With the crop around the face, if `around_face`.
        tuple
            Left, top, width and height of the face's square over those of the crop; empty without
            `around_face`.

        Raises
        ------
        PhotoError
            If the photograph shows no face.
        """
        if not self.around_face:
            return self, ()
        frame = photo.frame
        gray = frame.pattern == "MONO"
        scale = 2 if photo.encoding == "raw" and not gray else 1
        if gray:
            light = (frame.cfa[..., None] - min(frame.black)).astype(np.float32)
        else:
            neutral = np.asarray(frame.neutral or (1.0, 1.0, 1.0))
            light = (raw.linear_rgb(frame, demosaic="superpixel").rgb / neutral).astype(np.float32)
        face = find_face(light)
        if face is None:
            size = f"{scale * light.shape[1]} x {scale * light.shape[0]} px"
            wanted = "an upright face seen from the front"
            raise PhotoError(
                "shows no face that was found",
                where=where,
                faults=[Fault("crop", f"{FACE_CROP}, in {size}", wanted)],
                advice="Give the crop as X,Y,WIDTH,HEIGHT in pixels.",
            )
        left, top, width, height = frame_face(face, (light.shape[1], light.shape[0]))
        x, y, across, down = face
        relative = (x - left) / width, (y - top) / height, across / width, down / height
        chosen = scale * left, scale * top, scale * width, scale * height
        return replace(self, crop_px=chosen, around_face=False), relative

    def apply(self, photo: Photo, *, where: str) -> Photo:
        """Return the chosen part of a photograph; its pixels are means of whole blocks.

        The mean of k x k photosites of one color has 1 / k^2 of their variance. It is saturated
        where one of them is.

        Parameters
        ----------
        photo
            The photograph; a pixel of a developed image is one 2 x 2 cell of its frame.
        where
            File name for messages.

        Raises
        ------
        PhotoError
            If the crop is not inside the photograph, or fewer than `MIN_SIDE_PX` remain.
        """
        frame = photo.frame
        side = 1 if frame.pattern == "MONO" else 2
        # pixels of a raw file are photosites, those of a developed image are cells
        scale = 1 if photo.encoding == "raw" else side
        cfa, notes = frame.cfa, list(photo.notes)
        height, width = (length // scale for length in cfa.shape)
        if self.crop_px is not None:
            left, top, across, down = self.crop_px
            if left + across > width or top + down > height:
                raise _framing_error(
                    "does not contain the crop",
                    where,
                    Fault("crop", f"{left},{top},{across},{down}", f"inside {width} x {height} px"),
                )
            rows, columns = ((scale * low) // side * side for low in (top, left))
            bottom, right = (scale * n // side * side for n in (down, across))
            cfa = cfa[rows : rows + bottom, columns : columns + right]
            height, width = (length // scale for length in cfa.shape)
            # whole cells of a raw file's mosaic
            place = f"{columns // scale}, {rows // scale}"
            notes.append(f"cropped to {width} x {height} pixels at {place}")
        factor = 1 if self.max_width_px is None else -(-width // self.max_width_px)
        noise = frame.noise_profile
        if factor > 1:
            cfa = _average_blocks(cfa, side, factor, frame.white)
            notes.append(f"each pixel is the mean of {factor} x {factor}")
            if noise is not None:
                noise = noise[0] / factor**2, noise[1] / factor**2
        if cfa is frame.cfa:
            return photo
        if min(cfa.shape) < MIN_SIDE_PX * scale:
            left_over = f"{cfa.shape[1] // scale} x {cfa.shape[0] // scale} px"
            least = f"sides of {MIN_SIDE_PX} px or more"
            raise _framing_error("is too small", where, Fault("size", left_over, least))
        framed = replace(frame, cfa=np.ascontiguousarray(cfa), noise_profile=noise)
        return replace(photo, frame=framed, notes=tuple(notes))


def _framing_error(what: str, where: str, fault: Fault) -> PhotoError:
    return PhotoError(what, where=where, faults=[fault], advice="Give another crop or width.")


def _average_blocks(cfa: UInt16Array, side: int, factor: int, white: int) -> UInt16Array:
    """Average blocks of photosites of one color; the mosaic keeps its pattern.

    Examples
    --------
    >>> mosaic = np.array([[1, 9, 3, 9], [5, 7, 5, 7], [1, 9, 3, 9], [5, 7, 5, 7]], np.uint16)
    >>> _average_blocks(mosaic, 2, 2, 99).tolist()
    [[2, 9], [5, 7]]
    """
    rows, columns = (length // (side * factor) for length in cfa.shape)
    whole = cfa[: rows * side * factor, : columns * side * factor]
    blocks = whole.reshape(rows, factor, side, columns, factor, side)
    mean = np.rint(blocks.mean(axis=(1, 4), dtype=np.float32))
    kept = np.where((blocks >= white).any(axis=(1, 4)), white, np.minimum(mean, white - 1))
    return kept.astype(np.uint16).reshape(rows * side, columns * side)
