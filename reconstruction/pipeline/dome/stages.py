"""The dome's stages: images under one light each and a scan, to normals, albedo and lobes."""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial import cKDTree

from model.checks import Checks
from model.skin import SkinMap
from model.skin_reflectance import BASIS_FILE
from model.vectors import unit_vectors
from reconstruction import photometric_stereo
from reconstruction.lumitexels import SampledSurface
from reconstruction.lumitexels.ray_casting import RayCaster
from reconstruction.lumitexels.store import LumitexelStore, ViewSamples
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.dome.calibrated import CalibratedDome, load_dome, split_exposures
from reconstruction.pipeline.dome.images import DomeImages
from reconstruction.pipeline.dome.lobes import (
    BASIS_RANK,
    RECORDED_RANKS,
    SurfaceSampleStore,
    fit_lobes,
    refine_normals,
    weight_names,
)
from reconstruction.pipeline.dome.motion import DomeHeadMotion, follow_head
from reconstruction.pipeline.dome.registration import register_mesh
from reconstruction.pipeline.dome.stripes import (
    ScannerPoses,
    decode_scan,
    has_stripes,
    load_scanner,
)
from reconstruction.pipeline.hold_out import HoldOutError
from reconstruction.pipeline.inputs import Inputs, InputsError
from reconstruction.pipeline.skin_tone import maps as tone
from reconstruction.scan import mesh as scan_mesh
from reconstruction.scan.mesh import RefinedScan
from reconstruction.scan.repair import TriangleMesh
from reconstruction.surface import errors as surface_errors
from reconstruction.surface import estimates
from reconstruction.surface.estimates import PointValues
from reconstruction.surface.texture import SurfaceTexture
from reconstruction.tiles import MAX_WORKERS

STAGE_REVISION = 10
"""Grows when the code of a stage changes its result, so that older maps are recomputed."""

SCAN_FILE: Final = "scan.ply"
HOLE_MAP: Final = "hole_stderr"
"""Map of the standard error of the surface in closed holes of the scan."""
HOLE_NOTE: Final = "standard error across the surface in closed holes of the scan; 0: elsewhere"
MEMORY_BYTES: Final = 2**30
"""Sample tables above this size are stored in files, not in memory."""
FACE_AREA_MM2: Final = 60_000.0
"""Area of a face; over the area of a pixel on it, this gives the number of resolvable points."""
POINT_LIMITS: Final = (8_000, 1_000_000)
TEXTURE_LIMITS: Final = (128, 2048)


def map_names(rank: int = BASIS_RANK) -> tuple[str, ...]:
    """Return the names of the maps of a dome session."""
    first = ("position", HOLE_MAP, "half_vector_normals", "normals", "r_d")
    last = "lobe_residual", "normals_refined", "samples"
    return (*first, *weight_names(rank), *last, *tone.MAP_NAMES)


WEIGHT_NAMES = weight_names()
MAP_NAMES = map_names()
"""Maps of a dome session at the default rank."""
MESH_FILE = "mesh.obj"
FILE_NAMES = (MESH_FILE, BASIS_FILE)
"""Products of a dome session that are not maps."""


def graph(inputs: Inputs) -> list[stages.PipelineStage]:
    """Return the stages of a dome session; see `graph.run_stages`."""
    dome = _dome(inputs)
    striped = inputs.scan is None and has_stripes(inputs.session)
    scanner = load_scanner(inputs) if striped else None
    stage = inputs.stage_maker(STAGE_REVISION)
    if inputs.hold_out:
        stage = partial(stage, held_out=inputs.hold_out.record())
    rank = inputs.rank or BASIS_RANK
    weights = " ".join(weight_names(rank))
    unscaled = (
        "r_d: the lights are not calibrated and an albedo has no scale without them; run "
        "`skinrig calibrate lights` on sessions of the mirror spheres and the white target "
        "[SR-REC-008]"
    )
    refused = "" if dome.absolute else unscaled
    seen, turned = "surface lumitexels texture", "surface lumitexels point_normals texture"
    lit, lobes = "surface lumitexels point_normals point_r_d", "basis basis_file"
    refined = f"normals_refined {weights} lobe_residual {BASIS_FILE}"
    view, light = inputs.session.rig.views[0], inputs.session.rig.lights[0]
    spectra = {"camera": view.spectral_sensitivity, "illuminant": light.illuminant}
    return [
        stage("surface", "", "surface", partial(_surface, inputs, dome, scanner)),
        stage("texture", "surface", f"texture position {HOLE_MAP} {MESH_FILE}", _texture),
        stage("motion", "surface", "motion", partial(_motion, inputs, dome)),
        stage("lumitexels", "surface motion", "lumitexels", partial(_lumitexels, inputs, dome)),
        stage("half-vector normals", "lumitexels texture", "half_vector_normals", _half_vectors),
        stage("normals", seen, "point_normals normals samples", partial(_normals, dome)),
        stage("albedo", turned, "point_r_d r_d", partial(_albedo, dome), refused),
        stage(
            "lobes", lit, lobes, partial(fit_lobes, inputs), rank=rank, ranks=list(RECORDED_RANKS)
        ),
        stage("refined normals", f"{lit} {lobes} texture", refined, partial(refine_normals, dome)),
        stage("skin reflectance", "r_d", tone.REFLECTANCE_PRODUCT, tone.reflectance_of_albedo),
        stage("erythema", tone.REFLECTANCE_PRODUCT, "erythema_index", tone.erythema_map),
        # cameras of a dome are not calibrated by a chart: their nominal sensitivities are used
        *tone.tone_stages(stage, (None, None), refused=refused, **spectra),
    ]


