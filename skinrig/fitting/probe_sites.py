"""Sites of a fiber probe on a scanned face, and interpolation of sigma_tr between them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from model.skin import SkinAppearance, SkinMap
from reconstruction.pipeline.probe.stages import CHANNEL_NAMES, SUBSURFACE_FILE
from reconstruction.subsurface import probe_sites, translucency
from reconstruction.subsurface.translucency import TranslucencyMap, TranslucencyPrior
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import BoolArray, Float32Array, Float64Array

SITE_OFFSETS_FROM_NOSE_MM: Final[Mapping[str, tuple[float, float]]] = {
    "forehead": (0.0, 76.0),
    "cheek": (-48.0, 0.0),
    "cheek left": (-48.0, 0.0),
    "cheek right": (48.0, 0.0),
    "chin": (0.0, -72.0),
}
"""Sites of the simulator's mean head: mm to the right of and above the tip of the nose.

In front view; left and right are those of the image.
"""
GRID_SIDE: Final = 256
"""Side of the grid on which translucency is interpolated before it is resampled to the texture."""
MAX_SITE_DISTANCE_MM: Final = 15.0
"""Maximum distance of a site from the nearest texel of the scan."""
SITE_RADIUS_MM: Final = 8.0
"""Radius around a probe's site whose skin is that of the probe."""
HEAD_RADIUS_RANGE_MM: Final = (40.0, 200.0)
"""Range of fitted girth radii that count as a head; other shapes are measured along x and y."""


class ProbeSiteError(ValueError):
    """Probe measurements without a position on the face."""


@dataclass(frozen=True, slots=True)
class ProbeSite:
    """One measured site of the probe.

    Attributes
    ----------
    name
    sigma_tr_per_mm, stderr_per_mm
        Value and standard uncertainty per channel; NaN and infinity without a valid fit.
    texel
        Row and column in the face's texture.
    position_mm
        Position in the rig frame, mm.
    """

    name: str
    sigma_tr_per_mm: tuple[float, ...]
    stderr_per_mm: tuple[float, ...]
    texel: tuple[int, int]
    position_mm: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class PlacedTranslucency:
    """A probe's diffuse mean free path, interpolated over a face's texture.

    Attributes
    ----------
    map
        Diffuse mean free path 1/sigma_tr, mm, with standard uncertainties.
    sites
        Sites that were used.
    left_out
        Omitted sites, or channels of sites, with reasons.
    conflicts
        Sites and channels with inconsistent repeats, with their deviation.
    assumed
        Assumptions about the positions of sites.
    p_value
        Per channel: p value of the face's deviation from the population mean.
    """

    map: SkinMap
    sites: tuple[ProbeSite, ...]
    left_out: tuple[tuple[str, str], ...]
    conflicts: tuple[tuple[str, str], ...]
    assumed: tuple[str, ...]
    p_value: tuple[float, ...]


def map_translucency(
    probe: SkinAppearance, position: SkinMap, *, landmarks: Path | None = None
) -> PlacedTranslucency:
    """Interpolate a probe's measurements over the texture of a face.

    Distances are measured along the face's girth and height from the positions of texels, so that
    they are independent of the texture's layout.

    Parameters
    ----------
    probe
        Maps of the probe with the file `subsurface.json`.
    position
        Map `position` of the face, mm, in the rig frame.
    landmarks
        Table ``name,x,y`` in texels of that map. Other sites are located by a mean face's distances
        from the tip of the nose.

    Raises
    ------
    ProbeSiteError
        If no measured site has a known position on the scan.
    reconstruction.subsurface.translucency.TranslucencyError
        If no measurement is usable, or the table is invalid.
    """
    placed = place_sites(probe, position, landmarks=landmarks)
    found = interpolate_sites(placed.sites, position)
    return replace(found, left_out=(*placed.left_out, *found.left_out), assumed=placed.assumed)


@dataclass(frozen=True, slots=True)
class PlacedSites:
    """Sites of a probe on a face, with omitted ones and assumptions as in `PlacedTranslucency`."""

    sites: tuple[ProbeSite, ...]
    left_out: tuple[tuple[str, str], ...]
    assumed: tuple[str, ...]


