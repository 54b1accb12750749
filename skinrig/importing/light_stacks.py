"""Find the lights of a folder of images: the list, the images that belong to it, or an estimate."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from capture.documents import Fault
from capture.importers.image_stacks import Encoding, encode_srgb
from capture.importers.images import read_photo
from capture.importers.light_lists import (
    LightList,
    find_images,
    find_light_list,
    find_mask,
    read_mask,
    to_gray,
)
from capture.importers.light_tables import LightListError, UnequalCountError
from model.arrays import BoolArray, Float64Array

ESTIMATE_LIGHTS: Final = "estimate"
"""Value of ``--lights`` under which the images themselves show their lights."""
LINEAR_MISFIT_RATIO = 0.8
"""As for listed lights: values count as linear when they fit clearly better so."""
MIN_SIGN_EVIDENCE = 0.1


@dataclass(frozen=True, slots=True)
class FoundLights:
    """Lights of a folder of images.

    Attributes
    ----------
    lights
        With the images that belong to it.
    encoding
        Of the values of 8-bit files.
    assumed
        What the user did not state.
    """

    lights: LightList
    encoding: Encoding
    assumed: tuple[str, ...] = ()


def find_lights(
    directory: Path, *, lights: str | None, mask: Path | None, encoding: Encoding
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
        Of the values of 8-bit files; ``"auto"`` is resolved where lights are estimated.

    Raises
    ------
    LightListError
        When the folder, its images or its list cannot be used.
    PhotometricStereoError
        When no list exists and the images do not determine their lights.
    """
    if lights == ESTIMATE_LIGHTS:
        return _estimate_list(directory, mask, encoding)
    source = Path(lights) if lights else None
    try:
        return FoundLights(find_light_list(directory, lights=source), encoding)
    except UnequalCountError as error:
        return _without_special(directory, source, mask, encoding, error)


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
    special = find_special_images(*_read_reduced(files, mask, encoding))
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
    from reconstruction.stack_diagnosis.shading_space import choose_points, fit_shading_space
    from reconstruction.stack_diagnosis.special_images import find_special_images
    from reconstruction.stack_diagnosis.unlisted_lights import estimate_lights

    files = find_images(directory)
    gray, inside = _read_reduced(files, mask, encoding)
    special = find_special_images(gray, inside)
    kept = [number for number in range(len(files)) if number not in special]
    gray = gray[kept]
    if encoding == "auto" and _is_encoded(files[0]):
        misfit = {}
        for name, values in (("sRGB", gray), ("linear", encode_srgb(np.clip(gray, 0.0, 1.0)))):
            chosen = choose_points(
                np.asarray(values), np.ones(gray.shape, bool), inside, np.random.default_rng(0)
            )
            misfit[name] = fit_shading_space(*chosen).misfit
        if misfit["linear"] < LINEAR_MISFIT_RATIO * misfit["sRGB"]:
            encoding, gray = "linear", np.asarray(encode_srgb(np.clip(gray, 0.0, 1.0)))
        else:
            encoding = "sRGB"
    found = estimate_lights(gray, inside=inside, rng=np.random.default_rng(0))
    assumed = [
        *_set_aside(files, special),
        "all lights are of about one strength: their directions then follow from the images, with "
        f"a standard error of {np.median(found.stderr_deg):.1f} degrees",
    ]
    if found.sign_evidence < MIN_SIGN_EVIDENCE:
        assumed.append("the object is not hollow: a hollow one under opposite lights looks alike")
    pictures = tuple(files[number] for number in kept)
    listed = LightList(pictures, found.directions, "images", directory.name)
    listed = replace(listed, stderr_deg=found.stderr_deg)
    return FoundLights(listed, encoding, tuple(assumed))


def _is_encoded(file: Path) -> bool:
    return read_photo(file).encoding == "sRGB"


def _read_reduced(
    files: Sequence[Path], mask: Path | None, encoding: Encoding
) -> tuple[Float64Array, BoolArray]:
    """Return gray images (N, h, w), reduced one by one, over the white level, and the object."""
    from reconstruction.stack_diagnosis.reduced_stack import reduce_stack

    if not files:
        raise LightListError("has no images", where="folder")
    where_mask = mask or find_mask(files[0].parent)
    images: list[Float64Array] = []
    inside = np.ones((1, 1), bool)
    for file in files:
        photo = read_photo(file)
        gray = to_gray(photo.frame) / np.float32(photo.frame.white)
        if encoding == "linear" and photo.encoding == "sRGB":
            gray = encode_srgb(np.clip(gray, 0.0, 1.0)).astype(np.float32)
        whole = np.ones(gray.shape, bool)
        if where_mask is not None:
            whole = read_mask(where_mask, gray.shape)
        reduced, _ = reduce_stack(gray[None], None, whole)
        if images and reduced.gray.shape[1:] != images[0].shape:
            got, expected = (
                f"{shape[1]} x {shape[0]}" for shape in (reduced.gray.shape[1:], images[0].shape)
            )
            raise LightListError.at(
                "images differ", file.name, f"reduced {got}", expected, where=file.parent
            )
        images.append(reduced.gray[0])
        inside = reduced.inside
    return np.array(images), inside
