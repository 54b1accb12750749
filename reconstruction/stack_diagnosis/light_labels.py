"""Find how a list of lights is wrong: its order, exchanged lights, single wrong directions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.stack_diagnosis.finding import Finding
from reconstruction.stack_diagnosis.shading_space import (
    Agreement,
    ShadingSpace,
    compare_directions,
    compare_residuals,
)

MIN_AGREEING_FRACTION = 0.6
"""Of the lights as listed; below it other orders are tried."""
MIN_RESIDUAL_RATIO = 3.0
"""Residual under the listed light over that under the estimated one that shows a wrong light."""
GOOD_SCORE_DEG = 1.5
"""Mean angle up to which no other order is tried: some orders are nearly rotations of the list."""
SWAPPED_RATIO = 1.5
"""Angle of a light from its row over that from the row of another, if the two are exchanged."""
SCORE_RATIO = 0.5
"""Ratio of mean angles below which another order is taken."""


def find_order(
    space: ShadingSpace,
    samples: Float64Array,
    usable: BoolArray,
    directions: Float64Array,
    rng: np.random.Generator,
) -> tuple[NDArray[np.intp], Agreement, list[Finding]]:
    """Return the row of the list for each image, how it agrees, and what is wrong with the list.

    Parameters
    ----------
    space
        Of the samples.
    samples, usable
        (N, P), and which of them are usable.
    directions
        (N, 3), unit vectors as listed.
    rng
        Draws sets of lights.
    """
    lights = space.lights
    order = np.arange(len(lights), dtype=np.intp)
    agreement = compare_directions(lights, directions, rng)
    findings: list[Finding] = []
    if agreement.score_deg > GOOD_SCORE_DEG:
        listed_deg = agreement.score_deg
        name, found, closer = _best_order(lights, directions, rng, (order, agreement))
        # two exchanged lights are named by themselves
        if name and np.count_nonzero(found != order) > 2:
            order, agreement = found, closer
            evidence = (
                f"lights are {listed_deg:.1f} degrees from the list on average, "
                f"{agreement.score_deg:.1f} if the list is {name}"
            )
            findings.append(
                Finding(
                    "order of lights", (), evidence,
                    listed_deg / max(agreement.score_deg, 0.1), 1.0 / SCORE_RATIO,
                    f"sort the list: it is {name}", order=tuple(int(k) for k in order),
                )
            )  # fmt: skip
    if agreement.agrees.mean() < MIN_AGREEING_FRACTION:
        evidence = f"no order tried explains the shading; best: {agreement.agrees.mean():.0%}"
        findings.append(
            Finding(
                "foreign list", (), evidence, 1.0 - float(agreement.agrees.mean()),
                1.0 - MIN_AGREEING_FRACTION, "find the list that was made with these images",
            )
        )  # fmt: skip
        return order, agreement, findings
    ratio = compare_residuals(space, samples, usable, directions[order], agreement)
    wrong = np.flatnonzero(~agreement.agrees & (ratio > MIN_RESIDUAL_RATIO))
    findings += _explain_wrong(wrong.tolist(), order, agreement, directions)
    for one in findings:
        if one.order is not None:
            order = np.array(one.order, np.intp)
    return order, agreement, findings


def _best_order(
    lights: Float64Array,
    directions: Float64Array,
    rng: np.random.Generator,
    start: tuple[NDArray[np.intp], Agreement],
) -> tuple[str, NDArray[np.intp], Agreement]:
    """Return the order that agrees clearly better than the listed one, with its name."""
    name, (order, agreement) = "", start
    least = SCORE_RATIO * agreement.score_deg
    for other, tried in list_orders(len(lights)).items():
        found = compare_directions(lights, directions[tried], rng, draws=200)
        if found.score_deg < least and found.agrees.mean() >= MIN_AGREEING_FRACTION:
            name, order, agreement, least = other, tried, found, found.score_deg
    return name, order, agreement


def list_orders(count: int) -> dict[str, NDArray[np.intp]]:
    """Return orders for which lists are commonly mistaken: the list's row for each image."""
    index = np.arange(count, dtype=np.intp)
    text = np.array(sorted(range(count), key=str), np.intp)
    numbers = np.empty_like(text)
    numbers[text] = index
    from_one = np.array(sorted(range(count), key=lambda k: str(k + 1)), np.intp)
    orders = {
        "reversed": index[::-1].copy(),
        "sorted as text": text,
        "sorted as numbers": numbers,
        "sorted as text from 1": from_one,
        "every second one first": np.concatenate([index[::2], index[1::2]]),
    }
    for step in range(1, count):
        signed = step if step <= count // 2 else step - count
        orders[f"shifted by {signed}"] = np.roll(index, -step)
    for gap in range(1, count - 1):
        after = np.concatenate([index[:gap], index[gap + 1 :], index[gap : gap + 1]])
        orders[f"one too long from row {gap + 1} on"] = after
    return {name: one for name, one in orders.items() if not np.array_equal(one, index)}


def _explain_wrong(
    wrong: list[int], order: NDArray[np.intp], agreement: Agreement, directions: Float64Array
) -> list[Finding]:
    """Explain the lights that disagree: exchanged in pairs, repeated, or in another direction."""
    cosine = np.clip(agreement.directions @ directions.T, -1.0, 1.0)
    apart = np.degrees(np.arccos(cosine))  # of image i from row j
    own = agreement.angle_deg
    mutual = [
        (float(apart[i, order[j]] + apart[j, order[i]]), min(i, j), max(i, j))
        for i in wrong
        for j in range(len(order))
        if i != j
        and max(apart[i, order[j]], apart[j, order[i]]) < agreement.limit_deg
        and own[j] > SWAPPED_RATIO * max(apart[j, order[i]], 0.5 * agreement.limit_deg)
    ]
    findings: list[Finding] = []
    left = set(wrong)
    free = set(range(len(order)))
    for _, i, j in sorted(mutual):
        if not {i, j} <= free:
            continue
        left -= {i, j}
        free -= {i, j}
        evidence = (
            f"image {i + 1} is lit from light {order[j] + 1}, "
            f"image {j + 1} from light {order[i] + 1}"
        )
        order = order.copy()
        order[[i, j]] = order[[j, i]]
        findings.append(
            Finding(
                "swapped lights", (i, j), evidence,
                float(agreement.angle_deg[[i, j]].max()), agreement.limit_deg,
                "exchange the two images or the two rows of the list",
                order=tuple(int(k) for k in order),
            )
        )  # fmt: skip
    for i in sorted(left):
        x, y, z = (f"{value:.2f}" for value in agreement.directions[i])
        where = f"from ({x}, {y}, {z})"
        row = int(apart[i].argmin())
        if row != order[i] and apart[i, row] < agreement.limit_deg:
            where += f", where light {row + 1} of the list is"
        findings.append(
            Finding(
                "wrong light", (i,), f"image {i + 1} is lit {where}, "
                f"{agreement.angle_deg[i]:.0f} degrees from its row",
                float(agreement.angle_deg[i]), agreement.limit_deg,
                "correct the row of the list, or leave the image out",
            )
        )  # fmt: skip
    return findings
