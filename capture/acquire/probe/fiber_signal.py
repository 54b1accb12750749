"""Estimate the fibers' signal during a series, and decide whether longer exposures are needed.

Frames are evaluated as they come, at the nominal positions of the spots, only to decide when to
stop. The measurement itself uses the raw frames later, with the calibrated positions of the spots.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture.arrays import BoolArray, Float64Array, UInt16Array
from capture.plan import Step
from capture.rig import Probe, View
from capture.session import Session

MIN_PEAK_LEVEL = 0.5
"""Fraction of full scale that an unsaturated spot has to reach: with steps of two thirds of a stop
the next exposure would reach 0.8 and the one after that saturate.
"""
MIN_SERIES_SNR = 100.0
"""Signal-to-noise ratio that all unsaturated exposures of a spot have to reach together: one
percent.
"""
MIN_MEASURABLE_SNR = 3.0
"""Signal-to-noise ratio below which a spot counts as not measurable, even with all exposures."""
PEAK_RANK_PX = 8
"""Rank of the pixel of a color that counts as a spot's peak: fewer may be hot."""
SPOT_HALF_SIDE_PITCH = 0.4
"""Half the side of the search square of a spot, in distances between spots."""
BACKGROUND_DISTANCE_PITCH = 0.55
"""Distance from every spot, in distances between spots, beyond which a pixel is background."""
_COLOR_INDEX = {"R": 0, "G": 1, "B": 2}
COLOR_NAMES = ("red", "green", "blue")


@dataclass(frozen=True, slots=True)
class SeriesVerdict:
    """Decision on the end of a series."""

    enough: bool
    """Whether every measurable fiber has been measured, in every color."""
    hopeless: tuple[tuple[int, int], ...]
    """Fiber and color of spots without a signal in any exposure."""
    saturated: tuple[tuple[int, int], ...]
    """Fiber and color of spots that are saturated in every exposure."""


class FiberSignal:
    """Light of each fiber in each color, exposure by exposure of one series.

    Parameters
    ----------
    probe : Probe
        Gives the nominal spots.
    view : View
        The camera, with its levels and its noise.

    Attributes
    ----------
    probe : Probe
    level : ndarray of float64, shape (F, C)
        Largest peak above black of an unsaturated exposure so far, of full scale.
    rate_per_s : ndarray of float64, shape (F, C)
        The same peak per second, of full scale; 0 without such an exposure.
    """

    def __init__(self, probe: Probe, view: View) -> None:
        self.probe = probe
        self._view = view
        spots = np.array([fiber.spot_px for fiber in probe.fibers])
        gaps = np.linalg.norm(spots[:, None] - spots[None, :], axis=-1)
        gaps[np.diag_indices(len(spots))] = math.inf
        pitch_px = float(gaps.min()) if len(spots) > 1 else float(view.height_px) / 2.0
        self._colors = _color_of(view)
        count = 1 if view.cfa == "MONO" else 3
        self._windows = [
            [
                _in_color(self._colors, _window(view, spot, SPOT_HALF_SIDE_PITCH * pitch_px), c)
                for c in range(count)
            ]
            for spot in spots
        ]
        lit = np.zeros((view.height_px, view.width_px), bool)
        for spot in spots:
            lit[_window(view, spot, BACKGROUND_DISTANCE_PITCH * pitch_px)] = True
        self._around = [np.flatnonzero(~lit & (self._colors == c)) for c in range(count)]
        shape = (len(spots), count)
        self.level = np.zeros(shape)
        self.rate_per_s = np.zeros(shape)
        self._sum = np.zeros(shape)
        self._variance = np.zeros(shape)
        self._seconds = np.zeros(shape)
        self._always_saturated = np.ones(shape, bool)
        self._looked = 0

    def add_exposure(self, image: UInt16Array, exposure_s: float) -> None:
        """Add an exposure: sensor values, shape (H, W), and its time, s."""
        view = self._view
        pixels = np.asarray(image).ravel()
        full = float(view.white_level - view.black_level)
        noise_dn2 = (view.read_noise_e / view.gain_e_per_dn) ** 2 + 1.0 / 12.0
        self._looked += 1
        for color, around in enumerate(self._around):
            zero = float(np.median(pixels[around])) if len(around) else float(view.black_level)
            for fiber, windows in enumerate(self._windows):
                values = pixels[windows[color]]
                rank = max(len(values) - PEAK_RANK_PX, 0)
                peak = float(np.partition(values, rank)[rank])
                if peak >= view.white_level:
                    continue
                self._always_saturated[fiber, color] = False
                signal = float(values.sum(dtype=np.float64)) - zero * len(values)
                dn2 = noise_dn2 * len(values) + max(signal, 0.0) / view.gain_e_per_dn
                dn2 += max(zero - view.black_level, 0.0) * len(values) / view.gain_e_per_dn
                self._sum[fiber, color] += signal
                self._variance[fiber, color] += dn2
                self._seconds[fiber, color] += exposure_s
                level = (peak - zero) / full
                if level > self.level[fiber, color]:
                    self.level[fiber, color] = level
                    self.rate_per_s[fiber, color] = level / exposure_s

    @property
    def signal_to_noise(self) -> Float64Array:
        """Signal-to-noise ratio of all unsaturated exposures per fiber and color, shape (F, C)."""
        return self._sum / np.sqrt(np.maximum(self._variance, 1e-12))

    def verdict(self, remaining_s: Sequence[float]) -> SeriesVerdict:
        """Decide whether the remaining exposures, s, can add information.

        Notes
        -----
        A fiber without a signal so far is assumed to have its estimate plus three standard errors;
        it is given up only when even that would stay in the noise.
        """
        snr = self.signal_to_noise
        measured = (self.level >= MIN_PEAK_LEVEL) & (snr >= MIN_SERIES_SNR)
        saturated = self._always_saturated & (self._looked > 0)
        seconds = np.maximum(self._seconds, 1e-12)
        error = np.sqrt(self._variance)
        rate = np.maximum((self._sum + MIN_MEASURABLE_SNR * error) / seconds, 0.0)
        more_s = float(sum(remaining_s))
        signal = np.maximum(self._sum, 0.0) + rate * more_s
        per_frame = self._variance / max(self._looked, 1)
        noise = (
            self._variance + per_frame * len(remaining_s) + rate * more_s / self._view.gain_e_per_dn
        )
        hopeless = ~measured & ~saturated & (signal < MIN_MEASURABLE_SNR * np.sqrt(noise))
        return SeriesVerdict(
            bool((measured | hopeless | saturated).all()), _pairs(hopeless), _pairs(saturated)
        )


