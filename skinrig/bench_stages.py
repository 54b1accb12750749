"""Which stages can be measured, and running them."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from skinrig.benchmark import StageBenchmark, to_document
from skinrig.console import Console, plain

STAGES = {
    "chromophores": "bench_chromophores.inversion",
    "render-flash": "bench_flash.render",
    "render-dome": "bench_dome_render.render",
    "render-gradient": "bench_gradient_render.render",
    "skin-stretch": "bench_skin_stretch.stretched",
    "layered-reflectance": "bench_tissue.layered_reflectance",
    "color-table": "bench_tissue.table",
    "expression-alignment": "bench_alignment.aligned",
    "efficiency": "bench_efficiency.efficiency",
    "misalignment": "bench_alignment.misaligned",
    "shared-melanin": "bench_shared_melanin.inversion",
    "facial-color": "bench_facial_color.rig",
    "diffuse-albedo": "bench_brdf.albedo",
    "brdf": "bench_brdf.surface",
    "brdf-space": "bench_brdf_space.space",
    "reflectance": "bench_reflectance.model",
    "render-model": "bench_rendering.model",
    "normals": "bench_photometric.normals",
    "gradient-normals": "bench_gradient_normals.normals",
    "hdr": "bench_hdr.merging",
    "lumitexels": "bench_surface.lumitexels",
    "texture-fill": "bench_surface.filling",
    "head-motion": "bench_motion.motion",
    "dome-geometry": "bench_dome_calibration.geometry",
    "dome-lights": "bench_dome_calibration.lights",
    "light-order": "bench_light_order.light_order",
    "sphere-lights": "bench_gradient_calibration.sphere_lights",
    "fibre-readings": "bench_fibre_readings.fibre_readings",
    "normal-integration": "bench_integration.integration",
    "normal-histogram": "bench_kernels.histograms",
    "kernel-fit": "bench_kernels.search",
    "displacement-synthesis": "bench_synthesis.growth",
    "texture-matching": "bench_texture.matching",
    "editing": "bench_editing.editing",
    "microstructure": "bench_microstructure.truth",
    "microstructure-passes": "bench_microstructure.passes",
    "perfusion-curves": "bench_perfusion.curves",
    "probe-session": "bench_probe.session",
    "subsurface-fit": "bench_subsurface.tiers",
    "subsurface-batch": "bench_subsurface.batches",
    "subsurface-gather": "bench_subsurface_gather.gathering",
    "anisotropy": "bench_translucency.directions",
    "translucency": "bench_translucency.sites",
    "photon-transport": "bench_transport.photon_transport",
    "wrinkles": "bench_wrinkles.fitting",
    "wrinkle-sum": "bench_wrinkles.summing",
    "wrinkle-storage": "bench_wrinkles.storing",
    "wrinkle-weights": "bench_wrinkles.weighing",
}
"""Module and function of each; a module is imported, and its kernels compiled, when it is run."""


class BenchError(ValueError):
    """A stage that cannot be measured."""


def _function(name: str) -> Callable[..., StageBenchmark]:
    module, function = STAGES[name].split(".")
    found: Callable[..., StageBenchmark] = getattr(import_module(f"skinrig.{module}"), function)
    return found


def run_stages(
    names: Sequence[str] | None,
    *,
    budget_s: float,
    toy: bool,
    out: Path | None,
    console: Console,
) -> dict[str, Any]:
    """Measure stages and return the document of the run.

    Parameters
    ----------
    names
        Out of :data:`STAGES`; None runs all, as far as the budget goes.
    budget_s
        A stage that would begin after so many seconds is left out, and named.
    toy
        Smallest sizes, and no limit is judged: for checking that the benchmark runs.
    out
        Folder for ``bench.json``; None writes nothing.
    console
        Where results and progress go.

    Raises
    ------
    BenchError
        For an unknown stage.
    """
    chosen = list(names) if names else list(STAGES)
    for name in chosen:
        if name not in STAGES:
            raise BenchError(f"stage: got {name!r}, expected one of {', '.join(STAGES)}")
    start = time.perf_counter()
    done: list[StageBenchmark] = []
    left_out = []
    for name in chosen:
        if time.perf_counter() - start > budget_s:
            left_out.append([name, f"the budget of {budget_s:g} s was used up"])
            continue
        console.progress(f"bench {name}")
        done.append(_function(name)(toy=toy))
    document = to_document(done)
    document["toy"] = toy
    document["left_out"] = left_out
    if toy:
        for stage in document["stages"].values():
            stage["limits"] = []
        document["passed"] = True
    for stage in done:
        console.rows(
            (stage.name, "seconds", "cold s", "peak MB", stage.error_name, "Cramér-Rao"),
            [
                (
                    " ".join(f"{k}={v}" for k, v in point.knobs.items()),
                    point.timing.seconds, point.timing.cold_s, point.timing.peak_memory_mb,
                    point.error, point.cramer_rao_bound or "",
                )
                for point in stage.points
            ],
        )  # fmt: skip
        for limit in () if toy else stage.limits:
            word = "kept" if limit.passed else "MISSED"
            console.say(
                f"{word}: {limit.name}: {limit.got:.4g} {limit.unit} "
                f"({limit.sense} {limit.bound:g})"
            )
        for what, why in stage.left_out:
            console.say(f"left out: {what}: {why}")
        console.say()
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        text = json.dumps(plain(document), indent=1, sort_keys=True)
        (out / "bench.json").write_text(text + "\n", encoding="utf-8")
    return document
