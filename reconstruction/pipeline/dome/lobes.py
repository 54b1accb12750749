"""Basis BRDFs of a dome session, and the refinement of normals with them."""

import dataclasses
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from model.brdf import tables as brdf_tables
from model.brdf.tables import BrdfBasis
from model.checks import Checks
from model.skin import SkinMap
from model.skin_reflectance import BASIS_FILE
from reconstruction import brdf_basis
from reconstruction.arrays import BoolArray, Float64Array, FloatArray, Int64Array
from reconstruction.lumitexels import Lumitexels
from reconstruction.lumitexels.store import LumitexelStore
from reconstruction.pipeline.dome.calibrated import CalibratedDome
from reconstruction.pipeline.inputs import Inputs, InputsError
from reconstruction.scan.mesh import RefinedScan
from reconstruction.surface import errors as surface_errors
from reconstruction.surface import estimates
from reconstruction.surface.estimates import PointValues
from reconstruction.surface.model_normals import PointLobes
from reconstruction.surface.texture import SurfaceTexture
from reconstruction.tiles import MAX_WORKERS

BASIS_RANK: Final = 4
"""Common mixtures that the basis is reduced to, as many as Weyrich et al. 2005 use for a face."""

MAX_RELATIVE_STRENGTH: Final = 6.0
"""Multiple of the median strength above which a point's mixture is not used for the basis."""

RECORDED_RANKS: Final = (1, 2, BASIS_RANK, 2 * BASIS_RANK, 24)
"""Ranks whose mixtures and errors are recorded, up to the rank that the points support."""

CHUNK_SAMPLES: Final = 1_500_000
"""Samples per chunk; about 60 bytes each."""

BASIS_POINTS: Final = 5_000
"""Randomly drawn scanned points from which the mixtures are estimated."""


def weight_names(rank: int = BASIS_RANK) -> tuple[str, ...]:
    """Return the names of the weight maps of ``rank`` basis BRDFs.

    Examples
    --------
    >>> weight_names(2)
    ('basis_weight_0', 'basis_weight_1')
    """
    return tuple(f"basis_weight_{k}" for k in range(rank))


