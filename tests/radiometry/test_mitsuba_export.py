"""The exported scenes of a session, rendered by Mitsuba, against the project's compiled renderer.

Rationale: the export has the face, LEDs and cameras of a simulated session. A process that imports
nothing of the project renders it with stock materials, another with the project's plugins. The
compiled renderer, which does not use Mitsuba's materials, renders the same; for stock materials
without vellus hair and with point LEDs, which these lack. All have hair, relief and shadows.
Expected: sums over blocks of 8 x 8 pixels agree. Tolerance: Student's t with Sidak's correction,
false alarm 1e-3 a test, after 0.1 % of each block for what differs by design (normals from
triangles' frames against the rig's frame), fixed beforehand.
"""

import dataclasses
import json
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from scipy import stats

from capture.session import Session
from rigsim.as_built.dome import build_dome
from rigsim.mitsuba.variant import choose_renderer, choose_variant
from rigsim.needs.effects import SceneEffects
from rigsim.population import files as subject_file
from rigsim.scenes.dome.scene import DomeScene
from skinrig.exporting import export as exporting
from skinrig.simulating.simulation import simulate_session

pytestmark = [pytest.mark.render, pytest.mark.long]

ROOT = Path(__file__).parents[2]
RUNS, SAMPLES, BLOCK = 24, 32, 8
SYSTEMATIC = 1e-3
FALSE_ALARM = 1e-3
SEED = 3
RENDER = f"""
import sys
import numpy as np
import mitsuba as mi
mi.set_variant(sys.argv[1])
if sys.argv[6]:
    sys.path.insert(0, sys.argv[6])
    import rigsim.mitsuba
scene = mi.load_file(sys.argv[2], light=sys.argv[3])
runs = [mi.render(scene, sensor=int(sys.argv[4]), spp={SAMPLES}, seed=k) for k in range({RUNS})]
np.save(sys.argv[5], np.stack([np.array(mi.TensorXf(run).numpy()) for run in runs]))
ours = {{name.split(".")[0] for name in sys.modules}} & {{"rigsim", "skinrig"}}
assert bool(ours) == bool(sys.argv[6])
"""


class LocalReflection(DomeScene):
    """What `scene.xml` has: local reflection of direct light, by the compiled renderer."""

    def __init__(self, rig, subject, dome, subpixels):
        super().__init__(
            rig,
            subject,
            dome=dome,
            subpixels=subpixels,
            effects=SceneEffects(lateral=False, interreflections=False, optics=False),
            choice=choose_renderer("fast"),
        )


class StockReflection(LocalReflection):
    """What the stock scene has: the same of points of light, without vellus hair."""

    def __init__(self, rig, subject, dome, subpixels):
        lights = tuple(dataclasses.replace(one, radius_mm=1e-3) for one in dome.rig.lights)
        points = dataclasses.replace(dome, rig=dataclasses.replace(dome.rig, lights=lights))
        super().__init__(rig, subject, points, subpixels)

    def _surface(self, camera):
        surface = super()._surface(camera)
        return dataclasses.replace(surface, fuzz=np.zeros_like(surface.fuzz))


REFERENCES = {"scene.xml": LocalReflection, "scene-stock.xml": StockReflection}


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    out = tmp_path_factory.mktemp("dome") / "session-dome"
    simulate_session("dome", out, seed=SEED, subject="V", lights=3, views=2, width_px=96)
    return Session.open(out)


@pytest.fixture
def scene_folder(session, tmp_path):
    out = tmp_path / "scene"
    exporting.export(session.path, out, "mitsuba", use="research")
    return out