def place_sites(
    probe: SkinAppearance, position: SkinMap, *, landmarks: Path | None = None
) -> PlacedSites:
    """Place a probe's sites on the texture of a face.

    Parameters
    ----------
    probe, position, landmarks
        See `map_translucency`.

    Raises
    ------
    ProbeSiteError
        If no measured site has a known position on the scan.
    """
    measured = _measured(probe)
    height, width = position.values.shape[:2]
    known = intersect_valid(position)
    if not known.any():
        raise ProbeSiteError(
            "position: got no valid texel, expected those of a face; give another appearance"
        )
    given: dict[str, tuple[float, float]] = {}
    if landmarks is not None:
        given = probe_sites.read_landmarks(landmarks, texture_px=(height, width))
    at_mm = position.values.astype(np.float64)
    sites: list[ProbeSite] = []
    left_out: list[tuple[str, str]] = []
    guessed: list[str] = []
    for name, (sigma_tr, stderr) in measured.items():
        if name in given:
            wanted = _given_position(given[name], at_mm)
        elif name in SITE_OFFSETS_FROM_NOSE_MM:
            wanted, off_mm = _mean_site_position(name, at_mm[known])
            if off_mm > MAX_SITE_DISTANCE_MM:
                left_out.append((name, f"the scan ends {off_mm:.0f} mm short of the site"))
                continue
            guessed.append(name)
        else:
            left_out.append(
                (name, "unknown position on the face; list it in the table of --landmarks")
            )
            continue
        away = np.where(known, np.linalg.norm(at_mm - wanted, axis=-1), np.inf)
        texel = np.unravel_index(np.argmin(away), away.shape)
        if away[texel] > MAX_SITE_DISTANCE_MM:
            left_out.append((name, f"the scan ends {away[texel]:.0f} mm short of the site"))
            continue
        found = at_mm[texel]
        sites.append(
            ProbeSite(name, sigma_tr, stderr, (int(texel[0]), int(texel[1])), tuple(found.tolist()))
        )
    if not sites:
        why = "; ".join(f"{name}: {reason}" for name, reason in left_out)
        raise ProbeSiteError(f"sites: got none on the face, expected one or more: {why}")
    how = "of the probe are placed as on a mean face, relative to the tip of the nose"
    assumed = (f"{', '.join(guessed)} {how}",) if guessed else ()
    return PlacedSites(tuple(sites), tuple(left_out), assumed)


def locate_site(
    name: str, position: SkinMap, *, landmarks: Path | None = None
) -> tuple[Float64Array, bool]:
    """Return the point of a site on a face, mm, and whether it is that of a mean face.

    Parameters
    ----------
    name
        Name of the site.
    position, landmarks
        See `map_translucency`.

    Raises
    ------
    ProbeSiteError
        If the site is unknown, or not on the scan.
    """
    at_mm, known = position.values.astype(np.float64), intersect_valid(position)
    given: dict[str, tuple[float, float]] = {}
    if landmarks is not None:
        height, width = at_mm.shape[:2]
        given = probe_sites.read_landmarks(landmarks, texture_px=(height, width))
    if name in given:
        wanted = _given_position(given[name], at_mm)
        off_mm = float(np.linalg.norm(at_mm[known] - wanted, axis=-1).min()) if known.any() else 1e9
    elif name in SITE_OFFSETS_FROM_NOSE_MM and known.any():
        wanted, off_mm = _mean_site_position(name, at_mm[known])
    else:
        raise ProbeSiteError(
            f"site: got {name!r}, expected {', '.join(SITE_OFFSETS_FROM_NOSE_MM)} or one of the "
            "table of --sites; rename the folder or add it to the table"
        )
    if off_mm > MAX_SITE_DISTANCE_MM:
        raise ProbeSiteError(f"{name}: the scan ends {off_mm:.0f} mm short of the site")
    return wanted, name not in given


def _given_position(place: tuple[float, float], at_mm: Float64Array) -> Float64Array:
    """Return the point at a place of a texture, in fractions of its width and height."""
    height, width = at_mm.shape[:2]
    column, row = place[0] * width, (1.0 - place[1]) * height
    return at_mm[min(int(row), height - 1), min(int(column), width - 1)]


