"""Benchmark of the dome's renderer: all lights of a view from one set of rays, and Mitsuba's."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from capture.rig import load_rig
from rigsim.render.scene_radiance import point_rig
from rigsim.scenes.dome.reference import PlainScene, compare, plain_face
from skinrig.benchmarks.resampling import drawn_again, tiled_rms
from skinrig.benchmarks.results import BandError, Timing
from skinrig.benchmarks.stage import Stage

if TYPE_CHECKING:
    from rigsim.scenes.dome.reference import Way

WHY_NO_MEMORY = "three ways take turns in one process, each with its scene held"


def render(stage: Stage) -> None:
    """Time one view of the dome, light after light, in three ways.

    The full size is that of the rig's cameras. Mitsuba's samples are stratified, which makes them
    as even as our regular rays: with its default, independent ones it is twice as noisy.
    """
    width, lights = (64, 2) if stage.toy else (1300, 4)
    efforts = (1, 2) if stage.toy else (1, 3, 2)
    fine = 4 if stage.toy else 6
    for subpixels in efforts:
        found = compare(
            width_px=width,
            lights=1 if subpixels != efforts[-1] else lights,
            subpixels=subpixels,
            fine=fine,
            rounds=2 if subpixels == efforts[-1] else 1,
        )
        for name in ("ours", "path", "direct"):
            way = getattr(found, name)
            timing = Timing.single(way.seconds, no_memory=WHY_NO_MEMORY)
            stage.add({"way": name, "rays": subpixels**2}, timing, _error(way))
    stage.on_each_skin(lambda band: _on_skin(band.preset, 64 if stage.toy else 650, fine))
    stage.limits["over_path"] = found.speed_up(found.path)
    stage.limits["over_direct"] = found.speed_up(found.direct)
    finest = stage.at(way="ours", rays=max(efforts) ** 2)
    stage.reference_error = finest.error * max(efforts) / fine
    stage.words["rays"] = fine**2


def _error(way: Way) -> BandError:
    """Return a way's error in percent, with its interval over tiles."""
    error, tiles = 100.0 * way.error, way.squared_by_tile
    low, high = error * np.array(
        drawn_again(tiles, lambda again, axis: np.sqrt(again.mean(axis=axis) / tiles.mean()))
    )
    return BandError(error, (min(float(low), error), max(float(high), error)))


def _on_skin(preset: str, width: int, fine: int) -> BandError:
    """Return our error with 4 rays a pixel on a face of a preset's melanin, one light, %."""
    rig = point_rig(load_rig("dome").resized(width).subset(views=["C02"]))
    face = plain_face(preset, size=128 if width < 128 else 512)
    light = len(rig.lights) // 2
    found, true = (
        PlainScene(rig, face, subpixels=n).radiance("C02", [light])[0] for n in (2, fine)
    )
    shown = true.mean(axis=-1) > 0.0
    return tiled_rms((found - true) * (100.0 / float(true[shown].mean())), shown)
