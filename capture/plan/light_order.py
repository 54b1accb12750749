"""Order the dome's lights so that open eyes see little flicker.

All orders begin and end with the light that is dimmest at the eyes, because a piece of a plan
begins and ends dark. The best order is found by a computation of the flicker of each, see
`best_order`.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from capture.arrays import Float64Array
from capture.plan.eye_light import eye_irradiance
from capture.plan.flicker import FlickerReport, flicker_of_rows
from capture.plan.rows import LedRow
from capture.rig import Rig

N_ORDER_BANDS = 6
"""Number of bands of eye light within which the path is kept short."""


def order_by_name(rig: Rig) -> list[int]:
    """Return the lights in the rig's own order."""
    return list(range(len(rig.lights)))


def order_along_spiral(rig: Rig) -> list[int]:
    """Return the lights on a spiral around the vertical axis, from the top down."""
    place = _directions(rig)
    turn = np.arctan2(place[:, 0], place[:, 2])
    ring = np.round(place[:, 1] * 6.0)
    return [int(k) for k in np.lexsort((turn, -ring))]


def order_by_short_path(rig: Rig) -> list[int]:
    """Return a short path through all lights: nearest neighbor first, improved by 2-opt.

    It begins at the light that is dimmest at the eyes.
    """
    return _short_path(
        _directions(rig), list(range(len(rig.lights))), int(np.argmin(eye_irradiance(rig)))
    )


def _order_by_rise_and_fall(rig: Rig) -> list[int]:
    """Return the lights sorted by eye irradiance: every other one rising, the rest falling."""
    rising = np.argsort(eye_irradiance(rig), kind="stable")
    return [int(k) for k in (*rising[::2], *rising[1::2][::-1])]


def _order_by_bands(rig: Rig) -> list[int]:
    """Return the lights in bands of eye irradiance, rising and falling, each a short path."""
    place, light = _directions(rig), eye_irradiance(rig)
    rising = np.argsort(light, kind="stable")
    legs = [rising[::2], rising[1::2][::-1]]
    order: list[int] = []
    for leg in legs:
        for band in np.array_split(leg, N_ORDER_BANDS):
            rest = [int(k) for k in band]
            if rest:
                start = order[-1] if order else rest[0]
                first = rest[int(np.argmax(place[rest] @ place[start]))]
                order += _short_path(place, rest, first)
    return order


LIGHT_ORDERS: Mapping[str, Callable[[Rig], list[int]]] = MappingProxyType(
    {
        "name": order_by_name,
        "spiral": order_along_spiral,
        "nearest": order_by_short_path,
        "rise and fall": _order_by_rise_and_fall,
        "rise and fall, nearby": _order_by_bands,
    }
)


def compare_orders(rig: Rig, *, dwell_s: float) -> dict[str, FlickerReport]:
    """Return the flicker of one pass over all lights in each of the orders.

    Parameters
    ----------
    rig : Rig
    dwell_s : float
        Duration of each light, s.
    """
    weights = eye_irradiance(rig)
    overlap_s = rig.leds.overlap_s if rig.leds is not None else 0.0
    found = {}
    for name, order in LIGHT_ORDERS.items():
        rows = [LedRow((k,), 1.0, dwell_s) for k in order(rig)]
        found[name] = flicker_of_rows(rows, weights, overlap_s=overlap_s)
    return found


def best_order(rig: Rig, *, dwell_s: float) -> list[int]:
    """Return the order with the fewest flashes in any second, and of those the least flicker.

    Parameters
    ----------
    rig, dwell_s
        As in `compare_orders`.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> order = best_order(load_rig("dome"), dwell_s=1 / 12)
    >>> sorted(order) == list(range(150))
    True
    """
    found = compare_orders(rig, dwell_s=dwell_s)
    best = min(found, key=lambda name: (found[name].flashes_per_s, found[name].rms))
    return LIGHT_ORDERS[best](rig)


def _directions(rig: Rig) -> Float64Array:
    place = np.array([light.position_mm for light in rig.lights], np.float64)
    return np.asarray(place / np.linalg.norm(place, axis=1)[:, None])


def _short_path(position: Float64Array, members: list[int], first: int) -> list[int]:
    """Return a short path through ``members`` from ``first``: greedy, then 2-opt."""
    rest = [k for k in members if k != first]
    path = [first] if first in members else []
    at = first
    while rest:
        at = rest[int(np.argmax(position[rest] @ position[at]))]
        path.append(at)
        rest.remove(at)
    return _improve_2opt(position, path)


def _improve_2opt(position: Float64Array, path: list[int]) -> list[int]:
    """Reverse parts of a path while that shortens it; its first light stays."""
    way = np.array(path)
    for _ in range(20):
        changed = False
        for i in range(len(way) - 2):
            a, b = position[way[i]], position[way[i + 1]]
            ends = position[way[i + 2 :]]
            after = np.vstack([position[way[i + 3 :]], np.zeros((1, 3))])
            # the path is open: reversing up to the last light removes one edge and adds one
            old = np.linalg.norm(a - b) + np.linalg.norm(ends - after, axis=1)
            new = np.linalg.norm(ends - a, axis=1) + np.linalg.norm(b - after, axis=1)
            old[-1], new[-1] = np.linalg.norm(a - b), np.linalg.norm(ends[-1] - a)
            gain = old - new
            best = int(np.argmax(gain))
            if gain[best] > 1e-12:
                way[i + 1 : i + 3 + best] = way[i + 1 : i + 3 + best][::-1]
                changed = True
        if not changed:
            break
    return [int(k) for k in way]