def interpolate_sites(
    sites: Sequence[ProbeSite],
    position: SkinMap,
    *,
    prior: TranslucencyPrior | None = None,
    expected_mm: Float32Array | None = None,
) -> PlacedTranslucency:
    """Interpolate the measurements of sites over the texture of a face.

    Parameters
    ----------
    sites
        Sites on the texture.
    position
        Map `position` of the face, mm, in the rig frame.
    prior
        Distribution of log(1/sigma_tr), or with `expected_mm` of its deviation from that; None:
        table 2 of Weyrich et al. 2005.
    expected_mm
        (H, W, 3): expected 1/sigma_tr, above 0; the measured deviations from it are interpolated.

    Raises
    ------
    reconstruction.subsurface.translucency.TranslucencyError
        If no measurement is usable.
    """
    known = intersect_valid(position)
    at_mm = position.values.astype(np.float64)
    if expected_mm is not None:
        sites = [
            _relative_to(site, np.median(expected_mm[known & _is_near(site, at_mm)], axis=0))
            for site in sites
        ]
    chart = _Chart.of(at_mm[known], sites)
    found_map = _interpolated(chart, sites, prior)
    spread = chart.interpolate(found_map, at_mm)
    if expected_mm is not None:
        spread *= np.tile(expected_mm, 2)
    valid = known & found_map.valid.all(axis=(0, 1)).all()
    return PlacedTranslucency(
        map=SkinMap(
            spread[..., :3],
            "mm",
            spread[..., 3:],
            valid,
            "1/sigma_tr of red, green and blue light, kriging between measured sites",
        ),
        sites=tuple(sites),
        left_out=found_map.omitted,
        conflicts=found_map.conflicts,
        assumed=(),
        p_value=tuple(float(p) for p in found_map.p_value),
    )


def _is_near(site: ProbeSite, at_mm: Float64Array) -> BoolArray:
    """Return the texels within `SITE_RADIUS_MM` of a site, at least its own, (H, W)."""
    near = np.linalg.norm(at_mm - np.array(site.position_mm), axis=-1) < SITE_RADIUS_MM
    near[site.texel] = True
    return np.asarray(near)


def _relative_to(site: ProbeSite, expected_mm: Float32Array) -> ProbeSite:
    """Return a site with sigma_tr over the expected one."""
    scale = expected_mm.astype(np.float64)
    parts = np.array(site.sigma_tr_per_mm) * scale, np.array(site.stderr_per_mm) * scale
    value, stderr = (tuple(part.tolist()) for part in parts)
    return replace(site, sigma_tr_per_mm=value, stderr_per_mm=stderr)


def _measured(probe: SkinAppearance) -> dict[str, tuple[tuple[float, ...], tuple[float, ...]]]:
    """Return sigma_tr and its standard uncertainty per channel, keyed by site."""
    if SUBSURFACE_FILE not in probe.files:
        raise ProbeSiteError(
            f"probe: {SUBSURFACE_FILE} is missing; reconstruct a session of the fiber probe with "
            "`skinrig reconstruct --maps subsurface`"
        )
    try:
        rows = json.loads(probe.files[SUBSURFACE_FILE])["sites"]
        names = list(dict.fromkeys(str(row["site"]) for row in rows))
        found: dict[str, dict[str, tuple[float, float]]] = {name: {} for name in names}
        for row in rows:
            sigma_tr, stderr = row["sigma_tr_per_mm"], row["sigma_tr_stderr"]
            found[str(row["site"])][str(row["channel"])] = (
                math.nan if sigma_tr is None else float(sigma_tr),
                math.inf if stderr is None else float(stderr),
            )
    except (ValueError, KeyError, TypeError) as error:
        raise ProbeSiteError(
            f"{SUBSURFACE_FILE}: not readable: {error!r}; reconstruct the session again"
        ) from error
    none = (math.nan, math.inf)
    return {
        name: (
            tuple(by.get(c, none)[0] for c in CHANNEL_NAMES),
            tuple(by.get(c, none)[1] for c in CHANNEL_NAMES),
        )
        for name, by in found.items()
    }


def _mean_site_position(name: str, points_mm: Float64Array) -> tuple[Float64Array, float]:
    """Return the point at a mean face's offset from the tip of the nose, and its distance, mm.

    The tip of the nose is the foremost point. Offsets are in front view; of several points on one
    line of sight, the foremost counts.
    """
    nose = points_mm[np.argmax(points_mm[:, 2])]
    across, up = SITE_OFFSETS_FROM_NOSE_MM[name]
    away = np.hypot(points_mm[:, 0] - nose[0] - across, points_mm[:, 1] - nose[1] - up)
    near = away < away.min() + 1.0
    return np.asarray(points_mm[near][np.argmax(points_mm[near, 2])]), float(away.min())


