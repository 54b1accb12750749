"""What estimators of the fibre probe should find: profiles, optics, and the probe as built."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from model.skin import SkinAppearance
from rigsim.fiber.homogeneous_fit import nearest_medium
from rigsim.fiber.probe_profile import fibres_of
from rigsim.fiber.probe_tissue import HomogeneousTissue
from rigsim.scenes.probe.scene import Probing

if TYPE_CHECKING:
    from rigsim.scenes.probe.scene import ProbeScene


def appearance(scene: ProbeScene, probings: Sequence[Probing]) -> SkinAppearance:
    """Return the truth of some placements of the head.

    Parameters
    ----------
    scene
        What the head was on.
    probings
        The placements.

    Returns
    -------
    SkinAppearance
        No maps. ``parameters``: ``profiles``, one for each placement with ``site``, ``repeat``,
        ``angle_deg``, ``suction_mbar``, ``radius_mm``, ``reflectance_per_mm2`` and ``stderr``
        (fibres x 3, of the Monte Carlo), ``sigma_a_per_mm``, ``sigma_s_prime_per_mm``,
        ``sigma_tr_per_mm`` (3 each) and ``kind``; of tissue that is not homogeneous and gray the
        nearest medium by `rigsim.fiber.homogeneous_fit`, with ``fit_residual``, ``fit_factor`` and
        ``fit_fibres``; ``spots_px``, ``gain``, ``crosstalk`` of the
        probe as built.
    """
    profiles = [_profile(scene, probing) for probing in probings]
    build = scene.build
    parameters: dict[str, object] = {
        "profiles": profiles,
        "spots_px": build.spot_px.tolist(),
        "gain": build.gain.tolist(),
        "crosstalk": build.crosstalk.tolist(),
    }
    return SkinAppearance(
        {}, "simulated", parameters=parameters, left_out=tuple(scene.left_out), seed=scene.seed
    )


def _profile(scene: ProbeScene, probing: Probing) -> dict[str, object]:
    made = scene.profiles.profile(probing.site, probing.angle_deg, probing.suction_mbar)
    tissue = scene.tissue
    out: dict[str, object] = {
        "site": probing.site,
        "repeat": probing.repeat,
        "angle_deg": probing.angle_deg,
        "suction_mbar": probing.suction_mbar,
        "radius_mm": list(scene.profiles.probe.radius_mm),
        "reflectance_per_mm2": made.reflectance_per_mm2.tolist(),
        "stderr": made.stderr.tolist(),
        "kind": tissue.kind,
    }
    if isinstance(tissue, HomogeneousTissue) and not tissue.wavelength_nm:
        sigma_a = float(np.squeeze(tissue.sigma_a_per_mm))
        scattering = float(np.squeeze(tissue.sigma_s_prime_per_mm))
        sigma_tr = math.sqrt(3.0 * sigma_a * (sigma_a + scattering))
        media = [(sigma_a, scattering, sigma_tr)] * 3
    else:
        kind = fibres_of(scene.profiles.probe)
        dimmed = tissue.kind != "anisotropic"  # has no layer on top
        fits = [nearest_medium(band, kind, dimmed=dimmed) for band in made.reflectance_per_mm2.T]
        media = [(f.sigma_a_per_mm, f.sigma_s_prime_per_mm, f.sigma_tr_per_mm) for f in fits]
        out["fit_residual"] = [fit.residual for fit in fits]
        out["fit_factor"] = [fit.factor for fit in fits]
        out["fit_fibres"] = [fit.fibres for fit in fits]
    for name, values in zip(
        ("sigma_a_per_mm", "sigma_s_prime_per_mm", "sigma_tr_per_mm"),
        zip(*media, strict=True),
        strict=True,
    ):
        out[name] = list(values)
    return out
