"""List the kernels of the rigs' longest steps, with the commands that call them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import kernel_costs
from kernel_costs import Cost


@dataclass(frozen=True)
class Kernel:
    """A function whose calls are measured."""

    steps: tuple[tuple[str, str], ...]
    """Rig and step."""
    module: str
    name: str
    """Function, or class and method."""
    item: str
    count: Callable[..., float]
    """Items of a call, by its arguments."""
    cost: Callable[..., Cost] | None = None
    """Least work of a call; None where no limit of the machine applies."""
    reason: str = ""
    """Why a kernel without a limit, or below half of it, stays so."""
    keeps_last: bool = False
    """Whether the last of equally large calls is measured: the first frames are dark."""
    makes: bool = False
    """Whether the function returns the kernel, of an element type."""
    prepare: Callable[..., tuple[Any, ...]] = lambda *args: args
    """Arguments that make the number of passes a known one."""

    @property
    def label(self) -> str:
        """Module, with its folder, and function."""
        return ".".join([*self.module.split(".")[-2:], self.name])


STEPS: dict[tuple[str, str], tuple[str, ...]] = {
    ("flash", "capture"): tuple(
        "simulate flash --seed 0 --scale full --subject III --state neutral --width 1008"
        " --out {out}/session-skin".split()
    ),
    ("flash", "sequence"): tuple(
        "simulate flash --seed 0 --scale small --sequence smile --subject III --width 384"
        " --out {out}/session-sequence".split()
    ),
    ("flash", "curves"): tuple(
        "reconstruct {run}/session-sequence --maps perfusion_curves --out {out}/maps".split()
    ),
    ("dome", "white"): tuple(
        "simulate dome --seed 0 --target white --width 1300 --lights 12 --views 2"
        " --out {out}/session-white".split()
    ),
    ("dome", "capture"): tuple(
        "simulate dome --seed 0 --subject III --width 1300 --lights 16 --views 1"
        " --out {out}/session-skin".split()
    ),
    ("dome", "reconstruct"): tuple(
        "reconstruct {run}/session-skin --calibration {run}/calibration --out {out}/maps"
        " --maps half_vector_normals,normals,normals_refined,r_d,basis_weight_0".split()
    ),
    ("gradient", "capture"): tuple(
        "simulate gradient --seed 0 --site forehead --angles 0 --steps 0..0 --width 1024"
        " --out {out}/session-skin".split()
    ),
    ("gradient", "reconstruct"): tuple(
        "reconstruct {run}/session-skin --calibration {run}/calibration --out {out}/maps"
        " --maps normals,height,crossed,histograms,kernels".split()
    ),
    ("probe", "capture"): tuple(
        "simulate probe --seed 0 --sites forehead --angles 2 --out {out}/session-skin".split()
    ),
}

FLASH = (("flash", "capture"), ("flash", "sequence"))
CAPTURES = (*FLASH, ("dome", "capture"), ("dome", "white"), ("gradient", "capture"))
DOME = (("dome", "reconstruct"),)
GRADIENT = (("gradient", "reconstruct"),)

BRANCHES = "branches of each pixel"

KERNELS = (
    Kernel(
        (*CAPTURES, ("probe", "capture")),
        "rigsim.sensor",
        "expose_sensor",
        "pixel",
        lambda irradiance_rgb, **_: irradiance_rgb.shape[0] * irradiance_rgb.shape[1],
        kernel_costs.expose,
        "Poisson numbers of means below 10 are not counted",
        keeps_last=True,
    ),
    Kernel(
        FLASH,
        "rigsim.render.lens_kernels",
        "gather",
        "pixel",
        lambda lookup, *_: lookup.size,
        kernel_costs.gather,
        "channels vary, so that sums stay in memory",
    ),
    Kernel(
        (("dome", "capture"),),
        "rigsim.render.lens_kernels",
        "gather_mosaics",
        "pixel",
        lambda *args: args[6].size,
        kernel_costs.gather_mosaics,
        "a weight is gathered per visit, and each sum waits for the one before it",
    ),
    Kernel(
        (*FLASH, ("dome", "capture")),
        "rigsim.render.lens_kernels",
        "find_layers",
        "pixel",
        lambda lookup, *_: lookup.size,
        kernel_costs.find_layers,
        f"{BRANCHES}; once per camera",
    ),
    Kernel(
        (("dome", "capture"),),
        "rigsim.mitsuba.olat",
        "_Olat.shade",
        "hit",
        lambda self, scene, hits, *_: hits.count,
        reason="shadow rays; their rate is not a limit of the machine",
    ),
    Kernel(
        FLASH,
        "rigsim.scenes.flash.surfaces",
        "MitsubaSurface.trace",
        "pixel",
        lambda self, view, subpixels, rows: (rows[1] - rows[0]) * view.width_px,
        reason="camera rays; their rate is not a limit of the machine",
    ),
    Kernel(
        FLASH,
        "rigsim.scenes.flash.surfaces",
        "MitsubaSurface.skin_stokes",
        "hit",
        lambda self, hits, *_: hits.count,
        reason="one fused kernel of Dr.Jit, whose operations are not listed",
    ),
    Kernel(
        FLASH,
        "rigsim.scenes.flash.surfaces",
        "CameraHits.average",
        "hit and channel",
        lambda self, rows: rows.size,
        kernel_costs.average_hits,
    ),
    Kernel(
        FLASH,
        "rigsim.scenes.flash.image",
        "_joined",
        "hit",
        lambda parts: len(next(iter(parts.values()))),
        kernel_costs.join_layers,
    ),
    Kernel(
        (("dome", "capture"),),
        "rigsim.light.relief_shadow",
        "_visible_fractions",
        "point and light",
        lambda *args: args[8].size,
        kernel_costs.visible_fractions,
        BRANCHES,
    ),
    Kernel(
        (("dome", "white"),),
        "rigsim.targets.printed_plate",
        "_light_plate",
        "pixel",
        lambda pixel, *_: len(pixel),
        kernel_costs.light_plate,
        "powers of the C library",
    ),
    Kernel(
        (("dome", "white"),),
        "rigsim.targets.printed_plate",
        "_trace_plate",
        "pixel",
        lambda rays, *_: (rays.shape[0] - 1) * (rays.shape[1] - 1),
        kernel_costs.trace_plate,
        f"{BRANCHES}; once per pose",
    ),
    Kernel(
        (*FLASH, ("dome", "capture")),
        "rigsim.light.lateral",
        "_flow",
        "texel and channel",
        lambda field, *_: field.size,
        kernel_costs.flow,
    ),
    Kernel(
        (*FLASH, ("gradient", "capture")),
        "rigsim.geometry.surface_noise",
        "_gradient_noise",
        "point",
        lambda points, *_: len(points),
        kernel_costs.gradient_noise,
        "a vector is gathered per corner",
    ),
    Kernel(
        FLASH,
        "rigsim.tissue.skin_color",
        "_lookup",
        "texel",
        lambda log_rgb, melanin, blood: len(melanin),
        kernel_costs.look_up_color,
    ),
    Kernel(
        (*FLASH, ("dome", "capture")),
        "rigsim.geometry.atlas",
        "_sample",
        "point",
        lambda texture, uv, mask: len(uv),
        kernel_costs.sample_texture,
        "latency of gathers",
    ),
    Kernel(
        (("gradient", "capture"),),
        "rigsim.light.hidden_sky_kernels",
        "add_sector_through",
        "pixel",
        lambda out, *_: out.size,
        kernel_costs.add_sector_through,
    ),
    Kernel(
        (("gradient", "capture"),),
        "rigsim.light.lobe_moments",
        "_lookup",
        "pixel",
        lambda *args: len(args[4]),
        kernel_costs.look_up_moments,
        "12 kB of a table per pixel, from the cache",
    ),
    Kernel(
        (("gradient", "capture"),),
        "rigsim.light.relief_shadow",
        "_sweep",
        "pixel",
        lambda field, *_: field.size,
        kernel_costs.sweep,
        "each pixel depends on the hull before it",
    ),
    Kernel(
        (("gradient", "capture"),),
        "rigsim.light.shadowed_lights",
        "_remove",
        "pixel and LED",
        lambda packed, elements, *_: len(elements[1]),
        reason="few pixels of an LED are hidden; branches",
    ),
    Kernel(
        DOME,
        "reconstruction.photometric_stereo.kernels",
        "fit_points",
        "sample",
        lambda samples, *_: samples[0].size,
        kernel_costs.fit_normals,
        "ranks by bisection",
        makes=True,
        prepare=kernel_costs.force_passes,
    ),
    Kernel(
        DOME,
        "reconstruction.photometric_stereo.half_vectors",
        "_estimate",
        "sample",
        lambda values, *_: values.size,
        kernel_costs.half_vectors,
        "branches: the brightest four of each view",
    ),
    Kernel(
        DOME,
        "reconstruction.diffuse_albedo.kernels",
        "fit_envelope",
        "sample",
        lambda f, *_: f.shape[0] * f.shape[1],
        kernel_costs.fit_envelope,
        "a bounded solution per point and step, for few samples per point at this size",
    ),
    Kernel(
        DOME,
        "reconstruction.brdf_basis.nnls_kernels",
        "fit_points",
        "sample",
        lambda table, materials, kinship, value, *_: value.size,
        kernel_costs.fit_basis,
        "the number of rounds depends on the data; the count has one",
    ),
    Kernel(
        DOME,
        "reconstruction.brdf_basis.mixture_kernels",
        "_mixtures",
        "sample",
        lambda *args: args[5].size,
        kernel_costs.mix_basis,
        "rows of the table are gathered from the cache",
    ),
    Kernel(
        DOME,
        "reconstruction.lumitexels.sample_kernels",
        "reproject",
        "sample",
        lambda samples, *_: samples[6].size,
        kernel_costs.reproject,
    ),
    Kernel(
        DOME,
        "reconstruction.lumitexels.sample_kernels",
        "shade",
        "sample",
        lambda samples, *_: samples[5].size,
        kernel_costs.shade,
        "branches of each sample",
    ),
    Kernel(
        DOME,
        "reconstruction.lumitexels.sample_kernels",
        "subtract_diffuse",
        "sample",
        lambda *args: args[5].size,
        kernel_costs.subtract_diffuse,
    ),
    Kernel(
        DOME,
        "reconstruction.lumitexels.store",
        "_assemble",
        "sample",
        lambda *args: args[3].size,
        kernel_costs.assemble,
        "the table is read across points",
    ),
    Kernel(
        DOME,
        "reconstruction.lumitexels.store",
        "_sample",
        "point and image",
        lambda *args: len(args[3]),
        kernel_costs.sample_image,
        "latency of gathers",
    ),
    Kernel(
        GRADIENT,
        "reconstruction.gradient_normals.occlusion",
        "_solve",
        "pixel",
        lambda relief, places, *_: places.shape[0] * places.shape[1],
        kernel_costs.solve_occlusion,
        "further steps where lights are hidden are not counted",
    ),
    Kernel(
        GRADIENT,
        "reconstruction.gradient_normals.kernels",
        "invert",
        "pixel",
        lambda parallel, *_: parallel.shape[1],
        kernel_costs.invert_moments,
        "the polarization of each pixel takes up to 17 rounds of Newton's steps",
    ),
    Kernel(
        GRADIENT,
        "reconstruction.gradient_normals.moment_kernels",
        "fit_moments",
        "pixel",
        lambda y, *_: y.shape[1],
        kernel_costs.fit_moments,
        "rows are copied to lanes and back",
    ),
    Kernel(
        GRADIENT,
        "reconstruction.normal_integration.multigrid_kernels",
        "smooth",
        "grid point",
        lambda ax, ay, inverse, b, x, odd: 0.5 * x.size,
        kernel_costs.smooth_grid,
    ),
    Kernel(
        GRADIENT,
        "reconstruction.normal_integration.multigrid_kernels",
        "smooth_from_zero",
        "grid point",
        lambda ax, ay, inverse, b, x: x.size,
        lambda ax, ay, inverse, b, x: Cost(
            kernel_costs.sum_bytes(ax, ay, inverse, b, x), float32=5 * x.size
        ),
        "every other point of rows that are read whole",
    ),
    Kernel(
        (("flash", "curves"),),
        "reconstruction.chromophores.posterior_kernels",
        "integrate_posteriors",
        "pixel",
        lambda rgb, *_: len(rgb),
        reason="branches: the ridge of each pixel is followed",
    ),
    Kernel(
        (("flash", "curves"),),
        "reconstruction.facial_color.shared_melanin_kernels",
        "fit_state_blood",
        "pixel and state",
        lambda colors, *_: colors.shape[0] * colors.shape[1],
        reason="branches: steps of each pixel until they converge",
    ),
    Kernel(
        (("flash", "curves"),),
        "reconstruction.facial_color.perfusion_fit",
        "fit_cycle",
        "fit",
        lambda *_, **__: 1.0,
        reason="interpreter: hundreds of fits of few numbers",
    ),
    Kernel(
        (("probe", "capture"),),
        "rigsim.world.world",
        "World.advance",
        "call",
        lambda *_: 1.0,
        reason="interpreter: events of simulated controllers, none is an array",
    ),
    Kernel(
        (("probe", "capture"),),
        "rigsim.fiber.walk",
        "walk_to_fibers",
        "photon",
        lambda *args: args[7],
        reason="random branches of each photon's walk",
    ),
)
