"""Diagnose the polarized pairs of a session: both images of each state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.session import FrameRecord, Session
from reconstruction.arrays import BoolArray
from reconstruction.pipeline.diagnosed_images import DiagnosedImages, ImageGroup, collect_images
from reconstruction.pipeline.flash.mean_frames import relative_light
from reconstruction.pipeline.inputs import InputsError
from reconstruction.pipeline.linear_frame import read_linear
from reconstruction.stack_diagnosis.polarized_pairs import find_pair_faults
from reconstruction.stack_diagnosis.reduced_stack import reduce_stack

MIN_LIGHT = 0.05
"""Light over that of the bright samples, below which a pixel is background."""
Pair = tuple[FrameRecord, FrameRecord]


def diagnose_pairs(session: Session) -> DiagnosedImages:
    """Compare the parallel and the crossed image of each state and repeat.

    Parameters
    ----------
    session
        Of the flash rig, or of imported photographs.

    Raises
    ------
    InputsError
        Without a pair of images of one size.
    """
    pairs = list_pairs(session)
    if not pairs:
        raise InputsError(
            f"{session.path}: got no state with a parallel and a crossed image of one size, "
            "expected a polarized pair, of photographs with both words in the names of the files; "
            "without one, no images can be compared"
        )
    return collect_images(_diagnose_pair(session, pair) for pair in pairs)


def list_pairs(session: Session) -> list[Pair]:
    """Return the parallel and the crossed frame of each camera, state and repeat that has both.

    A photograph whose file names no polarizer counts as crossed by assumption: it is of no pair.
    """
    imported = "photographs" in session.manifest.extra
    by_index: dict[tuple[Any, ...], dict[str, FrameRecord]] = {}
    for record in session.frames("subject"):
        if imported and "polarizer" not in record.settings:
            continue
        # views of photographs differ by setting, too, so that one pair can have two
        camera = "" if imported else record.camera
        key = camera, *sorted((k, v) for k, v in record.index.items() if k != "polarizer")
        by_index.setdefault(key, {})[str(record.index.get("polarizer"))] = record
    both = {"parallel", "crossed"}
    pairs = [(one["parallel"], one["crossed"]) for one in by_index.values() if both <= one.keys()]
    return [pair for pair in pairs if len({_describe_view(session, one) for one in pair}) == 1]


def _describe_view(session: Session, record: FrameRecord) -> tuple[Any, ...]:
    view = session.rig.view(record.camera)
    return view.cfa, view.width_px, view.height_px


def _name(record: FrameRecord) -> str:
    repeat = record.index.get("repeat", 0)
    which = f" repeat {repeat}" if repeat else ""
    return f"{record.index['state']}{which} {record.index['polarizer']}"


def _diagnose_pair(session: Session, pair: Pair) -> ImageGroup:
    frames = [session.read(record) for record in pair]
    values, usable = zip(*map(read_linear, frames), strict=True)
    power = [relative_light(record.settings) for record in pair]
    parallel, crossed = (one / factor for one, factor in zip(values, power, strict=True))
    names = [_name(record) for record in pair]
    return diagnose_pair(parallel, crossed, usable[0] & usable[1], frames[0].neutral, names)


def diagnose_pair(
    parallel: NDArray[Any],
    crossed: NDArray[Any],
    usable: BoolArray,
    neutral: tuple[float, ...] | None,
    names: Sequence[str],
) -> ImageGroup:
    """Return the faults of one pair, with its reduced gray images.

    Parameters
    ----------
    parallel, crossed
        (H, W, C) of one or three channels, linear, over the power of the flash or the exposure.
    usable
        (H, W), False where an image is saturated.
    neutral
        Camera RGB of white; None: balanced channels.
    names
        Of the two images.
    """
    channels = parallel.shape[-1]
    white = np.ones(channels)
    if neutral is not None and channels == len(neutral):
        white = np.asarray(neutral) / np.max(neutral)
    both = np.concatenate([parallel / white, crossed / white], axis=-1)
    every = np.broadcast_to(usable, (2 * channels, *usable.shape))
    stack, _ = reduce_stack(np.moveaxis(both, -1, 0), every, np.ones(usable.shape, bool))
    a, b = (np.moveaxis(one, 0, -1) for one in np.split(stack.gray, 2))
    gray = (a + b).mean(axis=-1)
    clear = stack.usable.all(axis=0)
    level = float(np.quantile(gray[clear], 0.95)) if clear.any() else np.inf
    inside = clear & (gray > MIN_LIGHT * level)
    images = [one.mean(axis=-1) for one in (a, b)]
    if channels == 1:
        a, b = images
    return ImageGroup(list(find_pair_faults(a, b, inside)), names, images)