N_REFINEMENTS = 2
"""Alternations of fitting normals with the lobes, and lobes with the normals."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceSampleStore:
    """Lumitexels of the surface, and the folder that stores them when they are many."""

    store: LumitexelStore
    folder: Any
    lights: int
    """Number of the dome's lights; where exposures are separate, several captures share one."""
    compute_tiles: Callable[..., Iterator[Any]]
    """See `reconstruction.pipeline.inputs.Inputs.compute_tiles`."""

    def parts(self, points: int) -> list[slice]:
        """Return parts of so many points with at most `CHUNK_SAMPLES` samples each."""
        samples_per_point = max(self.store.light_count * self.store.view_count, 1)
        size = max(1, CHUNK_SAMPLES // samples_per_point)
        return [slice(start, min(start + size, points)) for start in range(0, points, size)]

    def collect(
        self, stage: str, estimate: Callable[[slice, Lumitexels], Sequence[PointValues]]
    ) -> list[PointValues]:
        """Estimate part by part and concatenate each of the results.

        Assembling the samples of a part costs as much as an estimate: estimates that depend on
        nothing but their own points belong into one pass.

        Parameters
        ----------
        stage
            Name of this pass, unique within the stage.
        estimate
            Called with the points of a part and their samples.
        """

        def of_part(part: slice) -> Sequence[PointValues]:
            samples = self.store.chunk(part.start, part.stop)
            return estimate(part, dataclasses.replace(samples, light=samples.light % self.lights))

        parts = self.parts(len(self.store.surface))
        found = self.compute_tiles(stage, parts, of_part, workers=MAX_WORKERS)
        return [PointValues.concatenate(each) for each in zip(*found, strict=True)]


def draw_basis_points(valid: BoolArray, patch_stderr_mm: FloatArray) -> Int64Array:
    """Draw valid points outside of closed holes, at most `BASIS_POINTS`, in ascending order.

    Parameters
    ----------
    valid
        (P,): points with an albedo.
    patch_stderr_mm
        (P,): standard error by closed holes, 0 where the surface is scanned. In holes, errors of
        the surface turn half vectors.
    """
    good = np.flatnonzero(valid & (patch_stderr_mm == 0.0))
    return np.sort(np.random.default_rng(0).permutation(good)[:BASIS_POINTS])


def fit_lobes(
    inputs: Inputs,
    surface: RefinedScan,
    lumitexels: SurfaceSampleStore,
    point_normals: PointValues,
    point_r_d: PointValues,
) -> Mapping[str, Any]:
    """Fit basis BRDFs to some scanned points and reduce them to the rank; return basis and file."""
    folder = inputs.basis
    materials = brdf_tables.default_basis() if folder is None else brdf_tables.load(folder)
    rank = inputs.rank or BASIS_RANK
    drawn = draw_basis_points(point_r_d.valid, surface.patch_stderr_mm)
    if len(drawn) < rank:
        raise InputsError(
            f"lobes: got {len(drawn)} scanned points with an albedo, expected at least {rank}; "
            "choose a lower rank, or capture more lights [SR-REC-012]"
        )

    def fit_drawn(part: slice) -> Float64Array:
        points = drawn[part]
        some = lumitexels.store.points(points)
        shine = estimates.specular_samples(some, point_normals[points], point_r_d[points])
        return brdf_basis.fit_weights(shine, materials).weights

    parts = lumitexels.parts(len(drawn))
    fitted = list(
        lumitexels.compute_tiles("mixtures of materials", parts, fit_drawn, workers=MAX_WORKERS)
    )
    shares = _normalize_mixtures(
        np.concatenate(fitted), materials, min_points=max(rank, 2 * BASIS_RANK)
    )
    most = min(shares.shape)
    if rank > most:
        expected = f"expected at most {most}, the number that the samples determine"
        raise InputsError(f"rank: got {rank}, {expected}; choose a lower rank")
    mixes = {
        k: brdf_basis.reduce(shares, k, basis=materials)[1:]
        for k in sorted({*RECORDED_RANKS, rank})
        if k <= most
    }
    basis = materials.mix_materials(mixes[rank][0])
    return {"basis": basis, "basis_file": _basis_bytes(materials, rank, mixes)}


def _normalize_mixtures(
    shares: Float64Array, materials: BrdfBasis, *, min_points: int
) -> Float64Array:
    """Scale mixtures to equal reflected energy; omit those that the samples leave undetermined.

    A lobe too narrow for any pair of light and view has an arbitrary weight.
    """
    total = shares @ materials.strength()
    some = total[total > 0]
    usual = float(np.median(some)) if len(some) else 0.0
    kept = (total > 0) & (total < MAX_RELATIVE_STRENGTH * usual)
    got = f"{np.count_nonzero(kept)} of {len(shares)} points whose samples determine the lobes"
    expected = f"at least {min_points}; capture more lights or views"
    Checks(InputsError).require(np.count_nonzero(kept) >= min_points, "lobes", got, expected)
    return shares[kept] / total[kept, None]


def _basis_bytes(
    materials: BrdfBasis, rank: int, mixes: Mapping[int, tuple[Float64Array, float]]
) -> bytes:
    """Serialize the lobes, with the mixtures of materials at every recorded rank."""
    mix = mixes[rank][0]
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        materials=np.array(materials.names),
        mix=mix,
        table=materials.mix_materials(mix).table[..., :rank],
        light_radius_rad=materials.light_radius_rad,
        ranks=np.array(list(mixes)),
        error_by_rank=np.array([error for _, error in mixes.values()]),
        mix_by_rank=np.concatenate([mix for mix, _ in mixes.values()]),
    )
    return stream.getvalue()


def refine_normals(
    dome: CalibratedDome,
    surface: RefinedScan,
    lumitexels: SurfaceSampleStore,
    point_normals: PointValues,
    point_r_d: PointValues,
    basis: BrdfBasis,
    basis_file: bytes,
    texture: SurfaceTexture,
) -> Mapping[str, SkinMap | bytes]:
    """Refine normals and lobe weights alternately, point by point; return maps and basis file."""

    def refine(part: slice, samples: Lumitexels) -> tuple[PointValues, PointValues]:
        first, r_d = point_normals[part], point_r_d[part]

        def fit(normals: PointValues) -> tuple[PointValues, PointLobes]:
            fitted = estimates.fit_lobe_weights(samples, normals, r_d, basis)
            return fitted, PointLobes(fitted.values[:, :-1], basis)

        fitted, lobes = fit(first)
        started = estimates.normals_from_remainder(samples, first, r_d, lobes)
        moved = started.valid[:, None]
        values = np.where(moved, started.values, first.values)
        stderr = np.where(moved, started.stderr, first.stderr)
        found = inside = PointValues(values, stderr, first.valid & r_d.valid)
        for _ in range(N_REFINEMENTS):
            found = estimates.normals_from_full_model(
                samples, inside, r_d, lobes, initial_normals=found.values
            )
            fitted, lobes = fit(found)
        return found, fitted

    found, fitted = lumitexels.collect("normals and lobes from the full model", refine)
    maps, good, what = {}, fitted.valid, "weight of a common mixture"
    for k, name in enumerate(weight_names(fitted.values.shape[1] - 1)):
        maps[name] = texture.map(fitted.values[:, k], fitted.stderr[:, k], good, "1", what)
    what = "weighted RMS of samples - model"
    maps["lobe_residual"] = texture.map(fitted.values[:, -1], None, good, "1/sr", what)
    found = surface_errors.add_normal_errors(found, surface, dome.pixel_mm)
    refined = texture.normals(found, "by the full model, world frame")
    return {BASIS_FILE: basis_file, "normals_refined": refined, **maps}