@dataclass(frozen=True, slots=True)
class _Chart:
    """Coordinates over a face along its girth and its height, mm, from a corner."""

    axis_mm: tuple[float, float] | None
    """x and z of the vertical axis; None: the surface is not round and x replaces the girth."""
    radius_mm: float
    corner_mm: Float64Array
    size_mm: Float64Array

    @staticmethod
    def of(points_mm: Float64Array, sites: Sequence[ProbeSite]) -> _Chart:
        """Fit the axis of a face: the center of the circle nearest to its girth."""
        middle = np.median([site.position_mm[1] for site in sites])
        girth = points_mm[np.abs(points_mm[:, 1] - middle) < 60.0]
        axis, radius = None, 1.0
        if len(girth) >= 3:
            # a circle about (a, b) is linear in a, b, c: x^2 + z^2 = 2 a x + 2 b z + c with
            # c = r^2 - a^2 - b^2, so that least squares need no start value (Kasa 1976)
            columns = np.column_stack([2.0 * girth[:, 0], 2.0 * girth[:, 2], np.ones(len(girth))])
            (a, b, c), _, rank, _ = np.linalg.lstsq(
                columns, (girth[:, [0, 2]] ** 2).sum(axis=1), rcond=None
            )
            square = c + a**2 + b**2
            if rank == 3 and HEAD_RADIUS_RANGE_MM[0] ** 2 < square < HEAD_RADIUS_RANGE_MM[1] ** 2:
                axis, radius = (float(a), float(b)), math.sqrt(square)
        free = _Chart(axis, radius, np.zeros(2), np.ones(2))
        over = free.coordinates(points_mm)
        low, high = over.min(axis=0), over.max(axis=0)
        return _Chart(axis, radius, low, np.maximum(high - low, 1.0))

    def coordinates(self, points_mm: Float64Array) -> Float64Array:
        """Return coordinates along the girth and upwards, (..., 2), mm from the corner."""
        along = points_mm[..., 0]
        if self.axis_mm is not None:
            a, b = self.axis_mm
            along = self.radius_mm * np.arctan2(points_mm[..., 0] - a, points_mm[..., 2] - b)
        return np.asarray(np.stack([along, points_mm[..., 1]], axis=-1) - self.corner_mm)

    def interpolate(self, found: TranslucencyMap, points_mm: Float64Array) -> Float32Array:
        """Interpolate values and standard uncertainties linearly at texel positions, (H, W, 6)."""
        both = np.concatenate([found.values, found.stderr], axis=-1)
        share = self.coordinates(points_mm) / self.size_mm
        x = np.clip(share[..., 0] * GRID_SIDE - 0.5, 0.0, GRID_SIDE - 1.0)
        y = np.clip((1.0 - share[..., 1]) * GRID_SIDE - 0.5, 0.0, GRID_SIDE - 1.0)
        i, j = (np.minimum(at.astype(np.intp), GRID_SIDE - 2) for at in (y, x))
        p, q = (y - i)[..., None], (x - j)[..., None]
        upper = both[i, j] * (1.0 - q) + both[i, j + 1] * q
        lower = both[i + 1, j] * (1.0 - q) + both[i + 1, j + 1] * q
        return np.asarray(upper * (1.0 - p) + lower * p, np.float32)


def _interpolated(
    chart: _Chart, sites: Sequence[ProbeSite], prior: TranslucencyPrior | None
) -> TranslucencyMap:
    at = chart.coordinates(np.array([site.position_mm for site in sites])) / chart.size_mm
    sigma_tr = np.array([site.sigma_tr_per_mm for site in sites])
    good = np.isfinite(sigma_tr)
    return translucency.interpolate(
        np.clip(at, 0.0, 1.0),
        np.where(good, sigma_tr, 1.0),
        np.array([site.stderr_per_mm for site in sites]),
        (GRID_SIDE, GRID_SIDE),
        valid=good,
        names=[site.name for site in sites],
        prior=prior,
        texture_mm=(float(chart.size_mm[0]), float(chart.size_mm[1])),
    )
