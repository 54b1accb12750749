"""Estimate the maps of a fused person: chromophores, R_d and the diffuse mean free path."""

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from model.skin import MAP_UNITS, SkinMap
from model.skin_reflectance import TRANSLUCENCY_MAP
from reconstruction.fusion.person import PersonSkin
from reconstruction.fusion.texels import (
    BLOCK_TEXELS,
    OffsetModel,
    TexelSkin,
    estimate_texels,
    melanin_depth_factor,
)
from reconstruction.subsurface.translucency import TranslucencyPrior
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import Float32Array, Int64Array
from skinrig.fitting import probe_sites
from skinrig.fusing.measurements import SITE_SIGMA_TR_SD, Measurements
from skinrig.fusing.texel_colors import LOG_R_D_OVER_REFLECTANCE

OWN_SUFFIX: Final = "_texel_stderr"
"""Suffix of maps of standard errors without those common to the face."""
FUSED_MAPS: Final = ("melanin", "melanin_optical_depth", "hemoglobin", "r_d", TRANSLUCENCY_MAP)
"""Maps that the fusion estimates; all others are carried over."""


def estimate_maps(
    measured: Measurements,
    person: PersonSkin,
    errors: OffsetModel,
    *,
    position: SkinMap | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[dict[str, SkinMap], list[float]]:
    """Estimate all texels block by block.

    Parameters
    ----------
    measured
        Signals of the person.
    person, errors
        Common properties, and covariances of the signals' errors.
    position
        Surface points of the texels; needed with a probe.
    progress
        Receives a line of progress.

    Returns
    -------
    maps
        By name.
    p_value
        Of the probe's sites per channel, see `skinrig.fitting.probe_sites`; empty without a probe.
    """
    height, width = measured.shape
    planes = {
        name: np.zeros((measured.count, channels), np.float32)
        for name, channels in (
            ("melanin", 3),
            ("depth", 2),
            ("blood", 3),
            ("covariance", 1),
            ("misfit", 1),
            ("r_d", 9),
            ("expected", 3),
        )
    }
    valid = np.zeros(measured.count, bool)
    factor = melanin_depth_factor(person.properties_sd)
    known = np.flatnonzero(np.logical_or.reduce([one.valid for one in measured.colors]))
    for start in range(0, known.size, BLOCK_TEXELS):
        if progress is not None:
            progress(f"texels: {100 * start // known.size} %")
        block = known[start : start + BLOCK_TEXELS]
        colors = measured.texel_colors(block)
        for _, skin in estimate_texels(person, colors, errors):
            _write_block(planes, block, skin, factor, measured)
            valid[block] = skin.valid

    def one_map(plane: str, column: int, error: int | None, unit: str, what: str) -> SkinMap:
        values = planes[plane].reshape(height, width, -1)
        stderr = None if error is None else values[..., error]
        return SkinMap(values[..., column], unit, stderr, valid.reshape(height, width), what)

    thickness = "for an epidermis of 0.09 mm"
    apart = "standard error by errors of the texel alone"
    maps = {
        "melanin": one_map("melanin", 0, 1, MAP_UNITS["melanin"], f"fused, {thickness}"),
        f"melanin{OWN_SUFFIX}": one_map("melanin", 2, None, MAP_UNITS["melanin"], apart),
        "melanin_optical_depth": one_map("depth", 0, 1, "1", "fused, at 550 nm"),
        "hemoglobin": one_map("blood", 0, 1, MAP_UNITS["hemoglobin"], "fused"),
        f"hemoglobin{OWN_SUFFIX}": one_map("blood", 2, None, MAP_UNITS["hemoglobin"], apart),
        "melanin_blood_covariance": one_map(
            "covariance", 0, None, "1", "covariance of log melanin optical depth and log blood"
        ),
        "fusion_misfit": one_map("misfit", 0, None, "1", "chi-squared over degrees of freedom"),
    }
    if measured.rigs[0].rig == "dome":
        r_d, good = planes["r_d"].reshape(height, width, 9), valid.reshape(height, width)
        what = "fused, camera RGB over that of a perfect white"
        maps["r_d"] = SkinMap(r_d[..., :3], "1", r_d[..., 3:6], good, what)
        maps[f"r_d{OWN_SUFFIX}"] = SkinMap(r_d[..., 6:], "1", None, good, apart)
    p_value: list[float] = []
    if measured.probe_bands is not None and position is not None:
        usual = measured.errors(person.mean).unexplained
        on_face = intersect_valid(position) & valid.reshape(height, width)
        place = SkinMap(position.values, "mm", valid=on_face)
        prior = TranslucencyPrior(
            np.zeros(3), np.sqrt(np.diag(usual)[-3:]), np.full(3, SITE_SIGMA_TR_SD)
        )
        # a site may be at a texel without colors
        planes["expected"][~valid] = np.median(planes["expected"][valid], axis=0)
        expected = planes["expected"].reshape(height, width, 3)
        found = probe_sites.interpolate_sites(
            measured.sites, place, prior=prior, expected_mm=expected
        )
        maps[TRANSLUCENCY_MAP] = found.map
        p_value = list(found.p_value)
    return maps, p_value


def _write_block(
    planes: Mapping[str, Float32Array],
    block: Int64Array,
    skin: TexelSkin,
    factor: float,
    measured: Measurements,
) -> None:
    """Write the estimates of a block into the planes of the maps."""
    depth, blood = np.exp(skin.log_skin).T
    melanin = depth / factor
    own = np.sqrt(np.einsum("naa->na", skin.covariance))
    both = skin.covariance + skin.common
    total = np.sqrt(np.einsum("naa->na", both))
    # half-widths of 68 % intervals of lognormal quantities
    planes["melanin"][block] = np.stack(
        [
            melanin,
            melanin * np.sinh(np.sqrt(skin.log_melanin_variance)),
            melanin * np.sinh(own[:, 0]),
        ],
        axis=-1,
    )
    planes["depth"][block] = np.stack([depth, depth * np.sinh(total[:, 0])], axis=-1)
    planes["blood"][block] = np.stack(
        [blood, blood * np.sinh(total[:, 1]), blood * np.sinh(own[:, 1])], axis=-1
    )
    planes["covariance"][block, 0] = both[:, 0, 1]
    planes["misfit"][block, 0] = skin.misfit
    if measured.rigs[0].rig == "dome":
        r_d = np.exp(skin.log_signals[:, :3] + LOG_R_D_OVER_REFLECTANCE)
        own, common = skin.signal_variance[:, :3], skin.signal_common[:, :3]
        sd = np.sinh(np.sqrt(np.concatenate([own + common, own], axis=-1)))
        planes["r_d"][block] = np.concatenate([r_d, np.tile(r_d, 2) * sd], axis=-1)
    if measured.probe_bands is not None:
        planes["expected"][block] = np.exp(-skin.log_signals[:, -3:])