def stop_reason(signal: FiberSignal, last: Step, remaining: Sequence[Step]) -> str:
    """Return why the remaining exposures are not needed; empty when they are.

    Parameters
    ----------
    signal : FiberSignal
        Signal of the exposures up to the last.
    last : Step
    remaining : sequence of Step
        At least one, by growing exposure.
    """
    verdict = signal.verdict([float(one.settings["exposure_s"]) for one in remaining])
    if not verdict.enough:
        return ""
    first, final = (int(remaining[k].index["bracket"]) for k in (0, -1))
    span = f"bracket {first}" if first == final else f"brackets {first}-{final}"
    what = f"all {len(signal.probe.fibers)} fibers"
    what += " that can be measured" if verdict.hopeless or verdict.saturated else ""
    at_s = float(last.settings["exposure_s"])
    reason = (
        f"{span} omitted: {what} above {100 * MIN_PEAK_LEVEL:g} % of full scale at {at_s:.2g} s"
    )
    if verdict.hopeless:
        reason += f"; {describe_fibers(verdict.hopeless, signal.probe)} would stay in the noise"
    if verdict.saturated:
        reason += (
            f"; {describe_fibers(verdict.saturated, signal.probe)} saturated in every exposure"
        )
    return reason


def describe_fibers(pairs: Sequence[tuple[int, int]], probe: Probe) -> str:
    """Return fibers and colors as words.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> describe_fibers([(26, 2), (27, 2)], load_rig("probe").probe)
    'blue of F27, F28'
    """
    parts = []
    for color, name in enumerate(COLOR_NAMES):
        fibers = [probe.fibers[fiber].name for fiber, of in pairs if of == color]
        if fibers:
            span = f"{fibers[0]} to {fibers[-1]}" if len(fibers) > 3 else ", ".join(fibers)
            parts.append(f"{name} of {span}")
    return "; ".join(parts)


