"""A process that compiles kernels gives the same bytes as one that loads them from the cache."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import hashlib
import numpy as np
from capture.hdr import merge
from reconstruction.photometric_stereo.estimation import estimate_normals

rng = np.random.default_rng(3)
times = np.geomspace(1e-4, 2.0, 7)
frames = [rng.integers(400, 18_000, (61, 43)).astype(np.uint16) for _ in times]
made = list(merge(frames, times, gain=2.0, read_noise=3.0, black=512, white=16_383))
lights = rng.normal(size=(40, 3)) * [0.4, 0.4, 0.2] + [0.0, 0.0, 1.0]
lights /= np.linalg.norm(lights, axis=1, keepdims=True)
normals = rng.normal(size=(3, 400)) * 0.3 + [[0.0], [0.0], [1.0]]
values = np.maximum(lights @ normals, 0.0) * (1.0 + 0.02 * rng.normal(size=(40, 400)))
for robust in (True, False):
    found = estimate_normals(values[:, :, None].astype(np.float32), lights, robust=robust)
    made += [found.normals, found.albedo, found.residual, found.stderr_rad]
for array in made:
    print(array.dtype, hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest())
"""


@pytest.mark.long
def test_compiled_and_cached_kernels_give_same_bytes(tmp_path):
    """Both kernels gave other last digits when their callees were not inlined."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}

    def run():
        command = [sys.executable, "-c", PROGRAM]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.splitlines()

    cold = run()
    written = sorted((path, path.stat().st_mtime_ns) for path in tmp_path.rglob("*.nbc"))
    assert len(written) >= 2
    assert run() == cold
    assert sorted((path, path.stat().st_mtime_ns) for path in tmp_path.rglob("*.nbc")) == written
