"""Decide whether two sessions show the same person in the same state.

Each map is reduced to the median differences over nine regions of the registered skin, or over the
sites of a fiber probe. Their errors have three parts:

- noise, independent between pixels;
- an error common to one region, such as that of light and registration;
- an error common to the whole face, such as that of a white reference.

The last two are fractions of the stated standard uncertainties, measured between simulated sessions
(`skinrig/data/session_errors.csv`, `skinrig bench --stage repeatability`). Those of optical maps
are smaller than 1: the unknown optics of a person's skin are the same in both sessions, if the
camera and the light are. Otherwise both fractions are at least 1. Each map has two tests: one of
its mean over the whole skin, and a chi-squared test of all regions. A Sidak correction over tests
and maps gives the verdict at a stated false-alarm rate.
"""

import csv
import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Final

import numpy as np
from scipy import stats

from model.skin import SkinAppearance
from skinrig.arrays import Float64Array, Int64Array
from skinrig.evaluating.session_maps import ComparedQuantity, SessionMaps, read_session_maps
from skinrig.evaluating.session_registration import Pairing, pair_samples
from skinrig.reporting.map_names import map_title

FALSE_ALARM_RATE: Final = 0.01
"""Probability of a found difference between two sessions of one person in one state."""
REGIONS_PER_SIDE: Final = 3
REGION_NAMES: Final = tuple(
    f"{row} {column}"
    for row in ("upper", "middle", "lower")
    for column in ("left", "center", "right")
)
"""Regions by row and column, as in the image."""
MIN_REGION_SAMPLES: Final = 16
CORRELATED_SAMPLES: Final = 4.0
"""Samples with common noise: demosaicing and interpolation correlate neighbors."""
SHAPE_QUANTITY: Final = "shape"
"""Name of the deformation between two sessions."""
WHOLE_SKIN: Final = "the whole skin"
WHOLE_PREFERENCE: Final = 1.25
"""Factor by which a region must be more significant than the whole skin to be named."""
MAX_NAMED_MAPS: Final = 4
"""Maps that the verdict names."""


class SessionError(ValueError):
    """Appearances whose sessions cannot be compared."""


@dataclass(frozen=True, slots=True)
class QuantityAgreement:
    """Comparison of one quantity.

    Attributes
    ----------
    name
        Name of the map, with its channel.
    unit
        "%" of the mean of both sessions, "degrees", "px" or "mm" of a deformation, or "1" for the
        ratio of mean squares of a relief, less 1.
    samples
        Number of common samples.
    rms, stated
        Root mean square of the difference per sample, and of its stated standard uncertainty, both
        in the map's unit; rad for directions.
    place
        Region with the most significant change.
    change, sigmas
        Change there in `unit`, B minus A, and in standard uncertainties between sessions.
    p_value
        Probability of larger differences without a change: of the whole skin, or of all regions
        together.
    changed
        Whether it is below the limit of one quantity.
    """

    name: str
    unit: str
    samples: int
    rms: float
    stated: float
    place: str
    change: float
    sigmas: float
    p_value: float
    changed: bool

    @property
    def ratio(self) -> float:
        """Root mean square difference over the stated one; NaN without errors."""
        return self.rms / self.stated if self.stated > 0.0 else math.nan

    def __str__(self) -> str:
        """Return the change in words, such as "melanin +12 % at upper left, 5.0 sigma"."""
        size = f"{self.change:+.3g}" + ("" if self.unit == "1" else f" {self.unit}")
        where = f"over {self.place}" if self.place == WHOLE_SKIN else f"at {self.place}"
        stem, comma, channel = self.name.partition(",")
        title = (stem if stem == SHAPE_QUANTITY else map_title(stem)) + comma + channel
        return f"{title} {size} {where}, {abs(self.sigmas):.3g} standard uncertainties"


