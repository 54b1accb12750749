"""Find the rig that contradicts the others.

One rig at a time is freed: its channels may have any gain. The evidence of the measurements with
that rig free, over their evidence as stated, is how much better its fault explains them. The
freed estimate states the gain, and a prediction without the rig tests it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.stats import chi2

from reconstruction.arrays import Float64Array
from reconstruction.fusion.person import PersonSkin, Regions, estimate_person
from reconstruction.fusion.signals import RigBands
from reconstruction.fusion.texels import OffsetModel

FREE_GAIN_SD: Final = (0.5, 0.3)
"""Standard deviations of the log gain of a faulty rig: common to its channels, and of each."""
FAULT_PRIOR: Final = 0.01
"""Prior probability of a fault, per rig."""
MIN_PROBABILITY: Final = 0.9
"""Least probability of a fault of any rig, at which the most probable rig is named."""
CHANNEL_NAMES: Final = ("red", "green", "blue")


@dataclass(frozen=True, slots=True, eq=False)
class RigCheck:
    """Agreement of one rig with the others.

    Attributes
    ----------
    rig
        Name.
    probability
        Posterior probability that this rig is the faulty one.
    log_gain, stderr
        (3,): gain of its channels that the others imply, and its standard error.
    p_value
        Probability of a gain at least as far from 0 if the rig is as stated.
    """

    rig: str
    probability: float
    log_gain: Float64Array
    stderr: Float64Array
    p_value: float

    @property
    def worst_channel(self) -> int:
        """Channel whose gain is most standard errors from 0."""
        return int(np.argmax(np.abs(self.log_gain / self.stderr)))

    def describe(self, quantity: str) -> str:
        """Return the contradiction in words.

        Parameters
        ----------
        quantity
            Name of the rig's quantity.

        Examples
        --------
        >>> check = RigCheck("dome", 0.99, np.array([0.08, 0, 0]), np.full(3, 0.01), 1e-9)
        >>> check.describe("R_d")
        'dome: R_d red 8 % too high, 8 standard errors, p = 1e-09, probability 0.99'
        """
        k = self.worst_channel
        percent = 100.0 * (np.exp(self.log_gain[k]) - 1.0)
        times = abs(self.log_gain[k] / self.stderr[k])
        way = "high" if percent > 0.0 else "low"
        return (
            f"{self.rig}: {quantity} {CHANNEL_NAMES[k]} {abs(percent):.0f} % too {way}, "
            f"{times:.0f} standard errors, p = {self.p_value:.0e}, probability "
            f"{self.probability:.2f}"
        )


def check_rigs(
    rigs: Sequence[RigBands], regions: Regions, errors: OffsetModel, person: PersonSkin
) -> tuple[RigCheck, ...]:
    """Return the agreement of each rig with the others.

    Parameters
    ----------
    rigs
        Rigs of the signals.
    regions
        Signals of regions of the face.
    errors
        Covariances of the signals' errors.
    person
        Estimate with all rigs as stated, from which the others start.

    Returns
    -------
    tuple of RigCheck
        In the order of the rigs; a single rig has none to contradict it.
    """
    if len(rigs) < 2:
        return ()
    found = []
    wide = FREE_GAIN_SD[0] ** 2 + FREE_GAIN_SD[1] ** 2 * np.eye(3)
    for k in range(len(rigs)):
        at = slice(3 * k, 3 * k + 3)
        free = errors.calibration.copy()
        free[at, at] += wide
        offset = errors.unexplained + free
        freed = estimate_person(rigs, regions, offset, start=person)
        own = freed.offset_columns
        # the gain's part of an offset, given the offset
        share = (free[at] - errors.calibration[at]) @ np.linalg.inv(offset)
        gain = share @ freed.offset
        left = wide - share @ offset @ share.T
        covariance = share @ freed.covariance[own, own] @ share.T + left
        # information of the measurements alone, without the prior of a free gain
        likelihood = np.linalg.inv(covariance) - np.linalg.inv(wide)
        alone = np.linalg.inv(likelihood + 1e-6 * np.eye(3))
        estimate = alone @ np.linalg.solve(covariance, gain)
        distance = float(estimate @ np.linalg.solve(alone, estimate))
        found.append(
            (freed.log_evidence, estimate, np.sqrt(np.diag(alone)), float(chi2.sf(distance, 3)))
        )
    stated = _evidence_as_stated(rigs, regions, errors, person)
    log = np.array([stated + np.log1p(-FAULT_PRIOR * len(rigs)), *(one[0] for one in found)])
    log[1:] += np.log(FAULT_PRIOR)
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    return tuple(
        RigCheck(rig.rig, float(w), gain, stderr, p)
        for rig, w, (_, gain, stderr, p) in zip(rigs, weight[1:], found, strict=True)
    )


def _evidence_as_stated(
    rigs: Sequence[RigBands], regions: Regions, errors: OffsetModel, person: PersonSkin
) -> float:
    """Return the evidence of the stated errors, after as many steps as the freed estimates."""
    return estimate_person(rigs, regions, errors.offset_covariance, start=person).log_evidence


def name_faulty_rig(checks: Sequence[RigCheck]) -> RigCheck | None:
    """Return the rig whose fault explains the measurements best; None without a clear fault.

    Its `probability` is low where the fault is certain and the rig is not, as on dark skin.

    Parameters
    ----------
    checks
        Of all rigs.

    Examples
    --------
    >>> name_faulty_rig([RigCheck("dome", 0.5, np.zeros(3), np.ones(3), 0.01)]) is None
    True
    """
    if sum(check.probability for check in checks) < MIN_PROBABILITY:
        return None
    return max(checks, key=lambda check: check.probability)
