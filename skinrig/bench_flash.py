"""Benchmarks of the flash rig: rendering its two images, and inverting them to chromophores."""

from __future__ import annotations

import math

from skinrig.benchmark import Limit, Point, StageBenchmark, Timing

SPEED_UP = 8.0
NOISE_RATIO = 20.0
REFERENCE_RAYS = 144


def render(*, toy: bool) -> StageBenchmark:
    """Time both polarization images by closed forms and by Mitsuba's own polarizers."""
    from rigsim.scenes.polarizer_reference import polarizer_reference

    efforts = ((1, 2), (2, 4)) if toy else ((1, 4), (2, 16), (3, 64))
    width = 48 if toy else 256
    ours, theirs = [], []
    for subpixels, samples in efforts:
        found = polarizer_reference(width_px=width, samples=samples, subpixels=subpixels)
        ours.append(
            _point({"way": "closed form", "subpixels": subpixels}, found.closed_form_s,
                   max(found.closed_form_error.values()))
        )  # fmt: skip
        theirs.append(
            _point({"way": "mitsuba", "samples": samples}, found.mitsuba_s,
                   max(found.mitsuba_error.values()))
        )  # fmt: skip
    final = polarizer_reference(width_px=width, samples=efforts[-1][1], subpixels=1)
    limits = (
        Limit("times faster than Mitsuba's polarizers", final.speed_up, SPEED_UP, ">="),
        Limit("times less noisy than Mitsuba's polarizers", final.noise_ratio, NOISE_RATIO, ">="),
    )
    return StageBenchmark(
        "render-flash",
        "RMS error of the worse image, %",
        f"closed forms with {REFERENCE_RAYS} rays a pixel; Mitsuba's mean agrees with it but for "
        "noise. Its own error falls at least with the root of the rays from that of the most here",
        ours[-1].error * efforts[-1][0] / math.sqrt(REFERENCE_RAYS),
        (*ours, *theirs),
        limits,
        interval_of="tiles of the pictures",
        no_bands="a plastic sphere, as Mitsuba can render it too",
    )


def _point(knobs: dict[str, str | int], seconds: float, error: float) -> Point:
    timing = Timing(seconds, (seconds, seconds), seconds, 0.0)
    return Point(dict(knobs), timing, 100 * error, (100 * error, 100 * error))
