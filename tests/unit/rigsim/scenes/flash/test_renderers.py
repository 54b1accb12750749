"""Both renderers of the flash rig: Mitsuba's scene against the way without LLVM."""

import numpy as np
import pytest

from capture.rig import Rig
from rigsim.as_built.polarizers import Polarizers
from rigsim.mitsuba.variant import VariantChoice, choose_variant
from rigsim.needs.effects import SceneEffects
from rigsim.scenes.flash.scene import FlashScene
from rigsim.targets import make_target

pytestmark = pytest.mark.render

EMBREE = VariantChoice("scalar_rgb", "asked for by the test", "")
FILMS = Polarizers(50.0, 2000.0, 3.0)  # leaky, so that the leak shows
EFFECTS = SceneEffects(lateral=False, interreflections=False, relief_shadows=True)


@pytest.fixture(scope="module", autouse=True)
def _needs_llvm() -> None:
    choice = choose_variant("rgb")
    if not choice.is_vectorized:
        pytest.skip(f"no LLVM: {choice.why}")


def both(rig: Rig, subject, *, films=FILMS, **kwargs) -> list[FlashScene]:
    """Return the scene by Mitsuba and without LLVM."""
    return [
        FlashScene(rig, subject, films=films, effects=EFFECTS, choice=choice, **kwargs)
        for choice in (None, EMBREE)
    ]


@pytest.mark.long
@pytest.mark.parametrize("state", ["neutral", "smile"])
def test_renderers_agree_on_a_face(rig, face, state):
    """Rationale: two ray tracers, two codes of the optics. Tolerances: float32 and 16-bit normals
    for subsurface light; highlights differ in shadows, which one takes from rays and the other from
    texels; rays that graze the silhouette hit one mesh or miss the other."""
    mitsuba, fast = both(rig, face, state=state)
    ours, theirs = mitsuba.truth(), fast.truth()
    inner = ours["mask"] & theirs["mask"]
    assert np.count_nonzero(ours["mask"] != theirs["mask"]) <= 4
    for name in ("diffuse", "specular"):
        difference = np.abs(ours[name] - theirs[name])[inner]
        assert ours[name].mean() == pytest.approx(theirs[name].mean(), rel=1e-3)
        assert np.quantile(difference, 0.99) < 3e-4
        assert difference.max() < (0.02 if name == "specular" else 3e-4)
    for name in ("shading", "reflectance", "normals", "melanin", "uv", "roughness"):
        np.testing.assert_allclose(ours[name][inner], theirs[name][inner], atol=3e-4)


@pytest.mark.long
def test_renderers_agree_behind_the_analyzer(rig, face):
    mitsuba, fast = both(rig, face)
    for polarizer in ("parallel", "crossed"):
        ours, theirs = mitsuba.radiance(polarizer), fast.radiance(polarizer)
        assert ours.mean() == pytest.approx(theirs.mean(), rel=1e-3)
        assert np.quantile(np.abs(ours - theirs), 0.99) < 3e-4
    turned = fast.radiance("parallel", 8.0)
    assert np.quantile(np.abs(mitsuba.radiance("parallel") - turned), 0.99) > 3e-4


@pytest.mark.long
@pytest.mark.parametrize("name", ["white", "chart", "malus"])
def test_renderers_agree_on_targets(rig, name):
    """Diffuse light, edges of patches, and metal, which keeps polarization."""
    mitsuba, fast = both(rig, make_target(name))
    for polarizer in ("parallel", "crossed"):
        ours, theirs = mitsuba.radiance(polarizer), fast.radiance(polarizer)
        np.testing.assert_allclose(ours.mean(), theirs.mean(), rtol=1e-4)
        assert np.quantile(np.abs(ours - theirs), 0.999) < 1e-4 * theirs.max()
    _, leakier = both(rig, make_target(name), films=Polarizers(30.0, 2000.0, 3.0))
    assert leakier.radiance("crossed").mean() > 1.005 * theirs.mean()


@pytest.mark.long
def test_image_does_not_change_with_its_bands(rig, face, monkeypatch):
    whole, _ = both(rig, face)
    parts, _ = both(rig, face)
    expected = whole.radiance("parallel")
    monkeypatch.setattr("rigsim.scenes.flash.image.RAYS_PER_BAND", 40 * rig.views[0].width_px)
    found = parts.radiance("parallel")
    difference = np.abs(found - expected)
    assert np.quantile(difference, 0.99) < 1e-4  # rays to a flash's disc are numbered by band
    assert difference.max() < 0.02
    assert expected.mean() > 0.05