def _color_of(view: View) -> NDArray[np.int8]:
    """Return the color of each pixel, 0 to 2 for R, G, B; all 0 for MONO; shape (H, W)."""
    colors = np.zeros((view.height_px, view.width_px), np.int8)
    if view.cfa != "MONO":
        for place, letter in enumerate(view.cfa):
            colors[place // 2 :: 2, place % 2 :: 2] = _COLOR_INDEX[letter]
    return colors


def _window(view: View, spot: Float64Array, half_px: float) -> tuple[slice, slice]:
    x, y = float(spot[0]), float(spot[1])
    rows = slice(max(math.ceil(y - half_px), 0), max(math.floor(y + half_px) + 1, 0))
    columns = slice(max(math.ceil(x - half_px), 0), max(math.floor(x + half_px) + 1, 0))
    return rows, columns


def _in_color(
    colors: NDArray[np.int8], window: tuple[slice, slice], color: int
) -> NDArray[np.intp]:
    """Return the flat indices of a window's pixels of one color."""
    inside = np.zeros(colors.shape, bool)
    inside[window] = colors[window] == color
    return np.flatnonzero(inside)


def _pairs(mask: BoolArray) -> tuple[tuple[int, int], ...]:
    return tuple((int(fiber), int(color)) for fiber, color in np.argwhere(mask))


MAX_UNSATURATED_LEVEL = 0.7
"""Fraction of full scale up to which a spot is safely unsaturated."""
MAX_OVEREXPOSURE = 64.0
"""Ratio of the exposures for a spot and for its neighbors: a thousandth of its light is then some
percent of full scale, and the saturated spot does not bleed yet.
"""


def usable_exposures(steps: Sequence[Step], rate_per_s: Float64Array) -> set[str]:
    """Return the ids of the useful exposures with covered heads.

    Parameters
    ----------
    steps : sequence of Step
        Steps of kind "mask".
    rate_per_s : ndarray of float64, shape (F, C)
        Peak of each fiber in each color on the same phantom, full scales per second.

    Examples
    --------
    >>> steps = [
    ...     Step(f"m{k}", "mask", {"fiber": 0, "bracket": k},
    ...          {"exposure_s": 0.01 * 4.0**k, "fiber": 0}, ("cam",)) for k in range(6)]
    >>> sorted(usable_exposures(steps, np.array([[1.0, 3.0, 0.2]])))
    ['m2', 'm5']
    """
    kept: set[str] = set()
    by_fiber: dict[int, list[Step]] = {}
    for step in steps:
        by_fiber.setdefault(int(step.settings["fiber"]), []).append(step)
    for fiber, some in by_fiber.items():
        ordered = sorted(some, key=lambda step: float(step.settings["exposure_s"]))
        seconds = np.array([float(step.settings["exposure_s"]) for step in ordered])
        brightest = float(rate_per_s[fiber].max())
        own = max(int(np.count_nonzero(seconds * brightest <= MAX_UNSATURATED_LEVEL)) - 1, 0)
        # exposures are whole milliseconds on some controllers: leave some room
        others = int(np.count_nonzero(seconds <= 1.01 * MAX_OVEREXPOSURE * seconds[own])) - 1
        kept |= {ordered[own].id, ordered[others].id}
    return kept


def find_unneeded_masks(session: Session) -> tuple[list[Step], str]:
    """Return the unneeded exposures of covered heads, and the reason.

    The choice is made once: when one of them was taken or omitted before, or when the phantom was
    not observed at its first placement, none is unneeded.
    """
    masks = [step for step in session.plan.steps if step.kind == "mask"]
    left_out = session.omitted_steps()
    phantom = session.frames("phantom", repeat=0)
    chosen = session.frames("mask") or any(step.id in left_out for step in masks)
    if not phantom or chosen or session.rig.probe is None:
        return [], ""
    camera = masks[0].cameras[0]
    signal = FiberSignal(session.rig.probe, session.rig.view(camera))
    for record in phantom:
        if record.camera == camera:
            signal.add_exposure(
                np.asarray(session.read(record).cfa), float(record.settings["exposure_s"])
            )
    kept = usable_exposures(masks, signal.rate_per_s)
    rest = [step for step in masks if step.id not in kept]
    return rest, (
        f"{len(rest)} of {len(masks)} exposures of the covered head omitted: one unsaturated "
        "exposure per fiber and one for its stray light are enough"
    )
