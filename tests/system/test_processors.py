"""Estimates of each rig differ little between this processor and one without vector instructions.

Kernels may contract products and sums, and some reorder sums: their bytes depend on the processor.
Whole reconstructions are compared by tools/judge_processors.py.
"""

import os
import subprocess
import sys

import numpy as np
import pytest

SCRIPT = """
import sys
import numpy as np
from numba.core.registry import cpu_target
from numpy._core._multiarray_umath import __cpu_features__ as numpy_features
from threadpoolctl import threadpool_info
from model import color_table
from reconstruction import chromophores, gradient_normals, photometric_stereo, subsurface

rng = np.random.default_rng(4)
normal = rng.normal(size=(24, 24, 3)) * 0.3 + [0.0, 0.0, 1.0]
normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
light = rng.normal(size=(24, 3)) * 0.5 + [0.0, 0.0, 1.0]
light /= np.linalg.norm(light, axis=-1, keepdims=True)
image = 0.5 * np.clip(np.einsum("hwk,nk->nhw", normal, light), 0.0, None)
image *= rng.normal(1.0, 0.01, image.shape)
dome = photometric_stereo.estimate_normals(image.astype(np.float32), light)

way = 2.0 * normal[..., 2:] * normal - [0.0, 0.0, 1.0]
weights = {"full": np.ones((24, 24)), **{n: (1 + way[..., k]) / 2 for k, n in enumerate("xyz")}}
patterns = {(name, "crossed"): np.full((24, 24), 0.5) for name in weights}
for name, weight in weights.items():
    patterns[name, "parallel"] = 0.5 + 0.1 * weight * rng.normal(1.0, 0.01, weight.shape)
sphere = gradient_normals.from_patterns(patterns)

radius_mm = np.linspace(0.5, 4.0, 8)
profiles = np.exp(-radius_mm * rng.uniform(0.8, 1.5, (12, 1))) / radius_mm**2
profiles *= rng.normal(1.0, 0.01, profiles.shape)
probe = subsurface.invert(radius_mm, profiles, method="diffusion")
found = {"dome": dome.normals, "gradient": sphere.normals, "probe": probe.sigma_tr_per_mm}
table = color_table.build("Nikon 5100 (NPL)", "D65", exact_optics=True)
amounts = rng.uniform(0.01, 0.06, (2, 12, 12))
found["flash"] = chromophores.invert(0.8 * table.lookup(*amounts), table).melanin
_, name, features = cpu_target.target_context.codegen().magic_tuple()
used = [one for one in features.split(",") if one.startswith("+")]
used += [one for one in ("X86_V3", "X86_V4", "AVX512_ICL", "AVX512_SPR") if numpy_features[one]]
libraries = [one["architecture"] for one in threadpool_info() if one["user_api"] == "blas"]
np.savez(sys.argv[1], processor=[name, *libraries], vector=np.array(used, str), **found)
"""
GENERIC = {
    "NUMBA_CPU_NAME": "generic",
    "OPENBLAS_CORETYPE": "Prescott",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
}
MAX_RELATIVE_DIFFERENCE = 1e-5
"""Of the largest value; single precision rounds at 6e-8."""
MAX_REPEATED_DIFFERENCE = 1e-6
"""The same between a process that compiles kernels and one that loads them."""


def estimate(path, **variables):
    command = [sys.executable, "-W", "ignore", "-c", SCRIPT, str(path)]
    subprocess.run(command, env={**os.environ, **variables}, check=True)
    with np.load(path) as found:
        return dict(found)


@pytest.mark.long
def test_estimates_agree_between_processors(tmp_path):
    own = estimate(tmp_path / "own.npz")
    generic = estimate(tmp_path / "generic.npz", **GENERIC)
    again = estimate(tmp_path / "again.npz")
    # OpenBLAS names the first of its processors without AVX
    assert set(generic.pop("processor")) <= {"generic", "Prescott", "Katmai"}
    assert generic.pop("vector").size == 0
    assert "generic" not in own.pop("processor")
    assert own.pop("vector").size > 0
    for name, values in own.items():
        scale = np.nanmax(np.abs(values))
        assert np.isfinite(values).mean() > 0.5
        np.testing.assert_array_equal(np.isfinite(values), np.isfinite(generic[name]))
        repeated = np.nanmax(np.abs(values - again[name]))
        assert repeated <= MAX_REPEATED_DIFFERENCE * scale, name
        apart = np.nanmax(np.abs(values - generic[name]))
        assert apart <= MAX_RELATIVE_DIFFERENCE * scale, name
