"""The dome's stages: images under one light each and a scan, to normals, albedo and lobes."""

from __future__ import annotations

import dataclasses
import io
import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from model.brdf import tables as brdf_tables
from model.brdf.tables import BrdfBasis
from model.skin import SkinMap
from reconstruction import brdf_basis, photometric_stereo
from reconstruction.arrays import Float64Array
from reconstruction.lumitexels import Lumitexels, Surface
from reconstruction.lumitexels.ray_casting import RayCaster
from reconstruction.lumitexels.store import LumitexelStore
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.dome.calibrated import Dome, apart, calibrated
from reconstruction.pipeline.dome.images import DomeImages
from reconstruction.pipeline.dome.motion import Motion, follow_head
from reconstruction.pipeline.dome.registration import register
from reconstruction.pipeline.evidence import Evidence, EvidenceError
from reconstruction.pipeline.hold_out import HoldOutError
from reconstruction.scan import mesh as scan_mesh
from reconstruction.scan.mesh import RefinedScan
from reconstruction.surface import errors as surface_errors
from reconstruction.surface import estimates
from reconstruction.surface.estimates import PointValues
from reconstruction.surface.texture import SurfaceTexture

STAGE_REVISION = 4
"""Grows when the code of a stage changes its result, so that older maps are computed again."""

BASIS_RANK: Final = 4
"""Common mixtures that the basis is reduced to, as many as Weyrich et al. 2005 use for a face."""
MAX_RELATIVE_STRENGTH: Final = 6.0
"""Times the usual strength from which on a point's mixture is not used to find the common ones."""
RECORDED_RANKS: Final = (1, 2, BASIS_RANK, 2 * BASIS_RANK, 24)
"""Ranks whose mixtures and errors are recorded, as far as the points hold so many."""
BASIS_POINTS: Final = 5_000
"""Points, drawn at random, that the mixtures are found on."""
SCAN_FILE: Final = "scan.ply"
MEMORY_BYTES: Final = 2**30
"""Size of the table of samples from which on it lies in files and not in memory."""
FACE_MM2: Final = 60_000.0
"""Area of a face; with the size of a pixel on it, it says how many points can be told apart."""
POINT_LIMITS: Final = (8_000, 1_000_000)
TEXTURE_LIMITS: Final = (128, 2048)


def weight_names(rank: int = BASIS_RANK) -> tuple[str, ...]:
    """Return the names of the maps of shares of so many lobes.

    Examples
    --------
    >>> weight_names(2)
    ('basis_weight_0', 'basis_weight_1')
    """
    return tuple(f"basis_weight_{k}" for k in range(rank))


def maps_of(rank: int = BASIS_RANK) -> tuple[str, ...]:
    """Return the names of the maps that can be made of a dome session."""
    return (
        "position",
        "half_vector_normals",
        "normals",
        "r_d",
        *weight_names(rank),
        "lobe_residual",
        "normals_refined",
        "samples",
    )


