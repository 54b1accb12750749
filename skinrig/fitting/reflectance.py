"""Combine a dome's maps and a probe's measurements in one model: `skinrig fit reflectance`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model import skin_reflectance, store
from model.skin import SkinAppearance, SkinMap
from model.skin_reflectance import TRANSLUCENCY_MAP, SkinReflectance
from reconstruction.pipeline.probe.stages import SUBSURFACE_FILE
from reconstruction.subsurface.translucency import population_prior
from skinrig.appearances.contents import (
    derive_appearance,
    hash_document,
    hash_file,
    list_assumptions,
)
from skinrig.errors import UsageError
from skinrig.fitting import probe_sites
from skinrig.fitting.probe_sites import PlacedTranslucency

REFLECTANCE_KEY = "reflectance_model"
"""Key in `parameters` of the source of a model's translucency."""


class ReflectanceInputError(ValueError):
    """Folders that are not the inputs of a reflectance model."""


@dataclass(frozen=True, slots=True, eq=False)
class FittedReflectance:
    """An assembled model with its assumptions and omissions.

    Attributes
    ----------
    model
    placed
        Translucency on the texture; None without a probe.
    assumed
        Assumptions of the dome's maps, of the probe's maps, and of their combination.
    left_out
    """

    model: SkinReflectance
    placed: PlacedTranslucency | None
    assumed: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...]


def fit_reflectance(
    dome: Path, probe: Path | None = None, *, out: Path, landmarks: Path | None = None
) -> FittedReflectance:
    """Write the reflectance model of a subject: the dome's maps with translucency on their texture.

    Parameters
    ----------
    dome
        APPEARANCE/ of a dome session with normals, R_d and lobes.
    probe
        APPEARANCE/ of a session of the fiber probe on the same subject; None: the
        population mean is used, with its standard deviation as standard uncertainty.
    out
        Folder to write.
    landmarks
        Table ``name,x,y`` of the probe's sites in texels of the dome's maps.

    Raises
    ------
    model.skin_reflectance.SkinReflectanceError, ReflectanceInputError, ProbeSiteError
        If a folder or map is missing or inconsistent; the message names it.
    """
    if landmarks is not None and probe is None:
        raise UsageError(
            "--landmarks: positions the sites of --probe, which is missing; add or remove an option"
        )
    for given in (dome, probe):
        if given is not None and given.resolve() == out.resolve():
            raise ReflectanceInputError(f"{out}: is one of the inputs; name another --out")
    surface = store.read(dome)
    inputs = {"dome": hash_document(dome)}
    placed = None
    assumed = list_assumptions(surface)
    left_out = list(surface.left_out)
    files = dict(surface.files)
    sources = [surface]
    if probe is not None:
        measured = store.read(probe)
        inputs["probe"] = hash_document(probe)
        sources.append(measured)
        try:
            placed = probe_sites.map_translucency(measured, _position(surface), landmarks=landmarks)
        except ValueError as error:
            raise ReflectanceInputError(f"{probe}: {error}") from error
        depth = placed.map
        if landmarks is not None:
            inputs["landmarks"] = hash_file(landmarks)
        assumed += [f"probe: {text}" for text in list_assumptions(measured)] + list(placed.assumed)
        left_out += [(f"translucency of {what}", why) for what, why in placed.left_out]
        files[SUBSURFACE_FILE] = measured.files[SUBSURFACE_FILE]
    else:
        depth, what = _population_translucency(_position(surface))
        assumed.append(what)
    model = skin_reflectance.assemble(surface, translucency=depth)
    own: dict[str, object] = {
        "assumed": assumed,
        "appearances": [path.name for path in (dome, probe) if path is not None],
        REFLECTANCE_KEY: _record(placed),
    }
    appearance = derive_appearance(
        *sources,
        maps={**surface.maps, TRANSLUCENCY_MAP: depth},
        parameters={**surface.parameters, **own},
        inputs={**surface.inputs, **inputs},
        left_out=tuple(left_out),
        files=files,
    )
    store.write(out, appearance)
    return FittedReflectance(model, placed, tuple(assumed), tuple(left_out))


def summarize_medians(found: FittedReflectance) -> list[tuple[str, float, float, float]]:
    """Return a row per quantity: label and medians over valid texels, red, green and blue."""
    model, coefficients = found.model, found.model.dipole()

    def medians(values: np.ndarray) -> tuple[float, float, float]:
        flat = values[model.valid].astype(np.float64)
        if not len(flat):
            return (float("nan"),) * 3
        with np.errstate(all="ignore"):
            by = [np.median(v[np.isfinite(v)]) if np.isfinite(v).any() else np.nan for v in flat.T]
        return float(by[0]), float(by[1]), float(by[2])

    return [
        ("R_d", *medians(model.r_d)),
        ("1/sigma_tr, mm", *medians(model.translucency_mm)),
        ("1 - alpha'", *medians(coefficients.deficit)),
        ("sigma_a, 1/mm", *medians(coefficients.sigma_a_per_mm)),
        ("sigma_s', 1/mm", *medians(coefficients.sigma_s_prime_per_mm)),
        ("fraction with R_d above 1 or below 0", *_valid_fraction(model, coefficients.outlier)),
    ]


def _valid_fraction(model: SkinReflectance, mask: np.ndarray) -> tuple[float, float, float]:
    count = max(int(np.count_nonzero(model.valid)), 1)
    red, green, blue = (float(np.count_nonzero(mask[..., c])) / count for c in range(3))
    return red, green, blue


def _population_translucency(position: SkinMap) -> tuple[SkinMap, str]:
    """Return the population's mean translucency; its standard deviation is the uncertainty."""
    mean_mm, what = skin_reflectance.population_mean_mm()
    prior = population_prior()
    deviation = np.hypot(prior.person_deviation, prior.place_deviation)
    shape = position.values.shape
    return (
        SkinMap(
            np.broadcast_to(mean_mm, shape).astype(np.float32),
            "mm",
            np.broadcast_to(mean_mm * np.sinh(deviation), shape).astype(np.float32),
            position.valid,
            "1/sigma_tr of red, green and blue light: population mean, not measured",
        ),
        what,
    )


def _position(surface: SkinAppearance) -> SkinMap:
    if "position" not in surface.maps:
        raise ReflectanceInputError(
            "dome: got no map 'position'; give maps that `skinrig reconstruct` made of a dome's "
            "session"
        )
    return surface.maps["position"]


def _record(placed: PlacedTranslucency | None) -> dict[str, object]:
    if placed is None:
        return {"translucency": "mean of people"}
    return {
        "translucency": "measured",
        "conflicts": [": ".join(pair) for pair in placed.conflicts],
        "p_value": list(placed.p_value),
        "sites": [
            {
                "site": site.name,
                "texel": list(site.texel),
                "position_mm": list(site.position_mm),
                "sigma_tr_per_mm": _finite(site.sigma_tr_per_mm),
                "stderr_per_mm": _finite(site.stderr_per_mm),
            }
            for site in placed.sites
        ],
    }


def _finite(values: tuple[float, ...]) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in values]
