"""Find gradient patterns that were exchanged, are missing or inconsistent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from model.checks import Checks
from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.normal_maps import PhotometricStereoError
from reconstruction.stack_diagnosis.axis_faults import (
    describe_axes,
    find_axes,
    list_ways,
    median_curl,
)
from reconstruction.stack_diagnosis.finding import Finding
from reconstruction.stack_diagnosis.reduced_stack import SMOOTHING_PX, smooth_inside

AXIS_NAMES = ("x", "y", "z")
PATTERN_NAMES = ("full", "x", "y", "z", "-x", "-y", "-z")
MIN_LIGHT = 0.2
"""Light over that of the bright samples, below which a sample is not compared."""
SUM_QUANTILE, MAX_SUM_ERROR = 0.9, 0.02
"""Quantile of the difference of pattern and inverse to the full light, relative, and its limit: of
normals, an error of about a degree."""
MIN_REPAIR, MIN_GAIN = 0.75, 0.5
"""Part of the sums' squared error beyond noise that an exchange must remove, and that part over the
square of the noise."""
EXACT_SUM_ERROR = 1e-3
"""Sums of smaller errors are right."""
SAME_REPAIR = 1.05
"""Ratio of the sums' errors of two exchanges up to which both repair the sums alike."""
MIN_PATTERN_LIGHT = 0.1
"""Light of a pattern over the full light, below which it is empty; most have about a half."""


def find_pattern_faults(
    images: Mapping[str, FloatArray], inside: BoolArray, *, expected: Sequence[str] | None = None
) -> Iterator[Finding]:
    """Yield gradient patterns that are missing, empty, exchanged or inconsistent.

    A pattern and its inverse add up to the full light. Exchanged axes and signs keep these sums:
    then the moments are not the normals of a surface. Frames of findings count `PATTERN_NAMES`.

    Parameters
    ----------
    images
        (H, W) by the names of `PATTERN_NAMES`, linear samples at one exposure, without dark
        signal.
    inside
        (H, W), the object without saturated samples.
    expected
        Names that the series must have; None: all with an inverse pattern among `images`, else
        those without an inverse.

    Raises
    ------
    PhotometricStereoError
        For an unknown name, or images of another shape.
    """
    checks = Checks(PhotometricStereoError)
    for name, image in images.items():
        checks.require(name in PATTERN_NAMES, "images", repr(name), ", ".join(PATTERN_NAMES))
        checks.shape(name, np.asarray(image), inside.shape)
    if expected is None:
        inverse = any(name.startswith("-") for name in images)
        expected = PATTERN_NAMES if inverse else PATTERN_NAMES[:4]
    lacking = list(_find_missing(images, inside, expected))
    yield from lacking
    series = None if lacking or not inside.any() else _Series.of(images, inside)
    if series is None:
        return
    errors = series.sum_errors()
    exchange = series.find_exchange()
    if exchange is not None:
        a, b = exchange
        right = series.exchanged(a, b)
        yield Finding(
            "exchanged patterns", tuple(sorted(PATTERN_NAMES.index(name) for name in exchange)),
            f"pattern and inverse differ from the full light by {series.misfit():.1%}, and by "
            f"{right.misfit():.1%} with {a} and {b} exchanged; normals turn by "
            f"{_angle_deg(series, right.moments()):.0f} degrees",
            series.misfit(), max(right.misfit(), EXACT_SUM_ERROR),
            f"exchange the images {a} and {b}",
        )  # fmt: skip
        return
    wrong = [axis for axis, error in errors.items() if error > MAX_SUM_ERROR]
    if not wrong:
        yield from _find_turned(series)
        return
    names = [name for axis in wrong for name in (axis, f"-{axis}")]
    if len(wrong) == len(AXIS_NAMES):  # one image is in all three sums
        names = ["full"]
    worst = max(errors.values())
    yield Finding(
        "inconsistent patterns", tuple(sorted(PATTERN_NAMES.index(name) for name in names)),
        f"pattern and inverse differ from the full light by {worst:.0%}: one of "
        f"{', '.join(names)} has another exposure, or the object moved; normals err by up to "
        f"{series.error_deg(worst):.0f} degrees",
        worst, MAX_SUM_ERROR, f"take {', '.join(names)} again",
    )  # fmt: skip