N_REFINEMENTS = 2
"""Turns of fitting normals by the lobes, and the lobes at the normals."""
WEIGHT_NAMES = weight_names()
MAP_NAMES = maps_of()
"""Maps that can be made of a dome session, unless another rank is asked for."""
BASIS_FILE = "brdf_basis.npz"
MESH_FILE = "mesh.obj"
FILE_NAMES = (MESH_FILE, BASIS_FILE)
"""What goes along with the maps."""


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Lumitexels of the surface, and the folder that holds them where they are many."""

    store: LumitexelStore
    folder: Any
    lights: int
    """Lights of the dome: where exposures stay apart, several captures are of one."""

    def collect(
        self,
        estimate: Callable[[slice, Lumitexels], PointValues],
        progress: Callable[[float], None] | None = None,
    ) -> PointValues:
        """Estimate at all points; see `estimates.collect`."""

        def by_light(part: slice, samples: Lumitexels) -> PointValues:
            return estimate(part, dataclasses.replace(samples, light=samples.light % self.lights))

        return estimates.collect(self.store, by_light, progress=progress)


def graph(evidence: Evidence) -> list[stages.Stage]:
    """Return the stages that a dome session can go through; see `stages.run`."""
    dome = _dome(evidence)
    base: dict[str, Any] = {
        "revision": STAGE_REVISION,
        "inputs": dict(sorted(evidence.hashes.items())),
    }
    if evidence.hold_out:
        base["held_out"] = evidence.hold_out.record()
    weights_made = weight_names(evidence.rank or BASIS_RANK)

    unscaled = (
        ""
        if dome.absolute
        else (
            "r_d: the lights are not calibrated and an albedo has no scale without them; run "
            "`skinrig calibrate lights` on sessions of the mirror spheres and the white target"
        )
    )

    def stage(
        name: str,
        needs: tuple[str, ...],
        makes: tuple[str, ...],
        run: Any,
        refused: str = "",
        **more: Any,
    ) -> stages.Stage:
        return stages.Stage(name, needs, makes, run, {**base, **more}, refused)

    return [
        stage("surface", (), ("surface",), lambda: {"surface": _surface(evidence, dome)}),
        stage(
            "texture",
            ("surface",),
            ("texture", "position", MESH_FILE),
            lambda surface: _texture(dome, surface),
        ),
        stage(
            "motion",
            ("surface",),
            ("motion",),
            lambda surface: {"motion": _motion(evidence, dome, surface)},
        ),
        stage(
            "lumitexels",
            ("surface", "motion"),
            ("lumitexels",),
            lambda surface, motion: {"lumitexels": _lumitexels(dome, surface, motion)},
        ),
        stage(
            "sample counts",
            ("lumitexels", "texture"),
            ("samples",),
            lambda lumitexels, texture: _counts(dome, lumitexels, texture),
        ),
        stage(
            "half-vector normals",
            ("lumitexels", "texture"),
            ("half_vector_normals",),
            lambda lumitexels, texture: _half_vectors(dome, lumitexels, texture),
        ),
        stage(
            "normals",
            ("surface", "lumitexels", "texture"),
            ("point_normals", "normals"),
            lambda surface, lumitexels, texture: _normals(dome, surface, lumitexels, texture),
        ),
        stage(
            "albedo",
            ("surface", "lumitexels", "point_normals", "texture"),
            ("point_r_d", "r_d"),
            lambda surface, lumitexels, point_normals, texture: _albedo(
                dome, surface, lumitexels, point_normals, texture
            ),
            unscaled,
        ),
        stage(
            "lobes",
            ("lumitexels", "point_normals", "point_r_d"),
            ("basis", "weights", "basis_file"),
            lambda lumitexels, point_normals, point_r_d: _lobes(
                evidence, lumitexels, point_normals, point_r_d
            ),
            ranks=list(RECORDED_RANKS),
        ),
        stage(
            "refined normals",
            (
                "surface",
                "lumitexels",
                "point_normals",
                "point_r_d",
                "basis",
                "weights",
                "basis_file",
                "texture",
            ),
            ("normals_refined", *weights_made, "lobe_residual", BASIS_FILE),
            lambda surface, lumitexels, point_normals, point_r_d, basis, weights, file, texture: {
                BASIS_FILE: file,
                **_refined(
                    dome, surface, lumitexels, point_normals, point_r_d, basis, weights, texture
                ),
            },
        ),
    ]


def _dome(evidence: Evidence) -> Dome:
    """Return the dome with the images that may be fitted to."""
    images = DomeImages(evidence.session)
    held = evidence.hold_out = evidence.hold_out.within(images.lights, images.views)
    evidence.noted["held_out"] = held.record()
    if held:
        for field, there, least in (
            ("lights", images.lights, estimates.LEAST_LIGHTS),
            ("views", images.views, estimates.LEAST_VIEWS),
        ):
            left = len(there) - len(getattr(held, field))
            if left < least:
                raise HoldOutError(
                    f"hold-out: leaves {left} of {len(there)} {field}, expected at least {least}; "
                    "hold out fewer"
                )
        images = DomeImages(evidence.session, without=held)
    return calibrated(evidence, images)


def _surface(evidence: Evidence, dome: Dome) -> RefinedScan:
    """Clean and refine the scan, and lay it onto the dome."""
    session = evidence.session
    if evidence.scan is None and SCAN_FILE not in session.attachments():
        raise EvidenceError(
            f"session {session.id}: holds no scan; add one with `skinrig import mesh FILE`"
        )
    _require(dome)
    footprint = dome.pixel_mm
    points = int(np.clip(FACE_MM2 / footprint**2, *POINT_LIMITS))
    mesh = session.attachment(SCAN_FILE) if evidence.scan is None else evidence.scan
    scan = scan_mesh.prepare(mesh, points=points)
    fit = register(dome, scan.coarse)
    evidence.noted["registration"] = {
        "rotation": fit.rotation.tolist(),
        "translation_mm": fit.translation_mm.tolist(),
        "stderr_rad_mm": fit.stderr.tolist(),
        "residual_deg": fit.residual_deg,
        "converged": fit.converged,
        "points": len(scan.points_mm),
        "pixel_mm": footprint,
    }
    return scan.moved(fit.rotation, fit.translation_mm)


def _require(dome: Dome) -> None:
    """Refuse fewer views or lights than any point needs, and lights that lie in a plane."""
    views, lights = len(dome.cameras), int(np.count_nonzero(dome.lights.valid))
    if views < estimates.LEAST_VIEWS:
        raise EvidenceError(
            f"views: got images of {views}, expected at least {estimates.LEAST_VIEWS}"
        )
    if lights < estimates.LEAST_LIGHTS:
        raise EvidenceError(
            f"lights: got {lights} that can be used, expected at least {estimates.LEAST_LIGHTS}"
        )
    place = dome.lights.position_mm[dome.lights.valid]
    photometric_stereo.require_spread(place / np.linalg.norm(place, axis=1, keepdims=True))


def _texture(dome: Dome, surface: RefinedScan) -> Mapping[str, Any]:
    side = 2 ** math.ceil(math.log2(math.sqrt(2.0 * len(surface.points_mm))))
    texture = SurfaceTexture.of(surface, size=int(np.clip(side, *TEXTURE_LIMITS)))
    return {
        "texture": texture,
        "position": texture.map(
            surface.points_mm, None, np.ones(len(surface.points_mm), bool), "mm", "rig frame"
        ),
        MESH_FILE: texture.wavefront(),
    }


def _motion(evidence: Evidence, dome: Dome, surface: RefinedScan) -> Motion | None:
    images = dome.images.apart()
    found = follow_head(evidence.session, images, dome.cameras, surface, dome.pixel_mm)
    # without tracking frames nobody knows whether the head held still
    evidence.noted["motion"] = {"tracking_frames": 0} if found is None else found.record()
    return found


def _lumitexels(dome: Dome, surface: RefinedScan, motion: Motion | None) -> Samples:
    if motion is not None and motion.still:
        motion = None
    if motion is not None:
        dome = apart(dome)
    count = len(surface.points_mm) * len(dome.cameras) * len(dome.images.captures)
    folder = tempfile.TemporaryDirectory(prefix="skinrig-") if 12 * count > MEMORY_BYTES else None
    store = LumitexelStore(
        Surface(surface.points_mm, surface.normals),
        cameras=dome.cameras,
        lights=dome.lights,
        caster=RayCaster(surface.coarse.vertices_mm, surface.coarse.faces),
        poses=None if motion is None else motion.poses,
        binning=2,
        folder=None if folder is None else Path(folder.name),
    )
    for view in range(len(dome.cameras)):
        dome.tell("lumitexels", view / len(dome.cameras))
        for capture in range(len(dome.images.captures)):
            if not dome.lights.valid[capture]:
                continue
            if motion is not None and not motion.usable[capture]:
                continue
            image = dome.image(view, capture)
            store.add(view, capture, image.rgb, image.variance, image.valid)
    return Samples(store, folder, len(dome.table.names))


def _counts(dome: Dome, lumitexels: Samples, texture: SurfaceTexture) -> Mapping[str, SkinMap]:
    found = lumitexels.collect(
        estimates.sample_counts, progress=partial(dome.tell, "sample counts")
    )
    return {"samples": texture.map(found.values[:, 0], None, found.valid, "1", "samples a point")}


def _half_vectors(
    dome: Dome, lumitexels: Samples, texture: SurfaceTexture
) -> Mapping[str, SkinMap]:
    found = lumitexels.collect(
        lambda _, samples: estimates.normals_from_half_vectors(samples),
        progress=partial(dome.tell, "half-vector normals"),
    )
    return {"half_vector_normals": texture.normals(found, "as published, world frame")}


def _normals(
    dome: Dome, surface: RefinedScan, lumitexels: Samples, texture: SurfaceTexture
) -> Mapping[str, Any]:
    found = lumitexels.collect(
        lambda part, samples: estimates.normals_from_shading(samples, surface.normals[part]),
        progress=partial(dome.tell, "normals"),
    )
    found = surface_errors.of_normals(found, surface, dome.pixel_mm)
    return {"point_normals": found, "normals": texture.normals(found, "world frame")}


def _albedo(
    dome: Dome,
    surface: RefinedScan,
    lumitexels: Samples,
    point_normals: PointValues,
    texture: SurfaceTexture,
) -> Mapping[str, Any]:
    good = point_normals.valid
    typical = float(np.median(point_normals.stderr[good, 0])) if good.any() else 0.02
    found = lumitexels.collect(
        lambda part, samples: estimates.albedo(
            samples, estimates.part_of(point_normals, part), stderr_rad=typical
        ),
        progress=partial(dome.tell, "albedo"),
    )
    found = surface_errors.of_albedo(found, point_normals, surface, dome.pixel_mm)
    return {
        "point_r_d": found,
        "r_d": texture.map(
            found.values,
            found.stderr,
            found.valid,
            "1",
            "diffuse reflectance, camera RGB over that of a perfect white",
        ),
    }


def _lobes(
    evidence: Evidence, lumitexels: Samples, point_normals: PointValues, point_r_d: PointValues
) -> Mapping[str, Any]:
    folder = evidence.basis
    materials = brdf_tables.default() if folder is None else brdf_tables.load(folder)
    store = lumitexels.store
    rank = evidence.rank or BASIS_RANK
    good = np.flatnonzero(point_r_d.valid)
    if len(good) < rank:
        raise EvidenceError(f"lobes: only {len(good)} points have an albedo, expected {rank}")
    drawn = np.sort(np.random.default_rng(0).permutation(good)[:BASIS_POINTS])
    fitted = []
    for part, samples in store.chunks(estimates.chunk_points(store)):
        rows = drawn[(drawn >= part.start) & (drawn < part.stop)] - part.start
        if not len(rows):
            continue
        fitted.append(
            brdf_basis.fit_weights(
                estimates.surface_samples(
                    estimates.rows_of(samples, rows),
                    estimates.part_of(point_normals, part.start + rows),
                    estimates.part_of(point_r_d, part.start + rows),
                ),
                materials,
            ).weights
        )
    shares = _comparable(np.concatenate(fitted), materials, least=max(rank, 2 * BASIS_RANK))
    most = min(shares.shape)
    if rank > most:
        raise EvidenceError(f"rank: got {rank}, expected at most {most}; the data hold no more")
    mixes = {
        k: brdf_basis.reduce(shares, k, basis=materials)[1:]
        for k in sorted({*RECORDED_RANKS, rank})
        if k <= most
    }
    basis = materials.mixed(mixes[rank][0])
    found = lumitexels.collect(
        lambda part, samples: estimates.lobe_weights(
            samples,
            estimates.part_of(point_normals, part),
            estimates.part_of(point_r_d, part),
            basis,
        ),
        progress=partial(evidence.tell, "lobes"),
    )
    return {
        "basis": basis,
        "weights": found.values[:, :rank],
        "basis_file": _basis_bytes(materials, rank, mixes),
    }


def _comparable(shares: Float64Array, materials: BrdfBasis, *, least: int) -> Float64Array:
    """Return mixtures scaled to reflect equally much, without those that no sample holds down.

    A lobe so narrow that no pair of light and view met it can have any share.
    """
    total = shares @ materials.strength()
    some = total[total > 0]
    usual = float(np.median(some)) if len(some) else 0.0
    kept = (total > 0) & (total < MAX_RELATIVE_STRENGTH * usual)
    if np.count_nonzero(kept) < least:
        raise EvidenceError(
            f"lobes: {np.count_nonzero(kept)} of {len(shares)} points show how the surface "
            f"reflects, expected at least {least}; more lights or views would show it"
        )
    return shares[kept] / total[kept, None]


def _basis_bytes(
    materials: BrdfBasis, rank: int, mixes: Mapping[int, tuple[Float64Array, float]]
) -> bytes:
    """Keep the lobes, and of every rank the mixtures of materials that they would be."""
    mix = mixes[rank][0]
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        materials=np.array(materials.names),
        mix=mix,
        table=materials.mixed(mix).table[..., :rank],
        light_radius_rad=materials.light_radius_rad,
        ranks=np.array(list(mixes)),
        error_by_rank=np.array([error for _, error in mixes.values()]),
        mix_by_rank=np.concatenate([mix for mix, _ in mixes.values()]),
    )
    return stream.getvalue()


def _refined(
    dome: Dome,
    surface: RefinedScan,
    lumitexels: Samples,
    point_normals: PointValues,
    point_r_d: PointValues,
    basis: BrdfBasis,
    weights: Float64Array,
    texture: SurfaceTexture,
) -> Mapping[str, SkinMap]:
    started = lumitexels.collect(
        lambda part, samples: estimates.normals_from_remainder(
            samples,
            estimates.part_of(point_normals, part),
            estimates.part_of(point_r_d, part),
            weights[part],
            basis,
        ),
        progress=partial(dome.tell, "normals by what lobes leave"),
    )
    known = point_normals.valid & point_r_d.valid
    inside = PointValues(
        np.where(started.valid[:, None], started.values, point_normals.values),
        np.where(started.valid[:, None], started.stderr, point_normals.stderr),
        known,
    )
    found, rank = inside, weights.shape[1]
    for turn in range(N_REFINEMENTS):
        normals, shares = found, weights
        found = lumitexels.collect(
            lambda part, samples, n=normals, w=shares: estimates.normals_from_all_light(  # type: ignore[misc]
                samples,
                estimates.part_of(inside, part),
                estimates.part_of(point_r_d, part),
                w[part],
                basis,
                now=n.values[part],
            ),
            progress=partial(dome.tell, f"normals by all light, {turn + 1} of {N_REFINEMENTS}"),
        )
        fitted = lumitexels.collect(
            lambda part, samples, n=found: estimates.lobe_weights(  # type: ignore[misc]
                samples, estimates.part_of(n, part), estimates.part_of(point_r_d, part), basis
            ),
            progress=partial(dome.tell, f"lobes, {turn + 1} of {N_REFINEMENTS}"),
        )
        weights = fitted.values[:, :rank]
    maps = {
        name: texture.map(
            fitted.values[:, k], fitted.stderr[:, k], fitted.valid, "1", "share of a common mixture"
        )
        for k, name in enumerate(weight_names(rank))
    }
    maps["lobe_residual"] = texture.map(
        fitted.values[:, rank], None, fitted.valid, "1/sr", "weighted RMS of samples - model"
    )
    found = surface_errors.of_normals(found, surface, dome.pixel_mm)
    return {"normals_refined": texture.normals(found, "by the whole model, world frame"), **maps}
