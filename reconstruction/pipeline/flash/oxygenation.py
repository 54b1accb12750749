"""Map of oxygenation of the flash rig, from colors and frames under narrow-band LEDs."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final, Protocol

import numpy as np
from scipy import ndimage

from capture.calibration.color.white import WhiteReference
from capture.session import FrameRecord, Session
from model.skin import MAP_UNITS, SkinMap
from reconstruction.arrays import BoolArray, Float32Array, Float64Array
from reconstruction.chromophores.shading_prior import face_prior
from reconstruction.narrow_bands.band_fit import OXYGENATION_SD, fit_bands, signal_table
from reconstruction.pipeline.graph import PipelineStage
from reconstruction.pipeline.masked_map import masked_map

WINDOW_MM: Final = 3.0
"""Side of the window over which signals are averaged: light spreads in skin by 1 to 3 mm."""
SUPERPIXELS_PER_PX: Final = 0.5
MAP_NAMES: Final = ("oxygenation", "oxygenation_noise_stderr")


class LinearLight(Protocol):
    """Linear light with its variance, (H, W, 3), and the mask of valid pixels, (H, W)."""

    @property
    def rgb(self) -> Float32Array:
        """Fraction of full scale at power 1."""

    @property
    def variance(self) -> Float32Array:
        """Variance of `rgb`."""

    @property
    def valid(self) -> BoolArray:
        """Pixels without saturation."""


FrameReader = Callable[[Sequence[FrameRecord]], LinearLight]


def oxygenation_stage(
    stage: Callable[..., PipelineStage],
    session: Session,
    open_reader: Callable[[], FrameReader],
    white: WhiteReference | None,
    *,
    camera: str,
    illuminant: str,
    which: Mapping[str, Any],
) -> PipelineStage:
    """Return the stage that makes the maps of oxygenation from the map `diffuse`.

    Parameters
    ----------
    stage
        Factory of stages, see `graph.make_stage_factory`.
    session
        The session; its frames under LEDs have ``light`` in their index.
    open_reader
        Returns a function that averages frames and subtracts the dark frames.
    white
        White reference with its LEDs, or None.
    camera, illuminant
        Names of spectra.
    which
        Index values of the frames to use, such as the state.
    """
    kept = {name: value for name, value in which.items() if value is not None}
    records = [r for r in session.frames("subject", **kept) if "light" in r.index]
    leds = sorted({str(record.index["light"]) for record in records})
    references = {} if white is None else white.leds
    refused = ""
    if not leds:
        refused = (
            "oxygenation: got a session without frames under narrow-band LEDs, whose colors do not "
            "determine it; capture with --bands, such as --bands 450,580,600"
        )
    elif not set(leds) <= set(references):
        refused = (
            f"oxygenation: got frames under {', '.join(leds)} without their white references; "
            "capture target white with the same --bands, then `skinrig calibrate white`"
        )
    run = partial(_maps, session, records, leds, open_reader, references, camera, illuminant)
    named = {"camera": camera, "illuminant": illuminant, "leds": leds, **which}
    return stage("oxygenation", "diffuse", " ".join(MAP_NAMES), run, refused, **named)


def _maps(
    session: Session,
    records: Sequence[FrameRecord],
    leds: Sequence[str],
    open_reader: Callable[[], FrameReader],
    references: Mapping[str, WhiteReference],
    camera: str,
    illuminant: str,
    diffuse: SkinMap,
) -> Mapping[str, SkinMap]:
    stderr = np.zeros_like(diffuse.values) if diffuse.stderr is None else diffuse.stderr
    read = open_reader()
    signals, variances, valid = [diffuse.values], [np.square(stderr)], diffuse.mask
    for led in leds:
        light = read([record for record in records if record.index["light"] == led])
        # the crossed analyzer transmits half of the diffuse light
        gray, noise = (
            part.sum(axis=-1, keepdims=True) for part in (2.0 * light.rgb, 4.0 * light.variance)
        )
        value, value_variance, good = references[led].balance(gray, variance=noise)
        signals.append(value)
        variances.append(value_variance)
        valid = valid & good & light.valid
    view = session.rig.view(records[0].camera)
    width_px = WINDOW_MM / (view.field_mm[0] / view.width_px) * SUPERPIXELS_PER_PX
    side = 2 * int(width_px // 2) + 1
    signal, variance = average_window(
        np.concatenate(signals, axis=-1), np.concatenate(variances, axis=-1), valid, side
    )
    valid = valid & (signal > 0).all(axis=-1)
    prior = face_prior()
    table = signal_table(camera, illuminant, tuple(leds))
    found = fit_bands(signal[valid], variance[valid], table, log_shading=(prior.mean, prior.sd))
    good = np.zeros(valid.shape, bool)
    good[valid] = found.valid

    def on_image(values: Float64Array) -> Float32Array:
        image = np.zeros(valid.shape, np.float32)
        image[valid] = values
        return image

    unit = MAP_UNITS["oxygenation"]
    why = (
        f"mean over {WINDOW_MM:g} mm, with the prior's standard deviation of {OXYGENATION_SD:.3f}; "
        "invalid where that has more information than the signals"
    )
    alone = "standard error by noise alone, by which repeats of a session differ"
    return {
        "oxygenation": masked_map(
            on_image(found.oxygenation), on_image(found.stderr[:, 2]), good, unit, why
        ),
        "oxygenation_noise_stderr": masked_map(
            on_image(found.noise_stderr[:, 2]), None, good, unit, alone
        ),
    }


def average_window(
    values: Float32Array, variance: Float32Array, valid: BoolArray, side: int
) -> tuple[Float64Array, Float64Array]:
    """Average values over the valid pixels of a square window.

    Parameters
    ----------
    values, variance
        (H, W, C), with their noise variance.
    valid
        (H, W).
    side
        Side of the window, px, odd.

    Returns
    -------
    mean, variance : ndarray of float64
        (H, W, C): mean and its noise variance; 0 where not `valid`.

    Examples
    --------
    >>> ones = np.ones((1, 3, 1), np.float32)
    >>> mean, variance = average_window(ones, ones, np.array([[True, True, False]]), 3)
    >>> mean[..., 0].tolist(), variance[..., 0].tolist()
    ([[1.0, 1.0, 0.0]], [[0.5, 0.5, 0.0]])
    """

    def total(image: np.ndarray) -> Float64Array:
        inside = np.where(valid[..., None], image, 0.0).astype(np.float64)
        size = (side, side, 1)
        return np.asarray(side**2 * ndimage.uniform_filter(inside, size, mode="constant"))

    count = np.maximum(total(np.ones((*valid.shape, 1))), 1.0)
    keep = valid[..., None]
    mean, noise = total(values) / count, total(variance) / count**2
    return np.where(keep, mean, 0.0), np.where(keep, np.maximum(noise, 0.0), 0.0)
