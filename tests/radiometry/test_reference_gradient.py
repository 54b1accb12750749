"""Crossed images of voxel skin under the gradient rig's patterns, and normals from them."""

import numpy as np
import pytest

from capture.rig import load_rig
from model.metrics import angular_error_rad
from reconstruction.gradient_normals.lobe_response import INTERIOR_SHAPE_STDERR
from rigsim.as_built.sphere import nominal_sphere
from rigsim.mitsuba.variant import choose_variant
from rigsim.scenes.reference.gradient_skin import predict_moments, render_moments, turn_skin
from rigsim.scenes.reference.patch import draw_patch
from rigsim.subject.person_skin import PersonSkin
from rigsim.tissue.skin_layers import skin_layer_stack
from rigsim.tissue.tissue_mc import trace_photons
from skinrig.benchmarks.simulation.reference_gradient import estimate_normals

WAVELENGTH_NM = 540.0
RIG = load_rig("gradient")
SPHERE = nominal_sphere(RIG)


@pytest.mark.render
@pytest.mark.skipif(
    not choose_variant("mono").is_vectorized, reason="Dr.Jit finds no LLVM 17 or newer here"
)
def test_moments_follow_tilt_of_voxels():
    """Tolerance: 5 standard errors plus the interior's 6 %; wrong azimuth or R_d exceeds it."""
    person = PersonSkin.of_preset("III")
    patch = draw_patch(person, "cheek", field_mm=4.0, voxel_mm=0.5)
    inner = slice(*np.searchsorted(patch.x_mm, [-2.0, 2.0]))
    melanin, blood = (float(part[inner, inner].mean()) for part in (patch.melanin, patch.blood))
    stack = skin_layer_stack(WAVELENGTH_NM, melanin, blood, person.tissue)
    r_d = trace_photons(stack, photons=20_000, rng=np.random.default_rng(0)).reflectance
    turn = turn_skin(40.0, 20.0)
    image = render_moments(patch, RIG, SPHERE, turn, WAVELENGTH_NM, width_px=4, samples=256, seed=1)
    stderr = np.sqrt(np.diag(image.covariance))
    bound = 5.0 * stderr + 0.06 * image.mean[0]

    def is_near(albedo, frame):
        return (np.abs(image.mean - predict_moments(albedo, RIG, SPHERE, frame)) < bound).all()

    assert is_near(r_d, turn)
    assert not is_near(1.4 * r_d, turn)
    assert not is_near(r_d, turn_skin(40.0, 110.0))


def test_diffuse_normals_state_error_of_interior():
    """Rationale: normals of a Lambertian interior are exact; their stated error grows by tilt."""
    stated = []
    for tilt_deg in (0.0, 45.0):
        turn = turn_skin(tilt_deg, 75.0)
        found = estimate_normals(predict_moments(0.4, RIG, SPHERE, turn), RIG, SPHERE, seed=3)
        errors = angular_error_rad(found.normals, np.broadcast_to(turn[2], found.normals.shape))
        assert np.degrees(np.median(errors)) < 0.2
        stated.append(float(np.median(found.stderr_rad)))
    assert stated[1] > 0.9 * INTERIOR_SHAPE_STDERR * np.radians(45.0)
    assert stated[1] > 5.0 * stated[0]
