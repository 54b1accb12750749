"""The page of `skinrig diagnose --out`: each fault with the images that show it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import Float64Array
from reconstruction.pipeline.light_stack import DiagnosedStack
from reconstruction.stack_diagnosis.finding import Finding
from skinrig.reporting import page
from skinrig.reporting.map_images import draw_plain_image, shrink

MAX_SHOWN = 6
"""Images per fault."""
IMAGE_WIDTH_PX, BALL_WIDTH_PX = 240, 96
MIN_SHOWN_ANGLE_DEG = 2.0
"""Between listed and estimated light, from which both are drawn."""
BALL_RADIUS = 0.92
"""Of half the image's width."""


def build_diagnosis_page(name: str, found: DiagnosedStack) -> str:
    """Return the page as HTML.

    Each image in question has a matte ball under the light that the list gives it. If the image
    itself shows another light, a second ball is lit by that.

    Parameters
    ----------
    name
        Of the session.
    found
        Diagnosis with the images.
    """
    findings = found.diagnosis.findings
    count = len(found.gray)
    verdict = (
        f"{len(findings)} faults in {count} images" if findings else f"no fault in {count} images"
    )
    lead: list[page.Block] = [page.Paragraph(f"{verdict}.")]
    rows = [
        (one.fault, _list_images(one), one.ratio_to_limit, one.evidence, one.remedy)
        for one in findings
    ]
    if rows:
        head = ("fault", "images", "over its limit", "evidence", "remedy")
        lead.append(page.build_table(head, rows, caption="The most certain fault comes first"))
    return page.render_page(f"diagnosis of {Path(name).name}", lead, _sections(found))


def _list_images(one: Finding) -> str:
    return ", ".join(str(number + 1) for number in one.frames) or "all"


def _sections(found: DiagnosedStack) -> Iterator[page.Block]:
    step = max(1, max(found.gray.shape[1:]) // IMAGE_WIDTH_PX)  # the stack may lie in a file
    level = float(np.quantile(found.gray[:, ::step, ::step], 0.999)) or 1.0
    for one in found.diagnosis.findings:
        yield page.Heading(one.fault, 2)
        yield page.Paragraph(f"{one.evidence}. Remedy: {one.remedy}.")
        numbers = list(one.frames) or list(range(0, len(found.gray), _step(len(found.gray))))
        for number in numbers[:MAX_SHOWN]:
            yield page.Images(_draw_image(found, number, level))
        left = len(numbers) - MAX_SHOWN
        if left > 0 and one.frames:
            yield page.build_note(f"{left} more images have this fault.")


def _step(count: int) -> int:
    """Return the step that spreads the shown images over all."""
    return max(1, -(-count // MAX_SHOWN))


def _draw_image(found: DiagnosedStack, number: int, level: float) -> list[page.Image]:
    """Return an image, the ball under its listed light, and one under another light it shows."""
    small = shrink(np.asarray(found.gray[number]) / level, IMAGE_WIDTH_PX)
    shown = draw_plain_image(f"image {number + 1}", _encode(small))
    listed = _encode(_shade_ball(found.listed[number]))
    which = f"of image {number + 1}"
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