@dataclass(frozen=True, slots=True)
class SessionAgreement:
    """Verdict on two sessions.

    Attributes
    ----------
    quantities
        Compared quantities, the least likely differences first.
    false_alarm
        Probability of a difference in any quantity between sessions of one person in one state.
    registered
        How samples were paired, in words.
    shared_optics
        Whether camera and light are the same, so that errors of a person's optics cancel.
    """

    quantities: tuple[QuantityAgreement, ...]
    false_alarm: float
    registered: str
    shared_optics: bool

    @property
    def changed(self) -> tuple[QuantityAgreement, ...]:
        """Quantities with a found change."""
        return tuple(one for one in self.quantities if one.changed)

    @property
    def same(self) -> bool:
        """Whether no quantity has changed."""
        return not self.changed

    def document(self) -> dict[str, Any]:
        """Return the verdict as JSON values."""
        return {"same": self.same, "verdict": str(self), **dataclasses.asdict(self)}

    def __str__(self) -> str:
        """Return the verdict in a sentence."""
        rate = f"{100 * self.false_alarm:.3g} % false alarms"
        if self.same:
            count = len(self.quantities)
            return f"Same person, same state: yes, by {count} quantities ({rate})."
        names = "; ".join(str(one) for one in self.changed[:MAX_NAMED_MAPS])
        more = len(self.changed) - MAX_NAMED_MAPS
        rest = f"; {more} more" if more > 0 else ""
        return f"Same person, same state: no, by {names}{rest} ({rate})."


def compare_sessions(
    a: SkinAppearance, b: SkinAppearance, *, false_alarm: float = FALSE_ALARM_RATE
) -> SessionAgreement:
    """Compare the maps of two sessions of one kind of rig.

    Parameters
    ----------
    a, b
        Maps with standard uncertainties.
    false_alarm
        Probability of a found difference between sessions of one person in one state, 0 to 1.

    Raises
    ------
    SessionError
        When the two have no quantity in common, or no common skin.
    """
    if not 0.0 < false_alarm < 1.0:
        raise SessionError(f"false_alarm: got {false_alarm}, expected more than 0 and less than 1")
    one, other = read_session_maps(a), read_session_maps(b)
    if one is None or other is None or one.kind != other.kind:
        kinds = " and ".join("none" if x is None else f"maps of a {x.kind}" for x in (one, other))
        raise SessionError(f"sessions: got {kinds}, expected maps of one kind of rig; name two")
    names = [name for name in one.quantities if name in other.quantities]
    pairing = pair_samples(one, other)
    shared = a.parameters.get("color_table") == b.parameters.get("color_table")
    count = len(names) + (pairing.shape is not None)
    limit = 1.0 - (1.0 - false_alarm) ** (1.0 / max(count, 1))
    found = []
    for name in names:
        compared = _Compared.of(name, one, pairing, shared)
        if compared is not None:
            found.append(compared.summarize(limit))
    if pairing.shape is not None and (shape := _Compared.of_shape(one, pairing)) is not None:
        found.append(shape.summarize(limit))
    if not found:
        raise SessionError(
            f"sessions: got no common skin of {', '.join(names) or 'any map'}, expected at least "
            f"{MIN_REGION_SAMPLES} common samples; reconstruct the same maps of both"
        )
    order = sorted(found, key=lambda q: (q.p_value, -abs(q.sigmas)))
    return SessionAgreement(tuple(order), false_alarm, pairing.how, shared)


@cache
def _session_errors() -> dict[str, tuple[float, float]]:
    """Return errors common to the face and to a region, by quantity, in stated uncertainties."""
    text = resources.files("skinrig").joinpath("data/session_errors.csv").read_text()
    rows = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    return {row["quantity"]: (float(row["face"]), float(row["region"])) for row in rows}