def _dome(inputs: Inputs) -> CalibratedDome:
    """Return the dome with the images that are not held out."""
    images = DomeImages(inputs.session)
    held = inputs.hold_out = inputs.hold_out.resolve(images.lights, images.views)
    inputs.noted["held_out"] = held.record()
    if held:
        for field, there, least in (
            ("lights", images.lights, estimates.MIN_LIGHTS),
            ("views", images.views, estimates.MIN_VIEWS),
        ):
            left = len(there) - len(getattr(held, field))
            if left < least:
                raise HoldOutError(
                    f"hold-out: leaves {left} of {len(there)} {field}, expected at least {least}; "
                    "hold out fewer"
                )
        images = DomeImages(inputs.session, without=held)
    return load_dome(inputs, images)


def _surface(inputs: Inputs, dome: CalibratedDome, scanner: ScannerPoses | None) -> RefinedScan:
    """Clean the scan, close its holes, refine it, and register it to the dome."""
    session = inputs.session
    if scanner is None and inputs.scan is None and SCAN_FILE not in session.attachments():
        raise InputsError(
            f"session {session.id}: got no scan, expected one; add it with "
            "`skinrig import mesh FILE` [SR-REC-006]"
        )
    _require(dome)
    footprint = dome.pixel_mm
    points = int(np.clip(FACE_AREA_MM2 / footprint**2, *POINT_LIMITS))
    decoded = None if scanner is None else decode_scan(inputs, scanner)
    mesh: bytes | TriangleMesh
    if decoded is not None:
        mesh = decoded.mesh
        inputs.noted["scan"] = dict(decoded.record)
    else:
        mesh = session.attachment(SCAN_FILE) if inputs.scan is None else inputs.scan
    scan = scan_mesh.prepare_scan(mesh, points=points)
    fit = register_mesh(dome, scan.scanned_mesh())
    # a calibrated scanner places the face better than the images do, unless the head has moved
    # by more than one of their pixels
    shift_mm = np.linalg.norm(fit.move(scan.points_mm) - scan.points_mm, axis=1)
    moved = fit.is_significant() and float(np.sqrt(np.mean(shift_mm**2))) > footprint
    placed = decoded is not None and decoded.calibrated and not moved
    inputs.noted["registration"] = {
        "rotation": fit.rotation.tolist(),
        "translation_mm": fit.translation_mm.tolist(),
        "stderr_rad_mm": fit.stderr.tolist(),
        "residual_deg": fit.residual_deg,
        "converged": fit.outcome.converged,
        "points": len(scan.points_mm),
        "pixel_mm": footprint,
        "applied": not placed,
    }
    if decoded is not None:
        _, nearest = cKDTree(decoded.mesh.vertices_mm).query(scan.points_mm)
        moved_mm = 0.0 if placed else float(np.sqrt(np.mean(np.square(fit.stderr[3:]))))
        stderr = np.hypot(np.hypot(decoded.stderr_mm[nearest], moved_mm), scan.patch_stderr_mm)
        scan = replace(scan, stderr_mm=stderr.astype(np.float32))
    return scan if placed else scan.transform(fit.rotation, fit.translation_mm)


def _require(dome: CalibratedDome) -> None:
    """Refuse fewer views or lights than a point needs, and lights in one plane."""
    views, lights = len(dome.cameras), int(np.count_nonzero(dome.lights.valid))
    check = Checks(InputsError)
    least = estimates.MIN_VIEWS
    check.require(views >= least, "views", f"images of {views}", f"at least {least}; add views")
    least = estimates.MIN_LIGHTS
    enough = f"at least {least}; capture more lights"
    check.require(lights >= least, "lights", f"{lights} that can be used", enough)
    place = dome.lights.position_mm[dome.lights.valid]
    photometric_stereo.require_noncoplanar(unit_vectors(place))


def _texture(surface: RefinedScan) -> Mapping[str, Any]:
    side = 2 ** math.ceil(math.log2(math.sqrt(2.0 * len(surface.points_mm))))
    texture = SurfaceTexture.of(surface, size=int(np.clip(side, *TEXTURE_LIMITS)))
    points = surface.points_mm
    errors = surface.stderr_mm
    stderr = None if errors is None else np.repeat(errors[:, None], 3, axis=1)
    known = np.ones(len(points), bool)
    position = texture.map(points, stderr, known, "mm", "rig frame")
    patch = texture.map(surface.patch_stderr_mm, None, known, "mm", HOLE_NOTE)
    return {
        "texture": texture,
        "position": position,
        HOLE_MAP: patch,
        MESH_FILE: texture.wavefront(),
    }