def measure_sum_misfit(
    images: Mapping[str, FloatArray], inside: BoolArray, *, patterns: Sequence[str]
) -> float:
    """Return the root mean square of pattern plus inverse less the full light, relative.

    Parameters
    ----------
    images, inside
        See `find_pattern_faults`.
    patterns
        Only sums with one of these are measured; 0 where no such sum was taken.
    """
    series = _Series.of(images, inside) if inside.any() else None
    if series is None:
        return 0.0
    named = {name.lstrip("-") for name in patterns}
    used = [axis in named or "full" in named for axis in series.measured]
    residuals = series.residuals()[used]
    return float(np.sqrt(np.mean(residuals**2))) if residuals.size else 0.0


def _find_missing(
    images: Mapping[str, FloatArray], inside: BoolArray, expected: Sequence[str]
) -> Iterator[Finding]:
    """Yield patterns that are not there, and those without light."""
    for name in expected:
        if name not in images:
            yield Finding(
                "missing pattern", (PATTERN_NAMES.index(name),),
                f"the pattern {name} has no image", 1.0, 0.5, f"take the pattern {name}",
            )  # fmt: skip
    if not inside.any():
        return
    light = {name: float(np.median(np.asarray(one)[inside])) for name, one in images.items()}
    full = max([*light.values(), 1e-12])
    for name, value in light.items():
        if value < MIN_PATTERN_LIGHT * full:
            yield Finding(
                "empty pattern", (PATTERN_NAMES.index(name),),
                f"the image of {name} has {value / full:.1%} of the full light",
                1.0 - value / full, 1.0 - MIN_PATTERN_LIGHT, f"take the pattern {name} again",
            )  # fmt: skip


class _Series:
    """Smooth images of all seven patterns at the lit pixels of an object.

    Parameters
    ----------
    images
        (H, W) by name.
    inside
        (H, W).
    noise
        See `_sum_noise`.
    measured
        Axes of which both signs and the full light were taken.
    """

    def __init__(
        self,
        images: Mapping[str, Float64Array],
        inside: BoolArray,
        noise: tuple[float, float],
        measured: tuple[str, ...],
    ) -> None:
        self.images, self.inside = images, inside
        self.noise, self.measured = noise, measured
        # in consistent series four times the full light, whatever names are exchanged
        self.light = 0.25 * np.sum(list(images.values()), axis=0)
        self.lit = inside & (self.light > MIN_LIGHT * np.quantile(self.light[inside], 0.95))

    @classmethod
    def of(cls, images: Mapping[str, FloatArray], inside: BoolArray) -> _Series | None:
        """Return the series with the patterns that follow from others; None if too few do."""
        given = {name: np.asarray(one, np.float64) for name, one in images.items()}
        pairs = [axis for axis in AXIS_NAMES if axis in given and f"-{axis}" in given]
        measured = tuple(pairs) if "full" in given else ()
        noise = _sum_noise(given, inside, measured)
        smooth = {name: smooth_inside(one, inside) for name, one in given.items()}
        if "full" not in smooth and pairs:
            smooth["full"] = np.mean([smooth[a] + smooth[f"-{a}"] for a in pairs], axis=0)
        for axis in AXIS_NAMES if "full" in smooth else ():
            for name, other in ((axis, f"-{axis}"), (f"-{axis}", axis)):
                if name not in smooth and other in smooth:
                    smooth[name] = smooth["full"] - smooth[other]
        return cls(smooth, inside, noise, measured) if len(smooth) == len(PATTERN_NAMES) else None

    def exchanged(self, one: str, other: str) -> _Series:
        """Return the series with two images exchanged."""
        images = {**self.images, one: self.images[other], other: self.images[one]}
        return _Series(images, self.inside, self.noise, self.measured)

    def residuals(self) -> Float64Array:
        """Return pattern plus inverse less the full light, relative, (A, P) of lit pixels."""
        full, light = self.images["full"], self.light[self.lit]
        sums = [self.images[a] + self.images[f"-{a}"] - full for a in self.measured]
        return np.array([one[self.lit] / light for one in sums]).reshape(len(sums), light.size)

    def misfit(self) -> float:
        """Return the root mean square of the residuals."""
        residuals = self.residuals()
        return float(np.sqrt(np.mean(residuals**2))) if residuals.size else 0.0

    def sum_errors(self) -> dict[str, float]:
        """Return, by axis, a high quantile of the residuals beyond that of noise."""
        found = np.quantile(np.abs(self.residuals()), SUM_QUANTILE, axis=1)
        beyond = np.sqrt(np.maximum(found**2 - self.noise[1] ** 2, 0.0))
        return dict(zip(self.measured, beyond.tolist(), strict=True))

    def moments(self) -> Float64Array:
        """Return unit vectors along the moments of the light, (H, W, 3)."""
        return unit_vectors(self._moments(), min_length=1e-9)

    def error_deg(self, relative: float) -> float:
        """Return the angle by which an error of the light, relative, turns typical moments."""
        length = np.linalg.norm(self._moments()[self.lit], axis=-1)
        typical = float(np.median(length / self.light[self.lit]))
        return float(np.degrees(np.arctan2(relative, max(typical, 1e-9))))

    def _moments(self) -> Float64Array:
        return np.stack([self.images[a] - self.images[f"-{a}"] for a in AXIS_NAMES], axis=-1)

    def find_exchange(self) -> tuple[str, str] | None:
        """Return the two images whose exchange makes all sums right, and the moments normals."""
        now = self.misfit()
        if now < EXACT_SUM_ERROR:
            return None
        tried = {
            (one, other): self.exchanged(one, other)
            for one, other in combinations(PATTERN_NAMES, 2)
            if one.lstrip("-") != other.lstrip("-")
        }
        misfits = {names: series.misfit() for names, series in tried.items()}
        best = min(misfits.values())
        gain, noise = now**2 - best**2, self.noise[0] ** 2
        if gain < max(MIN_REPAIR * (now**2 - noise), MIN_GAIN * noise):
            return None
        alike = [names for names, misfit in misfits.items() if misfit < SAME_REPAIR * best]
        return min(alike, key=lambda names: _turn_score(tried[names]))


