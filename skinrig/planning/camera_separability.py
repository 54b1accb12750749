"""Bounds of melanin and blood for a camera under a light, before a session.

The bound of each chromophore's relative error is that of the linearized color (Cramer-Rao), with
noise and the covariance by unknown optics (`model.tissue_optics.uncertainty`), at known shading.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from model import color_table
from model.checks import Checks
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.arrays import Float64Array
from reconstruction.chromophores.pixel_checks import ChromophoreError

TYPICAL_CAMERA: Final = "Nikon 5100 (NPL)"
TYPICAL_SKIN: Final = {
    "I": (0.010, 0.008),
    "II": (0.018, 0.010),
    "III": (0.028, 0.010),
    "IV": (0.040, 0.011),
    "V": (0.067, 0.011),
    "VI": (0.160, 0.020),
}
"""Melanin and blood volume fractions by type: medians of fits to measured spectra (ISSA)."""
LOSS_RATIO: Final = 1.5
"""Ratio of an error to a typical camera's from which the camera loses a chromophore."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraSeparability:
    """Bounds of relative errors by skin type, with those of a typical camera."""

    camera: str
    illuminant: str
    melanin: Float64Array
    """(6,) relative standard error of melanin, types I to VI."""
    blood: Float64Array
    """(6,) relative standard error of blood."""
    typical_melanin: Float64Array
    """(6,) the same of `TYPICAL_CAMERA` under the same light."""
    typical_blood: Float64Array
    condition: float
    """Condition number of type III's color over its errors, by relative melanin and blood."""

    @property
    def loses(self) -> tuple[str, ...]:
        """Chromophores whose error is `LOSS_RATIO` times the typical one's, in half of types."""
        ratios = {
            "melanin": self.melanin / self.typical_melanin,
            "blood": self.blood / self.typical_blood,
        }
        return tuple(name for name, ratio in ratios.items() if np.median(ratio) > LOSS_RATIO)

    def summary(self) -> str:
        """Return the loss in one line of plain numbers, for skin of type III.

        Examples
        --------
        >>> assess_camera("Sigma SDMerill (NPL)", "D65").summary()[:42]
        'Sigma SDMerill (NPL) under D65: melanin +-'
        """
        k = list(TYPICAL_SKIN).index("III")
        line = (
            f"{self.camera} under {self.illuminant}: melanin +-{100 * self.melanin[k]:.0f} %, "
            f"blood +-{100 * self.blood[k]:.0f} % (type III, known light); a typical camera has "
            f"+-{100 * self.typical_melanin[k]:.0f} % and +-{100 * self.typical_blood[k]:.0f} %"
        )
        if self.loses:
            line += f"; it hardly separates {' and '.join(self.loses)}"
        return line


def assess_camera(
    camera: str, illuminant: str, *, relative_noise: float = 0.005
) -> CameraSeparability:
    """Return the bounds of melanin's and blood's errors for a camera under a light.

    Parameters
    ----------
    camera, illuminant
        Names known to `model.spectra`.
    relative_noise
        Relative noise of each channel, above 0.

    Raises
    ------
    SpectrumNameError
        For an unknown camera or light.
    ChromophoreError
        For noise that is not above 0.

    Examples
    --------
    >>> assess_camera("Nikon 5100 (NPL)", "D55").loses
    ()
    """
    Checks(ChromophoreError).within("relative_noise", relative_noise, "(0, 1]")
    own, condition = _bounds(camera, illuminant, relative_noise)
    typical, _ = _bounds(TYPICAL_CAMERA, illuminant, relative_noise)
    return CameraSeparability(camera, illuminant, own[0], own[1], typical[0], typical[1], condition)


def _bounds(camera: str, illuminant: str, relative_noise: float) -> tuple[Float64Array, float]:
    """Return relative errors of melanin and blood by type, (2, 6), and type III's condition."""
    table = color_table.build(camera, illuminant, size=64, anisotropy=ANISOTROPY_SKIN)
    c_m, c_hd = np.array(list(TYPICAL_SKIN.values())).T
    relative = table.jacobian(c_m, c_hd) / table.lookup(c_m, c_hd)[..., None]
    relative = relative * np.stack([c_m, c_hd], axis=-1)[:, None, :]
    covariance = table.log_covariance(c_m, c_hd) + relative_noise**2 * np.eye(3)
    fisher = np.swapaxes(relative, 1, 2) @ np.linalg.solve(covariance, relative)
    errors = np.sqrt(np.einsum("nii->in", np.linalg.inv(fisher)))
    strengths = np.linalg.eigvalsh(fisher[list(TYPICAL_SKIN).index("III")])
    return errors, float(np.sqrt(strengths[-1] / strengths[0]))