def session_error_name(quantity: ComparedQuantity) -> str:
    """Return the row of `session_errors.csv` for a quantity."""
    stem = quantity.name.split(",")[0]
    if quantity.kind == "structure":
        return "height" if stem.startswith("height") else "patch normals"
    return stem


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    """Differences of one quantity over regions.

    Attributes
    ----------
    change, noise, stated
        (K, C): differences of means, their standard uncertainty by noise, and the mean stated one.
    names
        Names of the K regions.
    """

    name: str
    unit: str
    samples: int
    rms: float
    rms_stated: float
    names: tuple[str, ...]
    change: Float64Array
    noise: Float64Array
    stated: Float64Array
    fractions: tuple[float, float]

    @staticmethod
    def of(name: str, maps: SessionMaps, pairing: Pairing, shared: bool) -> "_Compared | None":
        a, b = maps.quantities[name], pairing.moved.quantities[name]
        rows, others = pairing.rows, pairing.others
        good = a.valid[rows] & b.valid[others]
        rows, others = rows[good], others[good]
        regions = list(_regions(maps, rows))
        if not regions:
            return None
        va, vb = a.values[rows], b.values[others]
        if a.kind == "direction":
            vb = vb @ pairing.rotation.T
            difference = np.stack([vb[:, k] - va[:, k] for k in (0, 1)], axis=1)
        else:
            difference = vb - va
        width = difference.shape[1]
        stated = np.hypot(a.stderr[rows], b.stderr[others])[:, :width]
        noise = np.hypot(a.noise[rows], b.noise[others])[:, :width]
        change, errors, means = [], [], []
        for _, inside in regions:
            count = max(inside.size / (1.0 if maps.kind == "sites" else CORRELATED_SAMPLES), 1.0)
            # medians: samples at oblique rims and at shadow edges are outliers
            square = np.sqrt(np.pi / 2.0 * np.mean(noise[inside] ** 2, axis=0) / count)
            size = np.median(stated[inside], axis=0)
            got = np.median(difference[inside], axis=0)
            if a.kind == "level":
                level = 0.5 * np.abs(np.median(va[inside] + vb[inside], axis=0))
                got, square, size = got / level, square / level, size / level
            elif a.kind == "structure":
                ratio = np.mean(difference[inside] ** 2) / np.mean(stated[inside] ** 2)
                got = np.array([ratio - 1.0])
                square, size = np.array([math.sqrt(2.0 / count)]), np.ones(1)
            change.append(got)
            errors.append(square)
            means.append(size)
        known = _session_errors().get(session_error_name(a), (1.0, 1.0))
        return _Compared(
            name=a.name,
            unit={"level": "%", "direction": "degrees", "structure": "1"}[a.kind],
            samples=len(rows),
            rms=float(np.sqrt(np.mean(difference**2))),
            rms_stated=float(np.sqrt(np.mean(stated**2))),
            names=tuple(name for name, _ in regions),
            change=np.array(change),
            noise=np.array(errors),
            stated=np.array(means),
            fractions=known if shared else (max(known[0], 1.0), max(known[1], 1.0)),
        )

    @staticmethod
    def of_shape(maps: SessionMaps, pairing: Pairing) -> "_Compared | None":
        """Return the deformation between two sessions."""
        shape = pairing.shape
        if shape is None:
            return None
        regions = list(_regions(maps, pairing.rows))
        if not regions:
            return None
        stated = np.broadcast_to(shape.stderr[:, None], shape.moved.shape)
        size = np.array([np.sqrt(np.mean(stated[i] ** 2, axis=0)) for _, i in regions])
        return _Compared(
            name=SHAPE_QUANTITY,
            unit=shape.unit,
            samples=len(pairing.rows),
            rms=float(np.sqrt(np.mean(shape.moved**2))),
            rms_stated=float(np.sqrt(np.mean(stated**2))),
            names=tuple(name for name, _ in regions),
            change=np.array([shape.moved[i].mean(axis=0) for _, i in regions]),
            noise=np.zeros_like(size),
            stated=size,
            fractions=_session_errors()[f"{SHAPE_QUANTITY}, {shape.unit}"],
        )

    def summarize(self, limit: float) -> QuantityAgreement:
        """Return the test of all regions against a p-value limit."""
        face, region = self.fractions
        chi_square, degrees, whole = 0.0, 0, []
        best = (0.0, 0.0, WHOLE_SKIN)
        for k in range(self.change.shape[1]):
            change, common = self.change[:, k], face * self.stated[:, k]
            own = self.noise[:, k] ** 2 + (region * self.stated[:, k]) ** 2
            covariance = np.diag(np.maximum(own, 1e-24)) + np.outer(common, common)
            chi_square += float(change @ np.linalg.solve(covariance, change))
            degrees += len(change)
            mean = np.full(len(change), 1.0 / len(change))
            tests = [(WHOLE_SKIN, mean), *zip(self.names, np.eye(len(change)), strict=True)]
            for name, weight in tests:
                got = float(weight @ change)
                sigmas = got / math.sqrt(float(weight @ covariance @ weight))
                if name == WHOLE_SKIN:
                    whole.append(abs(sigmas))
                least = abs(best[1]) * (WHOLE_PREFERENCE if best[2] == WHOLE_SKIN else 1.0)
                if abs(sigmas) > least:
                    best = (got, sigmas, name)
        # a change of the whole skin, and any pattern of changes: Sidak over the tests of both
        likely = min(2.0 * stats.norm.sf(max(whole)), stats.chi2.sf(chi_square, degrees))
        p_value = float(1.0 - (1.0 - likely) ** (1 + len(whole)))
        scale = {"%": 100.0, "degrees": math.degrees(1.0)}.get(self.unit, 1.0)
        return QuantityAgreement(
            self.name,
            self.unit,
            self.samples,
            self.rms,
            self.rms_stated,
            best[2],
            scale * best[0],
            best[1],
            p_value,
            p_value < limit,
        )


