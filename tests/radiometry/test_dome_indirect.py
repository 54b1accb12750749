"""Light from skin to skin against Mitsuba's path tracer, and light that bleeds sideways."""

import dataclasses
import math

import numpy as np
import pytest

from capture.rig import Rig, View, load_rig
from rigsim.arrays import Float32Array
from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import build_mesh
from rigsim.light.interreflection import Interreflection
from rigsim.mitsuba.scene_radiance import radiance
from rigsim.needs.effects import SceneEffects
from rigsim.render import Caster
from rigsim.scenes.dome import reference as dome_reference
from rigsim.scenes.dome.reference import MattScene
from rigsim.scenes.dome.scene import DomeScene
from rigsim.subject import make_subject

pytestmark = pytest.mark.render

LIGHT = 45


def matt_image(
    scene: MattScene, view: View, light: int, *, depth: int, samples: int, seed: int
) -> Float32Array:
    """Return one image of matt skin by Mitsuba's path tracer with several bounces, (H, W, 3).

    Parameters
    ----------
    scene
        The dome.
    view, light
        Camera, and index of the light, a point of intensity 1 per steradian.
    depth
        Surfaces on a path and the light: 2 is direct light alone.
    samples, seed
        Of Mitsuba.
    """
    subject = dome_reference._face(scene)
    description = dome_reference._camera_and_light(view) | {
        "integrator": {"type": "path", "max_depth": depth, "rr_depth": depth + 1},
        "face": {
            "type": "mesh",
            "mesh": subject.mesh,
            "bsdf": dome_reference._matte_material(scene.surface(view), subject),
        },
    }
    description["light"] = dict(
        description["light"], position=list(scene.rig.lights[light].position_mm)
    )
    return radiance(description, kind="rgb", samples=samples, seed=seed)[..., :3]


@pytest.fixture(scope="module")
def rig() -> Rig:
    return dome_reference.point_light_rig(load_rig("dome").resized(64).subset(views=["C02"]))


@pytest.mark.long
def test_light_by_way_of_other_skin_is_mitsubas(rig):
    """Rationale: eight surfaces deep minus direct light alone, with the same seeds, leaves what
    went from skin to skin: 1 % of the picture.
    Expected: the same sum. Tolerance: 10 % for the patches' size, stated with `PATCHES` (6 % was
    measured), and 3.3 standard errors of 12 runs, false alarm 1e-3.
    """
    face = dome_reference.plain_face("palest", size=512)
    view = rig.views[0]
    plain = MattScene(rig, face, subpixels=4)
    ours = MattScene(
        rig, face, subpixels=4, effects=SceneEffects(lateral=False, interreflections=True)
    )
    found = (ours.radiance("C02", [LIGHT]) - plain.radiance("C02", [LIGHT])).sum(axis=(0, 1, 2))
    found = found / plain.intensity(LIGHT) / math.pi
    runs = [
        [matt_image(plain, view, LIGHT, depth=depth, samples=64, seed=k) for depth in (8, 2)]
        for k in range(12)
    ]
    extra = np.array([(deep - flat).sum(axis=(0, 1), dtype=np.float64) for deep, flat in runs])
    mean, stderr = extra.mean(axis=0), extra.std(axis=0, ddof=1) / math.sqrt(len(extra))
    assert (stderr < 0.03 * mean).all()
    assert (np.abs(found / mean - 1.0) < 0.10 + 4.4 * stderr / mean).all()
    assert (0.002 < mean / np.array([f.sum(axis=(0, 1)) for _, f in runs]).mean(axis=0)).all()


def test_flat_plate_exchanges_nothing_groove_at_most_all():
    """Two squares of 40 mm that meet at a right angle: each gets 0.2 of what the other sends.

    The view factor of adjacent equal squares is 0.20004; the boundary takes away T T, which
    averages 0.85 or a little less because much light is aslant.
    """
    square = np.array([[0, 0, 0], [40, 0, 0], [40, 40, 0], [0, 40, 0]], float)
    wall = square[:, [2, 1, 0]] - [0.01, 0.0, 0.0]  # vertices in one place share their normals
    flat = build_mesh(square, [[0, 1, 2], [0, 2, 3]], [[0, 0], [0.5, 0], [0.5, 1], [0, 1]])
    assert Interreflection(Caster(flat), patches=16).exchange.nnz == 0
    uv = [[0, 0], [0.45, 0], [0.45, 1], [0, 1], [0.55, 0], [1, 0], [1, 1], [0.55, 1]]
    faces = [[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]]
    groove = build_mesh(np.concatenate([square, wall]), faces, uv)
    bounce = Interreflection(Caster(groove), patches=32)
    rows = np.asarray(bounce.exchange.sum(axis=1)).ravel()
    assert rows.max() < 0.5
    assert 0.75 * 0.2 < rows.mean() < 0.9 * 0.2
    sent = unwrap(groove, 32)
    assert len(rows) == int(sent.covered.sum())


@pytest.fixture(scope="module")
def small(rig):
    return dataclasses.replace(rig, lights=(rig.lights[LIGHT], rig.lights[20]))


@pytest.fixture(scope="module")
def face():
    return make_subject("II", seed=2, size=128)


@pytest.mark.long
def test_interreflection_adds_little_and_most_in_concavities(small, face):
    plain = DomeScene(small, face, effects=SceneEffects(lateral=False, interreflections=False))
    bounced = DomeScene(small, face, effects=SceneEffects(lateral=False, interreflections=True))
    one, two = plain.radiance("C02", [0])[0], bounced.radiance("C02", [0])[0]
    extra = two - one
    assert extra.min() > -1e-5 * one.max()
    assert 0.002 < extra.sum() / one.sum() < 0.03
    names = {name for name, _ in bounced.omitted}
    assert "interreflection" not in names
    assert "highlights of skin on skin" in names


def test_subsurface_scattering_reddens_hard_shadow(small, face):
    """The sum of light changes little, pixels in hard shadow get some, and red more than blue."""
    plain = DomeScene(small, face, effects=SceneEffects(lateral=False, interreflections=False))
    soft = DomeScene(small, face, effects=SceneEffects(lateral=True, interreflections=False))
    one, two = plain.radiance("C02", [1])[0], soft.radiance("C02", [1])[0]
    assert two.sum() == pytest.approx(one.sum(), rel=0.02)
    dark = (one.sum(axis=-1) == 0.0) & (plain.truth()["mask"]) & (two.sum(axis=-1) > 0.0)
    assert dark.sum() > 10
    into_shadow, lit = two[dark].sum(axis=0), one.sum(axis=(0, 1))
    assert into_shadow[0] / into_shadow[2] > 1.3 * lit[0] / lit[2]
    assert "lateral scattering in skin" not in {name for name, _ in soft.omitted}


def test_plain_kernel_adds_the_same_subsurface_light(small, face):
    from rigsim.mitsuba.variant import VariantChoice

    plain = VariantChoice("scalar_rgb", "asked for by the test", "")
    inside = SceneEffects(lateral=True, interreflections=False)
    one = DomeScene(small, face, effects=inside).radiance("C02", [0])[0]
    two = DomeScene(small, face, choice=plain, effects=inside).radiance("C02", [0])[0]
    assert one.sum() == pytest.approx(two.sum(), rel=2e-3)
    assert (np.abs(one - two) < 2e-4 * two.max()).mean() > 0.99
