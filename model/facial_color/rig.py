"""Hemoglobin rig: blood of a face in any blend of expressions (Jimenez 2010, eqs. 1 to 6).

A state is a scale and a bias of the neutral map, smooth enough for a coarse grid; a blend is an
affine combination of states. Both expressions and global states (exercise, alcohol) are states.

References
----------
Jimenez et al. 2010, A Practical Appearance Model for Dynamic Facial Color, ACM Trans. Graph.
29(6), 141. doi:10.1145/1866158.1866167
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import BoolArray, Float64Array, FloatArray
from model.checks import Checks
from model.facial_color import basis, disc_statistics
from model.facial_color.deviation_ratio import ROUNDING_ERROR
from model.facial_color.state_maps import NEUTRAL, FacialColorError, RigMaps
from model.tissue_optics.layers import C_HD_MAX

STORED_SIZE: Final = 256
"""Cells per side of the stored scale and bias maps (Jimenez2010, section 6)."""
HEMOGLOBIN_LIMITS: Final = (0.0, C_HD_MAX)
"""Range of blood volume fractions, Jimenez2010, Table 1."""
GLOBAL_GAINS: Final[Mapping[str, float]] = MappingProxyType({"anger": 1.27, "fear": 0.81})
"""Factors of all blood at full emotion, in addition to the expression (Jimenez2010, section 7)."""

_SUM_ERROR = 1e-6


def local_statistics(
    h: ArrayLike, radius_px: float, *, valid: BoolArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return mean and deviation of a map in a disc about each pixel, eq. (1).

    Parameters
    ----------
    h
        Shape (..., H, W); values that are not finite count as missing.
    radius_px
        Radius of the disc, px, >= 0, need not be whole.
    valid
        Shape of the map, or one that broadcasts to it, bool: pixels that count; None: all that
        are finite.

    Returns
    -------
    mu, sigma : ndarray
        Shape of the map, over the valid pixels of each disc within the map; NaN where it contains
        none. float32 for float32 and float16 maps, float64 otherwise.
        `model.facial_color.disc_statistics.measure` returns the pixel counts too, and float64.

    Raises
    ------
    model.facial_color.disc_statistics.DiscStatisticsError
        For a map, mask or radius of a wrong shape or range.

    Examples
    --------
    >>> mu, sigma = local_statistics(np.tile([0.1, 0.3], (4, 2)), 10.0)
    >>> round(float(mu[0, 0]), 6), round(float(sigma[0, 0]), 6)
    (0.2, 0.1)
    """
    image = np.asarray(h)
    kind = np.float32 if image.dtype in (np.float16, np.float32) else np.float64
    found = disc_statistics.measure(image, radius_px, valid=valid)
    return found.mean.astype(kind, copy=False), found.deviation.astype(kind, copy=False)


@dataclass(frozen=True, slots=True, eq=False)
class HemoglobinBlend:
    """Blood of a face in a blend of states, arrays (H, W)."""

    hemoglobin: FloatArray
    """Volume fraction within the limits; NaN outside ``valid``."""
    valid: BoolArray
    """Where the neutral map and all states of the blend are known."""
    clipped_fraction: float
    """Fraction of the valid pixels that were outside the limits and clamped."""
    stderr: FloatArray
    """Standard error of neutral map, scales and biases, and the model error of eq. (6). Given
    errors of the maps count as common to a disc, which is the worst case for a bias. The error
    common to all blood is added."""


