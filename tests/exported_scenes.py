"""Render exported scenes of Mitsuba in processes of their own, and compare block sums of images."""

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
variant, plugins = sys.argv[1:]
mi.set_variant(variant)
if plugins:
    sys.path.insert(0, plugins)
    import rigsim.mitsuba
for line in sys.stdin:
    order = json.loads(line)
    scene = mi.load_file(order["file"], light=order["light"], **order["parameters"])
    settings = {{"sensor": order["sensor"], "spp": {SAMPLES}}}
    runs = [mi.render(scene, **settings, seed=k) for k in range(order["runs"])]
    np.save(order["out"], np.stack([np.array(mi.TensorXf(run).numpy()) for run in runs]))
    ours = {{name.split(".")[0] for name in sys.modules}} & {{"rigsim", "skinrig"}}
    assert bool(ours) == bool(plugins)
    print("rendered", flush=True)
"""
"""Program that renders the scenes that its input names, one per line."""
renderers = {}
"""Running processes by whether they have the project's plugins; their start takes seconds."""


def start_renderer(folder, *, with_plugins):
    choice = choose_variant("rgb")
    environment = {"DRJIT_LIBLLVM_PATH": choice.library, "HOME": str(folder)}
    share_kernels(environment)
    arguments = [choice.name, str(ROOT) if with_plugins else ""]
    with (folder / "renderer.txt").open("w") as errors:
        return subprocess.Popen(
            [sys.executable, "-I", "-c", RENDER, *arguments],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )


def end_renderers():
    """End the processes that render: each module of tests starts its own."""
    while renderers:
        with renderers.popitem()[1][0] as process:
            process.stdin.close()


def render(folder, light, sensor, file="scene-stock.xml", *, is_exact=False, **parameters):
    """Return images of `RUNS` seeds by a process with plugins, or without for stock materials.

    The image of an exact integrator, which draws nothing at random, stands for all seeds.
    """
    with_plugins = "stock" not in file
    if with_plugins not in renderers:
        made = start_renderer(folder.parent, with_plugins=with_plugins)
        renderers[with_plugins] = made, folder.parent / "renderer.txt"
    process, errors = renderers[with_plugins]
    order = {
        "file": str(folder / file),
        "out": str(folder / "images.npy"),
        "light": light,
        "sensor": sensor,
        "runs": 1 if is_exact else RUNS,
        "parameters": {name: str(value) for name, value in parameters.items()},
    }
    process.stdin.write(json.dumps(order) + "\n")
    process.stdin.flush()
    assert process.stdout.readline() == "rendered\n", errors.read_text()
    images = np.load(order["out"])
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