def _turn_score(series: _Series) -> tuple[bool, float]:
    """Return whether the moments are those of turned axes, and their curl."""
    moments = series.moments()
    turned = bool(list(find_axes(moments, series.inside)))
    return turned, median_curl(moments, series.inside)


def _sum_noise(
    images: Mapping[str, Float64Array], inside: BoolArray, measured: Sequence[str]
) -> tuple[float, float]:
    """Return the noise of a smooth sum over the full light: root mean square, and high quantile.

    The fine structure of a consistent sum's error is noise alone.
    """
    if not measured:
        return 0.0, 0.0
    full = np.maximum(smooth_inside(images["full"], inside), 1e-12)
    lit = inside & (full > MIN_LIGHT * np.quantile(full[inside], 0.95))
    errors = [images[axis] + images[f"-{axis}"] - images["full"] for axis in measured]
    fine = [((one - smooth_inside(one, inside)) / full)[lit] for one in errors]
    kept = 1.0 / (4.0 * np.pi * SMOOTHING_PX**2)  # variance of white noise after the filter
    lost = 1.0 - 1.0 / (np.pi * SMOOTHING_PX**2) + kept  # and of what it removes
    values = np.sqrt(kept / lost) * np.abs(fine)
    return float(np.sqrt(np.mean(values**2))), float(np.quantile(values, SUM_QUANTILE))


def _angle_deg(series: _Series, moments: Float64Array) -> float:
    """Return the median angle between a series' moments and others, degrees."""
    cosine = np.sum(series.moments() * moments, axis=-1)[series.lit]
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))


def _find_turned(series: _Series) -> Iterator[Finding]:
    """Yield the axes whose patterns are exchanged with each other or with their inverse."""
    moments = series.moments()
    for one in find_axes(moments, series.inside):
        read = one.axes or AXIS_NAMES
        ways = list_ways(read, series.inside)
        pairs = [zip(AXIS_NAMES, way, strict=True) for way in ways]
        axes = sorted({axis for pair in pairs for axis, term in pair if term != axis})
        names = [name for axis in axes for name in (axis, f"-{axis}")]
        order = [AXIS_NAMES.index(term.lstrip("-")) for term in read]
        signs = [-1.0 if term.startswith("-") else 1.0 for term in read]
        turned = moments[..., order] * signs
        yield Finding(
            "exchanged patterns", tuple(sorted(PATTERN_NAMES.index(name) for name in names)),
            f"{one.evidence}; normals turn by {_angle_deg(series, turned):.0f} degrees",
            one.measured, one.limit,
            f"read the patterns (x, y, z), and likewise their inverses, as {describe_axes(ways)}",
        )  # fmt: skip