def _motion(inputs: Inputs, dome: CalibratedDome, surface: RefinedScan) -> DomeHeadMotion | None:
    images = dome.images.split_exposures()
    found = follow_head(inputs.session, images, dome.cameras, surface, dome.pixel_mm)
    # without tracking frames it is not known whether the head held still
    inputs.noted["motion"] = {"tracking_frames": 0} if found is None else found.record()
    return found


def _lumitexels(
    inputs: Inputs, dome: CalibratedDome, surface: RefinedScan, motion: DomeHeadMotion | None
) -> SurfaceSampleStore:
    captures = dome.images.captures
    if motion is not None and not motion.still:
        captures = dome.images.split_exposures().captures
    count = len(surface.points_mm) * len(dome.cameras) * len(captures)
    if 12 * count <= MEMORY_BYTES:
        return sample_surface(dome, surface, motion)
    return sample_surface(dome, surface, motion, inputs.scratch_folder("lumitexels"))


def sample_surface(
    dome: CalibratedDome,
    surface: RefinedScan,
    motion: DomeHeadMotion | None,
    scratch: tuple[Path | None, object] = (None, None),
) -> SurfaceSampleStore:
    """Sample all images at the points of a surface.

    Parameters
    ----------
    dome
        Images, cameras and lights.
    surface
        Points and the mesh that shadows them.
    motion
        None: the head is fixed.
    scratch
        Folder for the tables, and an object that keeps it; None: in memory.
    """
    if motion is not None and motion.still:
        motion = None
    if motion is not None:
        dome = split_exposures(dome)
    folder, keeper = scratch
    store = LumitexelStore(
        SampledSurface(surface.points_mm, surface.normals),
        cameras=dome.cameras,
        lights=dome.lights,
        caster=RayCaster(surface.coarse.vertices_mm, surface.coarse.faces),
        poses=None if motion is None else motion.poses,
        binning=2,
        folder=folder,
    )
    usable = dome.lights.valid if motion is None else dome.lights.valid & motion.usable

    def sample(view: int) -> ViewSamples:
        for capture in np.flatnonzero(usable).tolist():
            image = dome.image(view, capture)
            store.add(view, capture, image.rgb, image.variance, image.valid)
        return store.view_samples(view)

    views = range(len(dome.cameras))
    sampled = dome.compute_tiles("lumitexels", views, sample, workers=MAX_WORKERS)
    for view, samples in enumerate(sampled):
        store.put_view(view, samples)
    return SurfaceSampleStore(store, keeper, len(dome.table.names), dome.compute_tiles)


def _half_vectors(lumitexels: SurfaceSampleStore, texture: SurfaceTexture) -> SkinMap:
    (found,) = lumitexels.collect(
        "half-vector normals", lambda _, samples: [estimates.normals_from_half_vectors(samples)]
    )
    return texture.normals(found, "as published, world frame")


def _normals(
    dome: CalibratedDome,
    surface: RefinedScan,
    lumitexels: SurfaceSampleStore,
    texture: SurfaceTexture,
) -> Mapping[str, Any]:
    found, counts = measure_normals(dome, surface, lumitexels)
    samples = texture.map(counts.values[:, 0], None, counts.valid, "1", "samples per point")
    normals = texture.normals(found, "world frame")
    return {"point_normals": found, "normals": normals, "samples": samples}


def measure_normals(
    dome: CalibratedDome, surface: RefinedScan, lumitexels: SurfaceSampleStore
) -> tuple[PointValues, PointValues]:
    """Estimate the normals at a surface's points, with all of their errors; count the samples."""
    found, counts = lumitexels.collect(
        "normals",
        lambda part, samples: (
            estimates.normals_from_shading(samples, surface.normals[part]),
            estimates.count_samples(samples),
        ),
    )
    return surface_errors.add_normal_errors(found, surface, dome.pixel_mm), counts


def _albedo(
    dome: CalibratedDome,
    surface: RefinedScan,
    lumitexels: SurfaceSampleStore,
    point_normals: PointValues,
    texture: SurfaceTexture,
) -> Mapping[str, Any]:
    found = measure_albedo(dome, surface, lumitexels, point_normals)
    what = "diffuse reflectance, camera RGB over that of a perfect white"
    r_d = texture.map(found.values, found.stderr, found.valid, "1", what)
    return {"point_r_d": found, "r_d": r_d}


def measure_albedo(
    dome: CalibratedDome,
    surface: RefinedScan,
    lumitexels: SurfaceSampleStore,
    point_normals: PointValues,
) -> PointValues:
    """Estimate R_d at a surface's points, with all of its errors."""
    good = point_normals.valid
    typical = float(np.median(point_normals.stderr[good, 0])) if good.any() else 0.02
    (found,) = lumitexels.collect(
        "albedo",
        lambda part, samples: [
            estimates.estimate_albedo(samples, point_normals[part], stderr_rad=typical)
        ],
    )
    found = surface_errors.add_albedo_errors(found, point_normals, surface, dome.pixel_mm)
    return surface_errors.add_interior_errors(found)