@dataclass(frozen=True, slots=True, eq=False)
class HemoglobinRig(RigMaps):
    """Blood of one face in any affine blend of its measured states."""

    @classmethod
    def from_maps(
        cls,
        neutral: ArrayLike,
        states: Mapping[str, ArrayLike],
        *,
        radius_px: float,
        valid: BoolArray | Mapping[str, BoolArray] | None = None,
        stderr: Mapping[str, ArrayLike] | None = None,
        global_states: Iterable[str] | None = None,
        stored_size: int | None = STORED_SIZE,
        common_log_sd: float = 0.0,
    ) -> HemoglobinRig:
        """Fit a rig to measured maps.

        Parameters
        ----------
        neutral
            Volume fraction of blood in the neutral state, (H, W).
        states
            The other states by name, (H, W) each, aligned to the neutral map within a few pixels
            (little against the radius). A name is lower case, e.g. one of
            `rigsim.subject.perfusion.STATE_NAMES`.
        radius_px
            Radius of the disc of eq. (1), px.
        valid
            (H, W) bool for all maps, or by name, including "neutral"; values that are not finite
            are never valid.
        stderr
            Standard errors by name, (H, W); float32's rounding for a map without one.
        global_states
            States of the whole body; None: the given ones of `GLOBAL_STATES`.
        stored_size
            Cells per side of the stored maps, at most those of the map; None: as the map.
        common_log_sd
            Standard error of log blood that all pixels and states have in common, >= 0; `stderr`
            is without it.

        Returns
        -------
        HemoglobinRig

        Raises
        ------
        FacialColorError, model.facial_color.disc_statistics.DiscStatisticsError
            For maps, masks, names or a radius of a wrong shape or range.

        Notes
        -----
        A state's statistics are compared with those of the neutral map over the same pixels. The
        scale is sigma_i/sigma_n under the prior of `model.facial_color.deviation_ratio`, which
        bounds it where the neutral map is constant.
        """
        maps = basis.fit_rig_maps(
            neutral,
            states,
            radius_px=radius_px,
            valid=valid,
            stderr=stderr or {},
            global_states=global_states,
            stored_size=stored_size,
        )
        return cls._from_rig_maps(replace(maps, common_log_sd=common_log_sd))

    @classmethod
    def _from_rig_maps(cls, maps: RigMaps) -> HemoglobinRig:
        return cls(**{field.name: getattr(maps, field.name) for field in fields(RigMaps)})

    @property
    def base(self) -> Float64Array:
        """Return H_0 of eq. (4), (H, W): neutral map less its stored mean; NaN outside ``valid``.

        H_0 is relative to the stored mean, not the exact one, so the neutral state is reproduced
        exactly: the storage error of mu_n stays in H_0.
        """
        (mean,) = self.cells.refine(self.neutral_mean, valid=self.neutral_mean_valid)
        return np.where(self.valid, self.neutral - mean, np.nan)

    @property
    def scale(self) -> Mapping[str, Float64Array]:
        """Return stored scale maps by name, (h, w); 1 for the neutral state."""
        return {NEUTRAL: np.ones_like(self.neutral_mean)} | {
            name: state.scale for name, state in self.states.items()
        }

    @property
    def bias(self) -> Mapping[str, Float64Array]:
        """Return stored bias maps by name, (h, w), volume fraction."""
        return {NEUTRAL: self.neutral_mean} | {
            name: state.bias for name, state in self.states.items()
        }

    def storage_error(self) -> Mapping[str, tuple[float, float]]:
        """Return each state's error of coarse storage: rms and largest, volume fraction."""
        return {n: (s.storage_rms, s.storage_largest) for n, s in self.states.items()}

    def check_weights(
        self, weights: Mapping[str, float], *, normalize: bool = False
    ) -> dict[str, float]:
        """Return checked weights that sum to one.

        Raises
        ------
        FacialColorError
            For an unknown state, a weight that is not finite, or another sum.
        """
        names = (NEUTRAL, *self.states)
        for name, weight in weights.items():
            if name not in names:
                near = difflib.get_close_matches(name, names, 1)
                hint = f"; did you mean {near[0]!r}?" if near else ""
                raise FacialColorError(
                    f"weights: got state {name!r}, expected one of {', '.join(names)}{hint}"
                )
            Checks(FacialColorError).within(f"weights: {name}", weight)
        total = math.fsum(weights.values())
        if normalize:
            if abs(total) < _SUM_ERROR:
                raise FacialColorError(
                    f"weights: their sum is {total:g}: normalize cannot divide by it"
                )
            return {name: weight / total for name, weight in weights.items()}
        if abs(total - 1.0) > _SUM_ERROR:
            rest = float(weights.get(NEUTRAL, 0.0)) + 1.0 - total
            raise FacialColorError(
                f"weights: got a sum of {total:g}, expected 1; {NEUTRAL}={rest:.6g} (got "
                f"{weights.get(NEUTRAL, 0.0):g}) makes it so, or normalize=True "
                "(`--normalize`) divides by the sum"
            )
        return {name: float(weight) for name, weight in weights.items()}

    def blend(self, weights: Mapping[str, float], *, normalize: bool = False) -> FloatArray:
        """Return the map of `evaluate`, (H, W), without its mask and errors."""
        return self.evaluate(weights, normalize=normalize).hemoglobin

    def evaluate(
        self,
        weights: Mapping[str, float],
        *,
        normalize: bool = False,
        gains: Mapping[str, float] | None = None,
        gain: float = 1.0,
        limits: tuple[float, float] = HEMOGLOBIN_LIMITS,
    ) -> HemoglobinBlend:
        """Blend states by eq. (6), with mask and errors.

        Parameters
        ----------
        weights
            By name, including "neutral", summing to one; they may be negative or above one.
            Several states at full strength are ``{"smile": 1, "exercise": 1, "neutral": -1}``.
        normalize
            Divide the weights by their sum instead of raising an error.
        gains
            Factors of all blood that go with states, e.g. `GLOBAL_GAINS`; each acts in
            proportion to its state's weight: the whole factor is 1 + sum of w_i (gain_i - 1).
        gain
            Additional factor of all blood.
        limits
            Smallest and largest volume fraction.

        Returns
        -------
        HemoglobinBlend

        Raises
        ------
        FacialColorError
            For weights that sum to something else, an unknown state, or a negative factor.
        """
        used = {
            n: w for n, w in self.check_weights(weights, normalize=normalize).items() if w != 0.0
        }
        factor = gain * (
            1.0 + math.fsum(w * ((gains or {}).get(n, 1.0) - 1.0) for n, w in used.items())
        )
        if not (math.isfinite(factor) and factor >= 0.0):
            raise FacialColorError(f"gains: the factor of all blood is {factor:g}, expected >= 0")
        if not limits[0] < limits[1]:
            raise FacialColorError(f"limits: got {limits}, expected the smaller one first")
        few = self.neutral_mean_valid.copy()
        scale, bias = np.zeros_like(self.neutral_mean), np.zeros_like(self.neutral_mean)
        scale_variance, bias_variance, misfit = (np.zeros_like(scale) for _ in range(3))
        for name, w in used.items():
            if name == NEUTRAL:
                scale += w
                bias += w * self.neutral_mean
                continue
            state = self.states[name]
            few &= state.valid
            scale += w * state.scale
            bias += w * state.bias
            scale_variance += (w * state.scale_stderr) ** 2
            bias_variance += w * w * (state.bias_stderr**2 + state.storage_rms**2)
            misfit += (w * state.misfit) ** 2
        up = self.cells.refine(
            scale, bias, self.neutral_mean, scale_variance, bias_variance, misfit, valid=few
        )
        base = self.neutral - up[2]  # eq. (4), with the stored mean
        blood = factor * (up[1] + base * up[0])  # eq. (6)
        # the measured misfit includes the maps' noise
        pixel = np.maximum(up[5], (up[0] * self.neutral_stderr) ** 2)
        pixel += (ROUNDING_ERROR * self.neutral) ** 2
        error = factor * np.sqrt(pixel + up[4] + base * base * up[3])
        error = np.hypot(error, self.common_log_sd * blood)
        valid = self.valid & np.isfinite(blood)
        outside = valid & ((blood < limits[0]) | (blood > limits[1]))
        kind = self.neutral.dtype
        return HemoglobinBlend(
            np.where(valid, np.clip(blood, *limits), np.nan).astype(kind),
            valid,
            int(outside.sum()) / max(int(valid.sum()), 1),
            np.where(valid, error, np.nan).astype(kind),
        )

    def transfer_to(
        self,
        neutral: ArrayLike,
        *,
        valid: BoolArray | None = None,
        stderr: ArrayLike | None = None,
        transfer: Literal["ratio", "difference", "absolute"] = "ratio",
    ) -> HemoglobinRig:
        """Return this rig's states for another neutral map, measured or painted.

        Parameters
        ----------
        neutral
            (H', W'), volume fraction, in the same map space (both unwrapped alike); of any size.
        valid
            (H', W') bool; a state is valid where both maps are.
        stderr
            Standard error of the new map.
        transfer
            Preserved quantity of a bias. "ratio": mu_i/mu_n, since a vessel that dilates changes
            mean and contrast by a factor, and so does the scale; "difference": mu_i - mu_n;
            "absolute": mu_i unchanged (the paper's stored maps), which gives the other face this
            one's mean blood in each state.

        Returns
        -------
        HemoglobinRig
            The radius scales with the size of the map.

        Raises
        ------
        FacialColorError
            For a map or mask of a wrong shape.
        """
        return self._from_rig_maps(
            basis.transfer_rig_maps(self, neutral, valid=valid, stderr=stderr, transfer=transfer)
        )