def render(folder, light, sensor, file="scene-stock.xml"):
    """Return the images of `RUNS` seeds by a new process, with plugins for `scene.xml` alone."""
    out = folder / "images.npy"
    choice = choose_variant("rgb")
    plugins = str(ROOT) if file == "scene.xml" else ""
    arguments = [choice.name, str(folder / file), light, str(sensor), str(out), plugins]
    environment = {"DRJIT_LIBLLVM_PATH": choice.library, "HOME": str(folder.parent)}
    done = subprocess.run(
        [sys.executable, "-I", "-c", RENDER, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return np.load(out)


def sum_blocks(images):
    height, width = (BLOCK * (n // BLOCK) for n in images.shape[-3:-1])
    cut = images[..., :height, :width, :].astype(np.float64)
    grid = (*images.shape[:-3], height // BLOCK, BLOCK, width // BLOCK, BLOCK, 3)
    return cut.reshape(grid).sum(axis=(-4, -2))


def render_ours(session, light, sensor, file="scene-stock.xml"):
    """Return block sums at the finest grid of rays, and their deviation over three grids."""
    dome = build_dome(session.rig, seed=session.seed)
    face = subject_file.load_subject("V").face(seed=SEED, size=512)
    view = session.rig.views[sensor].name
    sums = [
        sum_blocks(
            REFERENCES[file](session.rig, face, dome, subpixels).radiance(view, [light])[0]
            / dome.gain[view]
        )
        for subpixels in (6, 7, 8)
    ]
    return sums[-1], np.std(sums, axis=0, ddof=1)


def worst_z(found, runs):
    """Return the largest |z| of the blocks that Mitsuba lights, and its limit."""
    ours, deviation = found
    sums = sum_blocks(runs)
    mean, stderr = sums.mean(axis=0), sums.std(axis=0, ddof=1) / math.sqrt(RUNS)
    lit = mean > 1e-3 * mean.max()
    error = np.sqrt(stderr**2 + deviation**2 + (SYSTEMATIC * mean) ** 2)
    limit = stats.t.isf(0.5 * (1.0 - (1.0 - FALSE_ALARM) ** (1.0 / lit.sum())), RUNS - 1)
    return np.abs((ours - mean)[lit] / error[lit]).max(), limit


@pytest.fixture(scope="module")
def ours(session):
    return render_ours(session, 0, 0)


@pytest.mark.parametrize("file", list(REFERENCES))
@pytest.mark.parametrize(("light", "sensor"), [(0, 0), (1, 0), (2, 1)])
def test_mitsuba_renders_the_projects_image(session, scene_folder, file, light, sensor):
    runs = render(scene_folder, session.rig.lights[light].name, sensor, file)
    worst, limit = worst_z(render_ours(session, light, sensor, file), runs)
    print(f"{file} {light} {sensor}: {worst:.2f} of {limit:.2f}")
    assert worst < limit


def flip_texture(folder):
    scene = folder / "scene-stock.xml"
    flipped = '<boolean name="flip_tex_coords" value="false" />'
    text, count = re.subn(r'<boolean name="flip_tex_coords" [^>]*>', flipped, scene.read_text())
    assert count == 1
    scene.write_text(text)


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


DEFECTS = {
    "flipped texture": flip_texture,
    "green of normals reversed": change_map(
        "stock_normals", lambda n: np.float32([0, 1, 0]) + np.float32([1, -1, 1]) * n
    ),
    "3 % rougher": change_map("roughness", lambda m: np.float32(1.03) * m),
    "1 % paler": change_map("stock_diffuse", lambda m: np.float32(1.01) * m),
}


@pytest.mark.parametrize("defect", list(DEFECTS))
def test_defects_of_the_export_are_detected(session, scene_folder, ours, defect):
    DEFECTS[defect](scene_folder)
    runs = render(scene_folder, session.rig.lights[0].name, 0)
    worst, limit = worst_z(ours, runs)
    print(f"{defect}: {worst:.2f} of {limit:.2f}")
    assert worst > limit


@pytest.mark.parametrize("file", list(REFERENCES))
def test_scenes_miss_the_session_by_few_percent(session, scene_folder, file):
    """Interreflections, lateral scattering and lens, for stock also vellus hair and discs."""
    dome = build_dome(session.rig, seed=session.seed)
    face = subject_file.load_subject("V").face(seed=SEED, size=512)
    view = session.rig.views[0].name
    scene = DomeScene(session.rig, face, dome=dome, subpixels=6)
    full = sum_blocks(scene.radiance(view, [0])[0] / dome.gain[view])
    found = sum_blocks(render(scene_folder, session.rig.lights[0].name, 0, file)).mean(axis=0)
    missed = np.sqrt(np.mean((found - full) ** 2)) / full.mean()
    print(f"{file}: {100 * missed:.1f} % of the mean")
    assert 0.001 < missed < 0.1
    document = json.loads((scene_folder / "mitsuba.json").read_text())
    assert ["lateral scattering in skin", "interreflection"] == [
        name for name, _ in document["left_out"][:2]
    ]
