"""Written materials in Mitsuba's own ``measured``: the same values, and samples to go with them."""

import numpy as np
import pytest

from model.brdf import recipe as brdf_recipe
from model.brdf import rgl
from rigsim.mitsuba import startup
from rigsim.mitsuba.variant import choose_variant

pytestmark = pytest.mark.render


@pytest.fixture(scope="module")
def mi():
    return startup.load_mitsuba(choose_variant("rgb"))


def half_sphere(rng, count, *, lowest=0.1):
    z = rng.uniform(lowest, 1.0, count)
    phi = rng.uniform(0.0, 2.0 * np.pi, count)
    s = np.sqrt(1.0 - z**2)
    return np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1).astype(np.float32)


def each(mi, material, call, *directions):
    """Return what a material's method gives for pairs of directions; scalar variants one by one."""
    context = mi.BSDFContext()
    if mi.variant().startswith("scalar"):
        found = []
        for one in zip(*directions, strict=True):
            interaction = mi.SurfaceInteraction3f()
            interaction.wi = mi.Vector3f(*one[0].tolist())
            found.append(call(material, context, interaction, *one[1:]))
        return found
    import drjit as dr

    interaction = dr.zeros(mi.SurfaceInteraction3f, len(directions[0]))
    interaction.wi = mi.Vector3f(*directions[0].T)
    return call(material, context, interaction, *(d.T for d in directions[1:]))


def evaluated(mi, material, light, view):
    def call(material, context, interaction, to):
        return np.array(material.eval(context, interaction, mi.Vector3f(*np.asarray(to).tolist())))

    found = np.asarray(each(mi, material, call, view, light))
    return found if found.shape == (len(light), 3) else found.T


@pytest.mark.parametrize("name", ["diffuse", "ggx 0.1 eta 1.4", "sheen 0.4"])
def test_mitsuba_evaluates_written_material_to_same_values(name, mi, rng, tmp_path):
    """Rationale: the file must mean the same there.

    Expected: f_r times the light's cosine. Tolerance: single precision against double, 1e-4 of the
    largest value; 0.06 RMS against the BRDF itself, for interpolation between elevations.
    """
    brdf = dict(brdf_recipe.materials())[name]
    table = rgl.tabulate_brdf(
        lambda to, at: brdf(to, at)[:, None] * [1.0, 0.5, 0.25], description=name
    )
    rgl.write(tmp_path / "a.bsdf", table)
    material = mi.load_dict({"type": "measured", "filename": str(tmp_path / "a.bsdf")})
    light, view = half_sphere(rng, 300), half_sphere(rng, 300)
    found = evaluated(mi, material, light, view)
    own = table.evaluate(light, view) * light[:, 2:]
    np.testing.assert_allclose(found, own, atol=1e-4 * own.max())
    true = brdf(light.astype(np.float64), view.astype(np.float64)) * light[:, 2]
    assert np.sqrt(np.mean((found[:, 0] - true) ** 2) / np.mean(true**2)) < 0.06


def test_an_uneven_density_is_flattened_as_mitsuba_does(mi, rng, tmp_path):
    """Rationale: measured files hold uneven densities; ours are even. Tolerance: as above."""
    values = rng.uniform(0.1, 1.0, (4, 3, 6, 6)).astype(np.float32)
    made = rgl.RglTable(
        np.linspace(0.0, 1.4, 4, dtype=np.float32),
        np.repeat(rng.uniform(0.5, 2.0, (1, 9)), 2, 0).astype(np.float32),
        np.repeat(rng.uniform(0.5, 1.0, (1, 9)), 2, 0).astype(np.float32),
        rng.uniform(0.1, 3.0, (4, 8, 5)).astype(np.float32),
        np.ones((4, 6, 6), np.float32),
        values,
        np.zeros(0, np.float32),
        "uneven",
    )
    rgl.write(tmp_path / "a.bsdf", made)
    material = mi.load_dict({"type": "measured", "filename": str(tmp_path / "a.bsdf")})
    light, view = half_sphere(rng, 300), half_sphere(rng, 300)
    found = evaluated(mi, material, light, view)
    own = made.evaluate(light, view) * light[:, 2:]
    np.testing.assert_allclose(found, own, rtol=2e-3, atol=1e-4 * own.max())


def test_mitsuba_samples_of_white_matte_material_conserve_light(mi, rng, tmp_path):
    """Rationale: weights f cos / pdf of sampled lights average to the albedo.

    Expected: 0.8 within 5 standard errors (false alarms: 1 in 1.7 million), which are under 0.01,
    and 0.004 for the interpolation of the cosine at the horizon.
    """
    white = rgl.tabulate_brdf(
        lambda light, view: np.full(len(light), 0.8 / np.pi), description="white"
    )
    rgl.write(tmp_path / "a.bsdf", white)
    material = mi.load_dict({"type": "measured", "filename": str(tmp_path / "a.bsdf")})
    count = 20_000 if not mi.variant().startswith("scalar") else 4000
    view = np.tile(half_sphere(rng, 1, lowest=0.7), (count, 1))
    draws = rng.random((count, 2)).astype(np.float32)

    def call(material, context, interaction, draw):
        at = mi.Point2f(*np.asarray(draw).tolist())
        return np.array(material.sample(context, interaction, mi.Float(0.5), at)[1])

    weight = np.asarray(each(mi, material, call, view, draws))
    weight = weight if weight.shape == (count, 3) else weight.T
    mean, stderr = weight[:, 0].mean(), weight[:, 0].std() / np.sqrt(count)
    assert stderr < 0.01
    assert abs(mean - 0.8) < 5.0 * stderr + 0.004