def _regions(maps: SessionMaps, rows: Int64Array) -> Iterator[tuple[str, Int64Array]]:
    """Yield the regions with enough samples, and the indices of their samples into `rows`."""
    if maps.kind == "sites":
        yield from ((maps.sites[row], np.array([k])) for k, row in enumerate(rows))
        return
    if maps.kind == "surface":
        across, down = maps.position_mm[rows, 0], -maps.position_mm[rows, 1]
    else:
        down, across = (part.astype(np.float64) for part in np.divmod(rows, maps.shape[1]))
    if not len(rows):
        return
    cells = []
    for place in (down, across):
        low, high = float(place.min()), float(place.max())
        part = (place - low) / max(high - low, 1e-12) * REGIONS_PER_SIDE
        cells.append(np.clip(part.astype(np.int64), 0, REGIONS_PER_SIDE - 1))
    index = cells[0] * REGIONS_PER_SIDE + cells[1]
    for k, name in enumerate(REGION_NAMES):
        inside = np.flatnonzero(index == k)
        if len(inside) >= MIN_REGION_SAMPLES:
            yield name, inside


def region_changes(
    a: SkinAppearance, b: SkinAppearance
) -> dict[str, tuple[Float64Array, Float64Array, Float64Array]]:
    """Return the differences of regions, to set the errors between sessions.

    Parameters
    ----------
    a, b
        Maps of two sessions of one person in one state.

    Returns
    -------
    dict
        By quantity: change, noise and stated standard uncertainty, each (K, C).
    """
    one, other = read_session_maps(a), read_session_maps(b)
    if one is None or other is None:
        return {}
    pairing = pair_samples(one, other)
    found = {}
    for name in one.quantities.keys() & other.quantities.keys():
        got = _Compared.of(name, one, pairing, True)
        if got is not None:
            found[name] = (got.change, got.noise, got.stated)
    if (shape := _Compared.of_shape(one, pairing)) is not None:
        found[SHAPE_QUANTITY] = (shape.change, shape.noise, shape.stated)
    return found
