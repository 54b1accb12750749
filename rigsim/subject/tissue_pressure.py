"""Press blood out of skin, and let it fill, by the pressure in the tissue around the vessels.

The pressure follows the strain of the skin. Skin rests under tension, which presses its vessels.
Stretching tightens the fibers further, and presses out more blood. Shortening first relaxes the
tension, and vessels fill. Beyond slack the skin folds, and its folds press each other. So each
principal strain e of a state changes the pressure by K (|e + T| - T), with the tension T as strain
and a stiffness K: least pressure where the skin is slack. The red of the lips ends freely and rests
without tension: closing lips presses them at once.

Vessels with a higher pressure of their own resist more: those of the plexus are venules and empty
first. The blood of a vessel under the pressure p is k + (1 - k) exp(-p / P) of that at rest, with
the fraction k that no pressure displaces. Below the pressure of rest the law continues with the
same slope, point-symmetric, as walls resist filling: at most 2 - k.

Notes
-----
- Direction: Jimenez et al. 2010, section 3.1, observation 2: expressions drain blood in some
  regions and increase it in others, most over the cheek bones in a smile.
- Stretch against perfusion: forces that stretch a forearm's skin by 10 % virtually stop the flow in
  its capillaries; Bader, Barnhill and Ryan 1986, Archives of Physical Medicine and Rehabilitation
  67, 807-811. At the pressure of arteriolar capillaries this is 500 mbar per unit strain.
- Pressures in a capillary loop: 37.7 mm of mercury in its arteriolar limb, 19.4 at its apex, 14.6
  in its venular limb; Clinical Science 1988, 74, doi:10.1042/cs0740507, as Landis 1930 found.
"""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from rigsim.arrays import Float32Array, Float64Array
from rigsim.geometry.mesh import Mesh
from rigsim.geometry.surface_noise import smooth_noise
from rigsim.geometry.surface_strain import average_at_vertices, principal_log_strains
from rigsim.subject.face_regions import region_masks, to_mean_head

INCOMPRESSIBLE_BLOOD_FRACTION: Final = 0.25
"""Fraction of the blood at rest that no pressure displaces."""

CAPILLARY_PRESSURE_MBAR: Final = 30.0
"""Pressure in capillaries, mbar: about 23 mm of mercury. Landis 1930,
doi:10.1152/ajplegacy.1930.93.2.353."""

COMPARTMENT_PRESSURE_RATIOS: Final = (1.0, 1.0, 0.65)
"""Pressure in bed, loops and plexus, relative to `CAPILLARY_PRESSURE_MBAR`; venules: 14.6 mm of
mercury."""

STIFFNESS_MBAR: Final = 75.0
"""Change of pressure per unit principal strain, mbar: 7.5 kPa. Chosen: expressions strain facial
skin by up to 0.4 and do not stop its flow, which asks for less than 125; forearms are stiffer."""

TENSION_RANGE: Final = (0.05, 0.10)
"""Relative stretch of a person's skin at rest."""

STIFFNESS_DEVIATION: Final = 0.25
"""Standard deviation of the stiffness over a face, relative."""


def draw_tension(rng: np.random.Generator) -> float:
    """Draw the relative stretch of a person's skin at rest.

    Wrinkles take the first draw of the stream of the person's lines, and so does the pressure.
    """
    return float(rng.uniform(*TENSION_RANGE))


def blood_ratio(pressure_mbar: ArrayLike, *, capillary_ratio: float = 1.0) -> Float64Array:
    """Return the blood of vessels under pressure, relative to that at rest.

    Parameters
    ----------
    pressure_mbar
        Change of the pressure in the tissue, mbar; below 0 vessels fill.
    capillary_ratio
        Pressure in these vessels, relative to `CAPILLARY_PRESSURE_MBAR`, > 0.

    Returns
    -------
    ndarray
        0.25 to 1.75; exactly 1 without a change.

    Examples
    --------
    >>> blood_ratio([-30.0, 0.0, 30.0, 1e4]).round(3).tolist()
    [1.474, 1.0, 0.526, 0.25]
    """
    pressure = np.asarray(pressure_mbar)
    moved = np.expm1(-np.abs(pressure) / (capillary_ratio * CAPILLARY_PRESSURE_MBAR))
    return np.asarray(1.0 + np.sign(pressure) * (1.0 - INCOMPRESSIBLE_BLOOD_FRACTION) * moved)


def strain_pressure_mbar(strains: Float64Array, tension: ArrayLike) -> Float64Array:
    """Return the change of the pressure in strained skin.

    Parameters
    ----------
    strains
        Principal logarithmic strains, shape (..., 2).
    tension
        Strain of the skin at rest relative to slack, shape (...) or a number, >= 0.

    Returns
    -------
    ndarray
        Shape (...), mbar; exactly 0 without strain.

    Examples
    --------
    >>> stretched, relaxed, folded = strain_pressure_mbar(
    ...     np.array([[0.2, 0.0], [0.0, -0.05], [0.0, -0.3]]), 0.08
    ... )
    >>> bool(relaxed < 0.0 < folded < stretched)
    True
    """
    slack = np.asarray(tension)[..., None]
    change = np.abs(strains + slack) - slack
    return np.asarray(STIFFNESS_MBAR * np.sum(change, axis=-1))


def expression_pressure_mbar(rest: Mesh, moved_mm: Float32Array, *, seed: int) -> Float32Array:
    """Return the change of the pressure in the skin of a face that moved.

    Parameters
    ----------
    rest
        The face at rest, rig frame.
    moved_mm
        Its vertices in the expression, shape (V, 3).
    seed
        Seed of the person, >= 0, which sets tension and stiffness of the skin.

    Returns
    -------
    ndarray of float32
        Shape (V,), mbar; 0 where the skin is not strained.
    """
    points = to_mean_head(rest.vertices_mm, rest)
    tension = draw_tension(np.random.default_rng([seed, 22])) * (1.0 - region_masks(points)["lips"])
    strains = principal_log_strains(rest, moved_mm)
    pressure = strain_pressure_mbar(strains, tension[rest.faces].mean(axis=1))
    # Each person has an own pattern (observation 3), which states do not change (observation 4).
    own = 1.0 + STIFFNESS_DEVIATION * smooth_noise(points, (35.0, 15.0), seed=seed + 59)
    return np.asarray(average_at_vertices(rest, pressure) * np.maximum(own, 0.0), np.float32)
