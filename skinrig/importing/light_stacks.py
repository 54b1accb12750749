"""Find the lights of a folder of images: the list, the images that belong to it, or an estimate."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from capture.documents import Fault, InputError
from capture.importers.camera_poses import read_camera_axes
from capture.importers.exif import compare_exposures
from capture.importers.image_stacks import LINEAR_MISFIT_RATIO, Encoding, encode_srgb
from capture.importers.images import read_photo
from capture.importers.imported_session import find_common_white
from capture.importers.light_lists import (
    LightList,
    find_images,
    find_light_list,
    find_mask,
    read_intensities,
    read_mask,
    to_gray,
)
from capture.importers.light_tables import LightListError, UnequalCountError
from capture.importers.video_frames import is_video
from model.arrays import BoolArray, Float64Array

if TYPE_CHECKING:
    from reconstruction.stack_diagnosis.reduced_stack import ReducedStack

ESTIMATE_LIGHTS: Final = "estimate"
"""Value of ``--lights`` under which the images themselves show their lights."""
CAMERA_FOLDER = re.compile(r"(?i)(cam|view|c)[a-z]*[_-]?\d+$")
MIN_SIGN_EVIDENCE = 0.1
MIN_OBJECT_PX = 20


@dataclass(frozen=True, slots=True)
class FoundLights:
    """Lights of a folder of images.

    Attributes
    ----------
    lights
        With the images that belong to it.
    encoding
        Of the values of 8-bit files, as asked or as the images show it.
    assumed
        What the user did not state.
    """

    lights: LightList
    encoding: Encoding
    assumed: tuple[str, ...] = ()


def find_lights(
    directory: Path,
    *,
    lights: str | None,
    mask: Path | None,
    encoding: Encoding,
    camera: Path | None = None,
    mm_per_px: float | None = None,
) -> FoundLights:
    """Find the lights of a folder of images of one object.

    Parameters
    ----------
    directory
        Folder of the images.
    lights
        Path of a list, ``"estimate"``, or None: the folder's own list.
    mask
        Image of the object; None: the folder's own.
    encoding
        Of the values of 8-bit files; ``"auto"`` is resolved where the images show it.
    camera
        transforms.json or COLMAP's images.txt, if the list is in the frame of that file.
    mm_per_px
        Size of a pixel at the object, if the rows of the list are positions. These need no camera:
        its file states neither the object's center nor the scene's unit.

    Raises
    ------
    LightListError
        When the folder, its images or its list cannot be used.
    PhotometricStereoError
        When no list exists and the images do not determine their lights.
    """
    if camera is not None and mm_per_px is not None:
        raise LightListError.at(
            "turns directions, not positions", "mm_per_px", str(mm_per_px), "none with a camera",
            where=camera,
            advice="Leave --mm-per-px out: then the lights count as distant. Or give positions in "
            "mm around the center of the image, in the camera's axes, without --camera.",
        )  # fmt: skip
    _require_images(directory)
    if lights == ESTIMATE_LIGHTS:
        if camera is not None:
            raise LightListError.at(
                "needs no camera", "camera", camera.name, "none", where=directory
            )
        return _estimate_list(directory, mask, encoding)
    source = Path(lights) if lights else None
    try:
        listed = find_light_list(directory, lights=source)
    except UnequalCountError as error:
        found = _without_special(directory, source, mask, encoding, error)
    else:
        unlisted = [file for file in find_images(directory) if file not in listed.images]
        texts = (f"{file.name} is not in {listed.file}, and was left out" for file in unlisted)
        found = FoundLights(listed, encoding, tuple(texts))
    found = replace(found, encoding=_find_encoding(found.lights.images, mask, encoding))
    if camera is None:
        return found
    axes = read_camera_axes(camera, found.lights.images)
    turned = replace(found.lights, vectors=found.lights.vectors @ axes.T)
    text = f"the lights are in the frame of {camera.name}, and were turned into the camera's"
    return replace(found, lights=turned, assumed=(*found.assumed, text))


def require_list_of_video(source: Path, lights: str | None) -> None:
    """Refuse a video without a list of its lights: the folder of its frames has none.

    Raises
    ------
    LightListError
        With what to do.
    """
    if lights is None and is_video(source):
        raise LightListError.at(
            "needs a list of its lights", "lights", "none", f"a file, or {ESTIMATE_LIGHTS}",
            where=source, advice=f"Give --lights FILE, or --lights {ESTIMATE_LIGHTS}.",
        )  # fmt: skip


def _require_images(directory: Path) -> None:
    """Refuse folders of several cameras, with what to do."""
    if directory.is_dir():
        try:
            find_images(directory)
        except LightListError as error:
            below = [one.name for one in sorted(directory.iterdir()) if one.is_dir()]
            views = [name for name in below if CAMERA_FOLDER.match(name)]
            if len(views) < 2:
                raise
            raise LightListError(
                error.what,
                where=error.where,
                faults=error.faults,
                advice=f"Folders {views[0]} to {views[-1]} look like cameras. Normals under listed "
                "lights are of one camera: name one folder; a list next to them is found.",
                code=error.code,
            ) from None


def _find_encoding(files: Sequence[Path], mask: Path | None, encoding: Encoding) -> Encoding:
    """Return the encoding of 8-bit files; ``"auto"`` where the images cannot show it."""
    from reconstruction.stack_diagnosis.diagnosis import MIN_FRAMES

    if encoding != "auto" or len(files) < MIN_FRAMES or read_photo(files[0]).encoding != "sRGB":
        return encoding
    try:
        stack = _read_reduced(files, mask, encoding)
    except InputError:  # the import names faults of the files
        return encoding
    return _choose_encoding(stack)[0]


def _without_special(
    directory: Path,
    source: Path | None,
    mask: Path | None,
    encoding: Encoding,
    error: LightListError,
) -> FoundLights:
    """Set dark and full-bright images aside, and take the list if its rows then suffice."""
    from reconstruction.stack_diagnosis.special_images import find_special_images

    files = find_images(directory)
    try:
        stack = _read_reduced(files, mask, encoding)
    except InputError:  # the number of images comes first, other faults of the files later
        raise error from None
    special = find_special_images(stack.gray, stack.inside, usable=stack.usable)
    kept = [file for number, file in enumerate(files) if number not in special]
    try:
        found = find_light_list(directory, lights=source, images=kept)
    except LightListError:
        if not special:
            raise error from None
        named = ", ".join(f"{files[number].name} ({what})" for number, what in special.items())
        raise LightListError(
            error.what,
            where=error.where,
            faults=[*error.faults, Fault("images under no single light", named, "none")],
            advice=error.advice,
            code=error.code,
        ) from None
    return FoundLights(found, encoding, _set_aside(files, special))


def _set_aside(files: Sequence[Path], special: dict[int, str]) -> tuple[str, ...]:
    return tuple(
        f"{files[number].name} is {what} and belongs to no light"
        for number, what in special.items()
    )


def _estimate_list(directory: Path, mask: Path | None, encoding: Encoding) -> FoundLights:
    """Estimate the directions from the images; the encoding is the one that fits better."""
    from reconstruction.stack_diagnosis.reduced_stack import ReducedStack
    from reconstruction.stack_diagnosis.special_images import find_special_images
    from reconstruction.stack_diagnosis.unlisted_lights import MIN_FRAMES, estimate_lights

    files = find_images(directory)
    whole = _read_reduced(files, mask, encoding)
    special = find_special_images(whole.gray, whole.inside, usable=whole.usable)
    kept = [number for number in range(len(files)) if number not in special]
    if len(kept) < MIN_FRAMES:
        raise LightListError.at(
            "cannot show its lights",
            "images under one light",
            str(len(kept)),
            f"{MIN_FRAMES} or more",
            where=directory,
        )
    gray = whole.gray[kept]
    intensity = read_intensities(files[0].parent, len(kept))
    if intensity is not None:
        gray = gray / (intensity.mean(axis=1) / intensity.mean())[:, None, None]
    stack = ReducedStack(gray, whole.usable[kept], whole.inside)
    if encoding == "auto" and read_photo(files[0]).encoding == "sRGB":
        encoding, stack = _choose_encoding(stack)
    found = estimate_lights(
        stack.gray, usable=stack.usable, inside=stack.inside, rng=np.random.default_rng(0)
    )
    assumed = [
        *_set_aside(files, special),
        "all lights are of about one strength, over what the files state: their directions then "
        f"follow from the images, with a standard error of {np.median(found.stderr_deg):.1f} "
        "degrees",
    ]
    if found.sign_evidence < MIN_SIGN_EVIDENCE:
        assumed.append("the object is not hollow: a hollow one under opposite lights looks alike")
    pictures = tuple(files[number] for number in kept)
    listed = LightList(pictures, found.directions, "images", directory.name, intensity)
    return FoundLights(replace(listed, stderr_deg=found.stderr_deg), encoding, tuple(assumed))


def _choose_encoding(stack: "ReducedStack") -> "tuple[Encoding, ReducedStack]":
    """Return the encoding under which three images predict the others better, and its light."""
    from reconstruction.stack_diagnosis.shading_space import choose_points, fit_shading_space

    linear = replace(stack, gray=np.asarray(encode_srgb(np.clip(stack.gray, 0.0, 1.0))))
    decoded, as_stored = (
        fit_shading_space(
            *choose_points(one.gray, one.usable, one.inside, np.random.default_rng(0))
        ).misfit
        for one in (stack, linear)
    )
    if as_stored < LINEAR_MISFIT_RATIO * decoded:
        return "linear", linear
    return "sRGB", stack


def _read_reduced(files: Sequence[Path], mask: Path | None, encoding: Encoding) -> "ReducedStack":
    """Return gray images over white and exposure, reduced one by one, without saturated samples."""
    from reconstruction.stack_diagnosis.reduced_stack import ReducedStack, reduce_stack

    where_mask = mask or find_mask(files[0].parent)
    images: list[Float64Array] = []
    usable: list[BoolArray] = []
    whites: list[float | None] = []
    settings: list[dict[str, str | int | float]] = []
    whole = np.zeros((0, 0), bool)
    inside = whole
    for file in files:
        photo = read_photo(file)
        frame = photo.frame
        black = float(np.mean(frame.black))
        gray = (to_gray(frame).astype(np.float64) - black) / (frame.white - black)
        if encoding == "linear" and photo.encoding == "sRGB":
            gray = np.asarray(encode_srgb(np.clip(gray, 0.0, 1.0)))
        if not images:
            whole = np.ones(gray.shape, bool)
            if where_mask is not None:
                whole = read_mask(where_mask, (gray.shape[0], gray.shape[1]))
        elif gray.shape != whole.shape:
            got, expected = (f"{size[1]} x {size[0]}" for size in (gray.shape, whole.shape))
            raise LightListError.at("images differ", file.name, got, expected, where=file.parent)
        clear = frame.cfa < frame.white
        if frame.pattern != "MONO":
            clear = clear[::2, ::2] & clear[::2, 1::2] & clear[1::2, ::2] & clear[1::2, 1::2]
        reduced, _ = reduce_stack(gray[None], clear[None], whole)
        images.append(reduced.gray[0])
        usable.append(reduced.usable[0])
        whites.append(photo.white_value)
        settings.append(photo.exposure_settings)
        inside = reduced.inside
    if not inside.any():
        raise LightListError.at(
            "does not fit the images",
            "mask",
            "an object thinner than a block of pixels",
            f"one of {MIN_OBJECT_PX} pixels across or more",
            where=str(where_mask),
        )
    found = np.array(images)
    white_value = find_common_white(whites)
    if white_value:
        factors = [1.0 if white is None else white / white_value for white in whites]
        found *= np.array(factors)[:, None, None]
    exposures, _ = compare_exposures(settings)
    if exposures:
        found *= (np.median(exposures) / np.array(exposures))[:, None, None]
    return ReducedStack(found, np.array(usable), inside)
