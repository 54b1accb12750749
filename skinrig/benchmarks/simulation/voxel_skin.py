"""Benchmark of the integrator `tissue`: voxel skin against the photon walk and `volpath`."""

from functools import partial
from typing import Final

import numpy as np

from rigsim.scenes.reference.flat_layers import (
    RenderedReflectance,
    VoxelIntegrator,
    describe_flat_layers,
    render_reflectance,
    render_voxels,
)
from rigsim.subject.person_skin import PersonSkin, layers
from rigsim.tissue.tissue_mc import LayerStack, trace_photons
from skinrig.arrays import Float64Array
from skinrig.benchmarks.measurement import measure_processor_time
from skinrig.benchmarks.results import ErrorEstimate, Timing
from skinrig.benchmarks.stage import BenchmarkStage

NO_MEMORY_REASON = "both integrators run in one process, which keeps their kernels"
WAVELENGTHS_NM: Final = (450.0, 540.0, 630.0)
CURVE_NM: Final = 540.0
BOUNDARY_ROUGHNESS: Final = 0.3
LIGHT_DEG: Final = 45.0
FACE_SITE: Final = "cheek"


def measure_voxel_skin(stage: BenchmarkStage) -> None:
    """Measure pixels of rough skin under one distant light, and R_d of smooth skin.

    The error is that of a pixel. Both integrators render the same scene, one band at a time.
    """
    skin = layers(PersonSkin.of_preset("III"), FACE_SITE, "neutral", CURVE_NM)
    render = partial(_render_pixels, skin)
    reference = RenderedReflectance(render("tissue", 256 if stage.toy else 16384, seed=99))
    cost = {}
    efforts = (16, 64) if stage.toy else (4, 16, 64, 256, 1024, 4096)
    ways: tuple[VoxelIntegrator, ...] = ("tissue", "volpath")
    for way in ways:
        render(way, 1, seed=0)  # compiles the kernel
        for samples in efforts:
            seconds, pixels = measure_processor_time(partial(render, way, samples, seed=samples))
            error = 100.0 * float(np.sqrt(np.mean(np.square(pixels / reference.reflectance - 1.0))))
            timing = Timing.single(seconds, no_memory_reason=NO_MEMORY_REASON)
            half = error / np.sqrt(2.0 * pixels.size)
            stage.add(
                {"way": way, "samples": samples}, timing, ErrorEstimate.symmetric(error, half)
            )
            cost[way] = seconds * error**2
    stage.reference_error = 100.0 * reference.stderr / reference.reflectance
    stage.limits["speed_up"] = cost["volpath"] / cost["tissue"]
    for wavelength_nm in WAVELENGTHS_NM:
        stack = layers(PersonSkin.of_preset("III"), FACE_SITE, "neutral", wavelength_nm)
        difference, stderr = _compare_with_walk(stack, toy=stage.toy)
        stage.limits["reflectance", wavelength_nm] = difference
        stage.limits["stderr", wavelength_nm] = stderr


def _render_pixels(
    stack: LayerStack, way: VoxelIntegrator, samples: int, *, seed: int
) -> Float64Array:
    scene = describe_flat_layers(
        stack, integrator=way, alpha=BOUNDARY_ROUGHNESS, light_deg=LIGHT_DEG
    )
    return render_voxels(scene, samples=samples, seed=seed)[..., 0].ravel()


def _compare_with_walk(stack: LayerStack, *, toy: bool) -> tuple[float, float]:
    """Return the difference of R_d from the photon walk and its standard error, %."""
    photons, samples = (20_000, 64) if toy else (4_000_000, 65_536)
    rng = np.random.default_rng(0)
    walked = trace_photons(stack, photons=photons, rng=rng, threads=2)
    found = render_reflectance(stack, samples=samples, seed=1)
    error = np.hypot(found.stderr, walked.reflectance_stderr)
    return (
        100.0 * abs(found.reflectance / walked.reflectance - 1.0),
        100.0 * float(error) / walked.reflectance,
    )
