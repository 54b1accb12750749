"""Processes that render: they share kernels, read images on one core, and ignore threads."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from rigsim.mitsuba.memory import pad_memory
from rigsim.mitsuba.startup import share_kernels
from rigsim.mitsuba.variant import choose_variant

ROOT = Path(__file__).parents[4]

SCENE = """
import json, os, sys
import numpy as np
from capture.rig import load_rig
from rigsim.mitsuba.scene_radiance import radiance
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import choose_variant
from rigsim.scenes.dome.reference import DirectScene, PlainScene, describe_dome, plain_face
mi = load_mitsuba(choose_variant("rgb"))
import drjit as dr
rig = load_rig("dome").resized(64).subset(views=["C02"])
face = plain_face(size=64)
def render(seed=0):
    plain = describe_dome(PlainScene(rig, face), rig.views[0], "path")
    return [
        DirectScene(rig, face).radiance("C02", [3, 40]),
        *(radiance(plain, kind="rgb", samples=n, seed=seed) for n in (16, 24, 100)),
    ]
"""

COMPILED = (
    SCENE
    + """
dr.set_flag(dr.JitFlag.KernelHistory, True)
render()
kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
print(json.dumps(sum(not k["cache_hit"] for k in kernels)))
"""
)

THREADED = (
    SCENE
    + """
import hashlib
import numba
from rigsim.as_built.probe import build_probe
from rigsim.mitsuba.variant import choose_renderer
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.flash.scene import FlashScene
from rigsim.scenes.gradient.reference import NEUTRAL_GRIP
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.scenes.probe.detector import render_fiber_images
from rigsim.scenes.reference.flat_layers import describe_flat_layers, render_voxels
from rigsim.skin_patch.microrelief import make_micro_skin
from rigsim.subject import make_subject
from rigsim.tissue.tissue_mc import Layer, LayerStack
person = make_subject("III", size=128)
small = load_rig("dome").resized(96).subset(views=["C02"])
layers = LayerStack((Layer(0.1, 1.0, 9.0, 0.8, 1.4),))
patch = make_micro_skin("cheek", seed=3, size_mm=1.2)
def render_all():
    sessions = []
    for renderer in ("mitsuba", "fast"):
        choice = choose_renderer(renderer)
        flash = FlashScene(load_rig("flash").resized(48), person, choice=choice)
        gradient = GradientScene(load_rig("gradient").cropped(64), patch, choice=choice)
        assert {flash.variant.renderer, gradient.variant.renderer} == {renderer}
        sessions += [
            DomeScene(small, person, choice=choice).radiance("C02", [3, 70]),
            flash.radiance("parallel"),
            flash.radiance("crossed"),
            gradient.stokes(NEUTRAL_GRIP),
        ]
    probe = load_rig("probe")
    render_fiber_images.cache_clear()
    sessions.append(render_fiber_images(build_probe(probe, seed=0), probe.views[0]))
    return [*sessions, *render_seeded()]
def render_seeded(seed=0):
    return [*render(seed), render_voxels(describe_flat_layers(layers), samples=16, seed=seed)]
def digest(images):
    assert all(np.max(image) > 0.0 for image in images)
    return [hashlib.sha256(np.ascontiguousarray(image).tobytes()).hexdigest() for image in images]
found = []
for count in (1, 3):
    dr.set_thread_count(count)
    assert dr.thread_count() == count
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
    found.append(digest(render_all()))
print(json.dumps([found, digest(render_seeded(seed=1))]))
"""
)

ONE_CORE = """
import json, os, sys
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import choose_variant
mi = load_mitsuba(choose_variant("rgb"))
print(json.dumps(list(mi.Bitmap(sys.argv[1]).size())))
"""

needs_llvm = pytest.mark.skipif(
    not choose_variant("rgb").is_vectorized, reason="kernels are compiled by LLVM alone"
)


def run(script, *arguments, timeout_s=240, **environment):
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments],
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@needs_llvm
@pytest.mark.render
@pytest.mark.long
def test_second_process_compiles_nothing(tmp_path):
    folder = str(tmp_path / "kernels")
    assert run(COMPILED, DRJIT_CACHE_DIR=folder) > 5
    # memory that is aligned by chance, or parts in the order of threads, would compile some again
    for _ in range(3):
        assert run(COMPILED, DRJIT_CACHE_DIR=folder) == 0


@needs_llvm
@pytest.mark.render
@pytest.mark.long
def test_images_do_not_depend_on_threads():
    """Images of sessions of all rigs by both renderers, `olat`, `path` and `tissue`."""
    found, other_seed = run(THREADED, NUMBA_NUM_THREADS="3")
    one, three = found
    assert len(one) == 14
    assert three == one
    unchanged = [a == b for a, b in zip(one[-5:], other_seed, strict=True)]
    assert unchanged == [True] + [False] * 4


@pytest.mark.render
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs sched_setaffinity")
def test_image_is_read_on_one_core(tmp_path):
    path = tmp_path / "ones.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Y": np.ones((512, 256), np.float32)}) as file:
        file.write(str(path))
    assert run(ONE_CORE, str(path), timeout_s=60) == [256, 512]


def test_kernels_go_to_the_users_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    environment = {}
    share_kernels(environment)
    assert environment == {"DRJIT_CACHE_DIR": str(tmp_path / "skinrig" / "drjit")}
    assert Path(environment["DRJIT_CACHE_DIR"]).is_dir()
    share_kernels(asked := {"DRJIT_CACHE_DIR": "elsewhere"})
    assert asked == {"DRJIT_CACHE_DIR": "elsewhere"}


def test_missing_user_cache_leaves_drjits_own(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    environment = {}
    share_kernels(environment)
    assert environment == {}


@pytest.mark.parametrize("dtype", [np.float32, np.uint32, np.float64])
@pytest.mark.parametrize("size", [1, 17, 1000])
def test_padded_memory_is_aligned_and_equal(dtype, size):
    values = np.arange(size).astype(dtype)
    for _ in range(8):  # allocations differ in their alignment
        row = pad_memory(values)
        assert row.ctypes.data % 64 == 0
        assert row.dtype == dtype
        np.testing.assert_array_equal(row, values)
