"""The page of `skinrig diagnose --out`: each fault with the images that show it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import Float64Array
from reconstruction.pipeline.diagnosed_images import DiagnosedImages
from reconstruction.stack_diagnosis import Finding
from skinrig.console import format_count
from skinrig.reporting import page
from skinrig.reporting.map_images import draw_plain_image, shrink

MAX_SHOWN = 6
"""Images per fault."""
IMAGE_WIDTH_PX, BALL_WIDTH_PX = 240, 96
MIN_SHOWN_ANGLE_DEG = 2.0
"""Between listed and estimated light, from which both are drawn."""
BALL_RADIUS = 0.92
"""Of half the image's width."""


def build_diagnosis_page(name: str, found: DiagnosedImages) -> str:
    """Return the page as HTML.

    Each image in question of a light list has a matte ball under the light that the list gives it.
    If the image itself shows another light, a second ball is lit by that.

    Parameters
    ----------
    name
        Of the session.
    found
        Diagnosis with the images.
    """
    count = len(found.names)
    faults = found.findings
    verdict = f"{format_count(len(faults), 'fault')} in {count} images"
    if not faults:
        verdict = f"no fault in {count} images"
    lead: list[page.Block] = [page.Paragraph(f"{verdict}.")]
    rows = [(one.fault, found.name_images(one), f"{one.ratio_to_limit:.1f}") for one in faults]
    if rows:
        head = ("fault", "images", "evidence over its limit")
        lead.append(page.build_table(head, rows, caption="The most certain fault comes first"))
    if found.assumed:
        lead.append(page.Bullets([f"assumed: {text}" for text in found.assumed]))
    return page.render_page(f"diagnosis of {Path(name).name}", lead, _sections(found))


def _sections(found: DiagnosedImages) -> Iterator[page.Block]:
    count = len(found.names)
    level = _find_level(found)
    for one in found.findings:
        yield page.Heading(f"{one.fault}: {_name_images(found, one)}", 2)
        yield page.Paragraph(f"{one.evidence[:1].upper()}{one.evidence[1:]}. Remedy: {one.remedy}.")
        numbers = list(one.frames) or list(range(0, count, _step(count)))
        shown = [_draw_image(found, number, level) for number in numbers[:MAX_SHOWN]]
        if found.diagnosis is None:  # side by side: each is one image
            shown = [[image for images in shown for image in images]]
        for images in shown:
            yield page.Images(images, together=True)
        left = len(numbers) - MAX_SHOWN
        if left > 0 and one.frames:
            yield page.build_note(f"{left} more images have this fault.")


def _name_images(found: DiagnosedImages, one: Finding) -> str:
    """Return the names of a finding's images; those of a light list are numbers."""
    if not one.frames:
        return "all images"
    word = "" if found.diagnosis is None else "image " if len(one.frames) == 1 else "images "
    return word + found.name_images(one)


def _find_level(found: DiagnosedImages) -> float:
    """Return the light that is shown as white; images may lie in a file."""
    step = max(1, max(found.gray[0].shape) // IMAGE_WIDTH_PX)
    return float(max(np.quantile(one[::step, ::step], 0.999) for one in found.gray)) or 1.0


def _step(count: int) -> int:
    """Return the step that spreads the shown images over all."""
    return max(1, -(-count // MAX_SHOWN))


def _draw_image(found: DiagnosedImages, number: int, level: float) -> list[page.Image]:
    """Return an image, the ball under its listed light, and one under another light it shows."""
    small = shrink(np.asarray(found.gray[number]) / level, IMAGE_WIDTH_PX)
    name = found.names[number]
    if found.diagnosis is None or found.listed is None:
        return [draw_plain_image(name, _encode(small))]
    shown = draw_plain_image(f"image {name}", _encode(small))
    listed = _encode(_shade_ball(found.listed[number]))
    which = f"of image {name}"
    images = [
        shown,
        draw_plain_image("light of the list", listed, alt=f"ball under the listed light {which}"),
    ]
    direction = found.diagnosis.directions[number]
    if direction @ found.listed[number] < np.cos(np.radians(MIN_SHOWN_ANGLE_DEG)):
        own = _encode(_shade_ball(direction))
        alt = f"ball under the light {which}"
        images.append(draw_plain_image("light in the image", own, alt=alt))
    return images


def _encode(linear: NDArray[Any]) -> NDArray[np.uint8]:
    return np.asarray(np.rint(255.0 * np.sqrt(np.clip(linear, 0.0, 1.0))), np.uint8)


def _shade_ball(direction: Float64Array) -> Float64Array:
    """Return a matte ball under a distant light, linear, 0 to 1."""
    axis = (np.arange(BALL_WIDTH_PX) + 0.5) / (
        0.5 * BALL_WIDTH_PX * BALL_RADIUS
    ) - 1.0 / BALL_RADIUS
    x, y = axis[None, :], -axis[:, None]
    rest = 1.0 - x**2 - y**2
    shading = direction[0] * x + direction[1] * y + direction[2] * np.sqrt(np.maximum(rest, 0.0))
    return np.where(rest > 0.0, np.maximum(shading, 0.02), 0.15)
