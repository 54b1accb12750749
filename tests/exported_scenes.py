"""Render exported scenes of Mitsuba in new processes, and compare block sums of their images."""

import json
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
from scipy import stats

from rigsim.mitsuba.startup import share_kernels
from rigsim.mitsuba.variant import choose_variant

ROOT = Path(__file__).parents[1]
RUNS, SAMPLES, BLOCK = 24, 32, 8
SYSTEMATIC = 1e-3
FALSE_ALARM = 1e-3
RENDER = f"""
import json
import sys
import numpy as np
import mitsuba as mi
mi.set_variant(sys.argv[1])
if sys.argv[6]:
    sys.path.insert(0, sys.argv[6])
    import rigsim.mitsuba
scene = mi.load_file(sys.argv[2], light=sys.argv[3], **json.loads(sys.argv[7]))
sensor, count = int(sys.argv[4]), int(sys.argv[8])
runs = [mi.render(scene, sensor=sensor, spp={SAMPLES}, seed=k) for k in range(count)]
np.save(sys.argv[5], np.stack([np.array(mi.TensorXf(run).numpy()) for run in runs]))
ours = {{name.split(".")[0] for name in sys.modules}} & {{"rigsim", "skinrig"}}
assert bool(ours) == bool(sys.argv[6])
"""


def render(folder, light, sensor, file="scene-stock.xml", *, is_exact=False, **parameters):
    """Return images of `RUNS` seeds by a new process, with plugins unless materials are stock.

    The image of an exact integrator, which draws nothing at random, stands for all seeds.
    """
    out = folder / "images.npy"
    choice = choose_variant("rgb")
    plugins = "" if "stock" in file else str(ROOT)
    arguments = [choice.name, str(folder / file), light, str(sensor), str(out), plugins]
    arguments.append(json.dumps({name: str(value) for name, value in parameters.items()}))
    arguments.append("1" if is_exact else str(RUNS))
    environment = {"DRJIT_LIBLLVM_PATH": choice.library, "HOME": str(folder.parent)}
    share_kernels(environment)
    done = subprocess.run(
        [sys.executable, "-I", "-c", RENDER, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    images = np.load(out)
    return np.broadcast_to(images, (RUNS, *images.shape[1:]))


def sum_blocks(images):
    height, width = (BLOCK * (n // BLOCK) for n in images.shape[-3:-1])
    cut = images[..., :height, :width, :].astype(np.float64)
    grid = (*images.shape[:-3], height // BLOCK, BLOCK, width // BLOCK, BLOCK, 3)
    return cut.reshape(grid).sum(axis=(-4, -2))


def worst_z(found, runs):
    """Return the largest |z| of the blocks that Mitsuba lights, and its limit."""
    ours, deviation = found
    sums = sum_blocks(runs)
    mean, stderr = sums.mean(axis=0), sums.std(axis=0, ddof=1) / math.sqrt(RUNS)
    lit = mean > 1e-3 * mean.max()
    error = np.sqrt(stderr**2 + deviation**2 + (SYSTEMATIC * mean) ** 2)
    limit = stats.t.isf(0.5 * (1.0 - (1.0 - FALSE_ALARM) ** (1.0 / lit.sum())), RUNS - 1)
    return np.abs((ours - mean)[lit] / error[lit]).max(), limit


def replace_in(file, pattern, new):
    def edit(folder):
        text, count = re.subn(pattern, new, (folder / file).read_text())
        assert count == 1
        (folder / file).write_text(text)

    return edit


def change_map(name, change):
    def edit(folder):
        path = folder / "textures" / f"{name}.exr"
        with OpenEXR.File(str(path)) as file:
            channels = {key: np.array(one.pixels) for key, one in file.channels().items()}
        (key,) = channels
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {key: change(channels[key])}) as file:
            file.write(str(path))

    return edit
