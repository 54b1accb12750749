"""The exported scenes of sessions, rendered by Mitsuba, against the project's compiled formulas.

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
import shutil
from functools import cache

import numpy as np
import pytest
from exported_scenes import change_map, end_renderers, render, replace_in, sum_blocks, worst_z

from capture.session import Session
from rigsim.as_built.dome import build_dome
from rigsim.mitsuba.variant import choose_renderer
from rigsim.needs.effects import SceneEffects
from rigsim.population import files as subject_file
from rigsim.scenes.dome.scene import DomeScene
from skinrig.exporting import export as exporting
from skinrig.simulating.simulation import simulate_session
from skinrig.simulating.subject_records import COARSE_FACE_TEXELS

pytestmark = [pytest.mark.render, pytest.mark.long]

SEED = 3


class LocalReflection(DomeScene):
    """What `scene.xml` has: local reflection of direct light, by the compiled renderer."""

    def __init__(self, rig, subject, dome, subpixels):
        super().__init__(
            rig,
            subject,
            dome=dome,
            subpixels=subpixels,
            effects=SceneEffects(
                lateral=False, interreflections=False, optics=False, relief_shadows=False
            ),
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


@pytest.fixture(scope="module", autouse=True)
def ended_renderers():
    yield
    end_renderers()


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    out = tmp_path_factory.mktemp("dome") / "session-dome"
    simulate_session("dome", out, seed=SEED, subject="V", lights=3, views=2, width_px=96)
    return Session.open(out)


@pytest.fixture(scope="module")
def exported(session):
    out = session.path.parent / "scene"
    exporting.export(session.path, out, "mitsuba", use="research")
    return out


@pytest.fixture(scope="module")
def renders(session, exported):
    """Images of the exported scenes; each is rendered once."""

    @cache
    def render_once(file, light, sensor):
        return render(exported, session.rig.lights[light].name, sensor, file)

    return render_once


@pytest.fixture
def scene_folder(exported, tmp_path):
    return shutil.copytree(exported, tmp_path / "scene")


@pytest.fixture(scope="module")
def face():
    return subject_file.load_subject("V").face(seed=SEED, size=COARSE_FACE_TEXELS)


@pytest.fixture(scope="module")
def ours(session, face):
    """Block sums at the finest grid of rays, and their deviation over three grids; each once."""
    dome = build_dome(session.rig, seed=session.seed)

    @cache
    def scene(file, subpixels):
        return REFERENCES[file](session.rig, face, dome, subpixels)

    @cache
    def render_once(file, light, sensor):
        view = session.rig.views[sensor].name
        sums = [
            sum_blocks(scene(file, n).radiance(view, [light])[0] / dome.gain[view])
            for n in (6, 7, 8)
        ]
        return sums[-1], np.std(sums, axis=0, ddof=1)

    return render_once


@pytest.mark.parametrize("file", list(REFERENCES))
@pytest.mark.parametrize(("light", "sensor"), [(0, 0), (1, 0), (2, 1)])
def test_mitsuba_renders_the_projects_image(ours, renders, file, light, sensor):
    worst, limit = worst_z(ours(file, light, sensor), renders(file, light, sensor))
    print(f"{file} {light} {sensor}: {worst:.2f} of {limit:.2f}")
    assert worst < limit


flip_texture = replace_in(
    "scene-stock.xml",
    r'<boolean name="flip_tex_coords" [^>]*>',
    '<boolean name="flip_tex_coords" value="false" />',
)


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
    worst, limit = worst_z(ours("scene-stock.xml", 0, 0), runs)
    print(f"{defect}: {worst:.2f} of {limit:.2f}")
    assert worst > limit


@pytest.mark.parametrize("file", list(REFERENCES))
def test_scenes_miss_the_session_by_few_percent(session, face, exported, renders, file):
    """Interreflections, lateral scattering and lens, for stock also vellus hair and discs."""
    dome = build_dome(session.rig, seed=session.seed)
    view = session.rig.views[0].name
    scene = DomeScene(session.rig, face, dome=dome, subpixels=6)
    full = sum_blocks(scene.radiance(view, [0])[0] / dome.gain[view])
    found = sum_blocks(renders(file, 0, 0)).mean(axis=0)
    missed = np.sqrt(np.mean((found - full) ** 2)) / full.mean()
    print(f"{file}: {100 * missed:.1f} % of the mean")
    assert 0.001 < missed < 0.1
    document = json.loads((exported / "mitsuba.json").read_text())
    assert ["lateral scattering in skin", "interreflection"] == [
        name for name, _ in document["left_out"][:2]
    ]
