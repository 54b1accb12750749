"""Strained skin presses blood out of its vessels, or lets them fill."""

from pathlib import Path

import numpy as np
import pytest
from twins.triangle_stretch import principal_stretches

from rigsim.geometry.atlas import texture_of_vertices, unwrap
from rigsim.geometry.mesh import Mesh, build_mesh
from rigsim.geometry.surface_strain import average_at_vertices, principal_log_strains
from rigsim.subject import expressions, tissue_pressure
from rigsim.subject.expression_wrinkles import draw_wrinkle_lines
from rigsim.subject.expressions import EXPRESSION_STRENGTHS
from rigsim.subject.perfusion import MAX_HEMOGLOBIN
from rigsim.subject.perfusion_course import fix_blood_level
from rigsim.subject.person import SimulatedSubject, make_subject
from rigsim.subject.tissue_pressure import (
    blood_ratio,
    expression_pressure_mbar,
    strain_pressure_mbar,
)

SCANNED_HEAD = Path(__file__).parents[5] / "shared" / "data" / "ict_face.npz"


@pytest.fixture(scope="module")
def person() -> SimulatedSubject:
    return make_subject("III", seed=0, size=96)


@pytest.fixture(scope="module")
def plate() -> Mesh:
    """Return a bumpy, tilted plate of 12 by 12 squares, which is not in a coordinate plane."""
    u, v = np.meshgrid(np.linspace(0.0, 1.0, 13), np.linspace(0.0, 1.0, 13))
    flat = np.stack([60.0 * u, 60.0 * v, 4.0 * np.sin(7.0 * u) * np.cos(5.0 * v)], axis=-1)
    index = np.arange(169).reshape(13, 13)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    return build_mesh(flat.reshape(-1, 3) @ rotation(0.4, 0.7), faces, uv)


def rotation(about_x: float, about_y: float) -> np.ndarray:
    cx, sx, cy, sy = np.cos(about_x), np.sin(about_x), np.cos(about_y), np.sin(about_y)
    return np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]]) @ np.array(
        [[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]
    )


def near_cheek_bones(person: SimulatedSubject) -> np.ndarray:
    points = person.perfusion.points_mm
    away = np.hypot(np.abs(points[..., 0]) - 42.0, points[..., 1] - 4.0)
    return person.atlas.covered & (away < 9.0) & (points[..., 2] > -40.0)


@pytest.mark.parametrize(
    ("gradient", "stretches"),
    [
        ([[1.3, 0.0], [0.0, 1.0]], (1.3, 1.0)),
        ([[0.8, 0.0], [0.0, 1.1]], (1.1, 0.8)),
        # simple shear by s: stretches are sqrt(1 + s^2 / 4) +- s / 2
        ([[1.0, 0.6], [0.0, 1.0]], (np.sqrt(1.09) + 0.3, np.sqrt(1.09) - 0.3)),
        ([[0.5, 0.0], [0.0, 0.5]], (0.5, 0.5)),
    ],
)
def test_strain_of_affine_stretch_matches_closed_form(gradient, stretches):
    x, y = np.meshgrid(np.arange(5.0), np.arange(5.0))
    plane = np.stack([x, y], axis=-1).reshape(-1, 2)
    index = np.arange(25).reshape(5, 5)
    corners = (index[:-1, :-1], index[:-1, 1:], index[1:, 1:])
    faces = np.stack(corners, axis=-1).reshape(-1, 3)
    turn = rotation(0.9, -0.3)
    rest = build_mesh(np.column_stack([plane, np.zeros(25)]) @ turn, faces, plane / 4.0)
    moved = np.column_stack([plane @ np.transpose(gradient), np.zeros(25)]) @ rotation(0.1, 2.0)
    found = principal_log_strains(rest, moved.astype(np.float32))
    np.testing.assert_allclose(found, np.broadcast_to(np.log(stretches), found.shape), atol=2e-6)


@pytest.mark.parametrize("state", ["smile", "surprise"])
def test_strain_matches_eigenvalues_of_an_independent_twin(person, state):
    moved = person.mesh.vertices_mm + expressions.displacement_mm(person.mesh, state)
    found = np.exp(principal_log_strains(person.mesh, moved))
    expected, _ = principal_stretches(person.mesh.vertices_mm, moved, person.mesh.faces)
    np.testing.assert_allclose(found[:, ::-1], expected, atol=5e-4)
    assert found.max() > 1.2
    assert found.min() < 0.8


def test_rigid_motion_leaves_exactly_neutral_blood(person):
    """Rationale: turning and moving the head strains no skin; the rounding of float32 must not.

    Expected: exactly no pressure and exactly neutral blood. A stretch by a thousandth must show.
    """
    vertices = person.mesh.vertices_mm.astype(np.float64)
    moved = (vertices @ rotation(0.3, -0.5) + np.array([40.0, -25.0, 130.0])).astype(np.float32)
    pressure = expression_pressure_mbar(person.mesh, moved, seed=0)
    assert not pressure.any()
    texels = texture_of_vertices(person.mesh, pressure, person.size)
    np.testing.assert_array_equal(person.perfusion.blood("neutral", texels), person.hemoglobin())
    wider = (1.001 * vertices).astype(np.float32)
    assert expression_pressure_mbar(person.mesh, wider, seed=0).any()


def test_triangles_without_area_are_not_strained():
    rest = build_mesh(
        [[0, 0, 0], [9, 0, 0], [18, 0, 0], [0, 9, 0]],
        [[0, 1, 2], [0, 1, 3]],
        [[0, 0], [0.5, 0], [1, 0], [0, 1]],
    )
    grown = rest.vertices_mm * np.array([2.0, 1.0, 1.0], np.float32)
    strains = principal_log_strains(rest, grown)
    np.testing.assert_array_equal(strains[0], 0.0)
    np.testing.assert_allclose(strains[1], [np.log(2.0), 0.0], atol=1e-6)
    collapsed = principal_log_strains(rest, np.zeros((4, 3), np.float32))
    np.testing.assert_array_equal(collapsed, 0.0)
    np.testing.assert_allclose(average_at_vertices(rest, np.array([5.0, 3.0])), [3, 3, 0, 3])


def test_seam_vertices_at_same_position_share_value(plate):
    seam = build_mesh(
        np.concatenate([plate.vertices_mm, plate.vertices_mm]),
        np.concatenate([plate.faces[:144], plate.faces[144:] + 169]),
        np.concatenate([plate.uv, plate.uv]),
    )
    values = np.random.default_rng(2).uniform(size=len(plate.faces))
    whole, split = average_at_vertices(plate, values), average_at_vertices(seam, values)
    np.testing.assert_allclose(split, np.tile(whole, 2), rtol=1e-6)


def test_texture_of_vertices_matches_atlas_of_positions(plate):
    atlas = unwrap(plate, 48)
    height = texture_of_vertices(plate, plate.vertices_mm[:, 2], 48)
    np.testing.assert_allclose(height[atlas.covered], atlas.position_mm[atlas.covered][:, 2])
    assert not height[~atlas.covered].any()


def test_stretch_presses_monotonically_and_slack_fills():
    strain = np.linspace(-0.4, 0.5, 91)
    pressure = strain_pressure_mbar(np.stack([strain, 0.0 * strain], axis=-1), 0.08)
    stretched, relaxed = strain > 0.005, (strain > -0.079) & (strain < -0.005)
    assert (np.diff(blood_ratio(pressure[strain >= -0.08])) < 0.0).all()
    assert (blood_ratio(pressure[stretched]) < 1.0).all()
    assert (blood_ratio(pressure[relaxed]) > 1.0).all()
    # folds press each other: beyond slack, blood falls again, and below rest at twice the tension
    assert (np.diff(blood_ratio(pressure[strain <= -0.08])) > 0.0).all()
    assert (blood_ratio(pressure[strain < -0.165]) < 1.0).all()


def test_pure_shear_presses_blood_out_beyond_tension():
    shear = np.array([[s, -s] for s in (0.0, 0.04, 0.2, 0.4)])
    none, little, some, much = strain_pressure_mbar(shear, 0.08)
    assert none == 0.0
    assert abs(little) < 1e-9
    assert 0.0 < some < much


def test_blood_ratio_is_bounded_and_smooth_at_rest():
    pressure = np.array([-1e9, -100.0, -1e-3, 0.0, 1e-3, 100.0, 1e9])
    ratio = blood_ratio(pressure)
    assert (np.diff(ratio) <= 0.0).all()
    assert ratio[[0, 3, 6]].tolist() == [1.75, 1.0, 0.25]
    assert ratio[2] - 1.0 == pytest.approx(1.0 - ratio[4], rel=1e-3)
    # venules have less pressure of their own
    assert blood_ratio(20.0, capillary_ratio=0.65) < blood_ratio(20.0)


def test_wrinkles_and_blood_share_the_tension(person):
    points = person.perfusion.points_mm
    lines = draw_wrinkle_lines(points, person.atlas.covered, seed=5)
    assert lines.tension == tissue_pressure.draw_tension(np.random.default_rng([5, 22]))


def test_smile_fills_cheek_bones_drains_stretched_lips(person):
    """Jimenez et al. 2010, observation 2. With the wrong sign of the strain, it must fail."""
    bones = near_cheek_bones(person)
    lips = person.perfusion.regions["lips"] > 0.6
    neutral = person.hemoglobin()

    def change(blood: np.ndarray, inside: np.ndarray) -> float:
        return float(blood[inside].mean() / neutral[inside].mean())

    smile = person.hemoglobin("smile")
    assert change(smile, bones) > 1.03
    assert change(smile, lips) < 0.9
    mesh = person.mesh
    wrong_way = mesh.vertices_mm - expressions.displacement_mm(mesh, "smile", seed=0)
    pressure = expression_pressure_mbar(mesh, wrong_way, seed=0)
    wrong = person.perfusion.blood("smile", texture_of_vertices(mesh, pressure, person.size))
    assert change(wrong, bones) < 1.0


@pytest.mark.long
@pytest.mark.parametrize("state", sorted(EXPRESSION_STRENGTHS))
def test_mechanical_change_grows_with_amount_within_limits(person, state):
    """Over the skin that moves; single texels may fill first and drain when they fold."""
    front = person.atlas.covered
    neutral = person.perfusion.blood()
    changes = []
    for amount in (0.0, 0.25, 0.5, 1.0, 1.5):
        moved = person.mesh.vertices_mm + expressions.displacement_mm(
            person.mesh, state, amount=amount
        )
        pressure = expression_pressure_mbar(person.mesh, moved, seed=0)
        blood = person.perfusion.blood(
            "neutral", texture_of_vertices(person.mesh, pressure, person.size)
        )
        assert 0.24 * neutral.min() <= blood.min()
        assert blood.max() < MAX_HEMOGLOBIN
        changes.append(float(np.abs(blood / neutral - 1.0)[front].mean()))
    assert changes[0] == 0.0
    assert (np.diff(changes) > 0.0).all()


def test_blood_follows_amount_of_the_pose(person):
    rest, full = person.hemoglobin(), person.hemoglobin("smile")
    half = person.with_expression("smile", 0.5)
    whole = person.with_expression("smile")
    np.testing.assert_array_equal(whole.hemoglobin("smile"), full)
    np.testing.assert_array_equal(half.hemoglobin(), rest)  # the state counts, not the pose
    np.testing.assert_array_equal(half.hemoglobin("anger"), person.hemoglobin("anger"))
    less = np.abs(half.hemoglobin("smile") - rest).mean()
    assert 0.3 * np.abs(full - rest).mean() < less < 0.75 * np.abs(full - rest).mean()
    # at a level of a half, vessels are half as far, near what half the movement does
    level = fix_blood_level(person, "smile", 0.5).hemoglobin()
    away = np.abs(level - half.hemoglobin("smile")).mean()
    assert away < 0.35 * less


def test_moving_the_head_keeps_blood_of_expressions(person):
    there = person.with_expression("disgust").translate((30.0, -20.0, 5.0))
    here = person.hemoglobin("disgust")
    np.testing.assert_allclose(there.hemoglobin("disgust"), here, rtol=2e-3)


def test_states_without_movement_have_no_pressure(person):
    for state in ("neutral", "exercise", "alcohol"):
        assert person.tissue_pressure_mbar(state) is None
    off = ~person.atlas.covered
    assert not person.tissue_pressure_mbar("smile")[off].any()


def test_own_blend_shapes_press_blood(person):
    """A mesh with shapes of its own strains by them; a shape without strain presses nothing."""
    mesh = person.mesh
    lift = np.zeros_like(mesh.vertices_mm)
    names = ("mouthSmile_L", "mouthSmile_R", "cheekSquint_L", "cheekSquint_R")
    shapes = dict.fromkeys(names, lift)
    shaped = build_mesh(mesh.vertices_mm, mesh.faces, mesh.uv, mesh.normals, shapes=shapes)
    still = make_subject("III", seed=0, size=64, mesh=shaped)
    np.testing.assert_array_equal(still.hemoglobin("smile"), still.hemoglobin())
    pull = np.array([0.2, 0.0, 0.0], np.float32) * mesh.vertices_mm  # wider everywhere
    shapes = {"mouthSmile_L": pull, "mouthSmile_R": pull}
    wide = make_subject(
        "III",
        seed=0,
        size=64,
        mesh=build_mesh(mesh.vertices_mm, mesh.faces, mesh.uv, mesh.normals, shapes=shapes),
    )
    ratio = (wide.hemoglobin("smile") / wide.hemoglobin())[wide.atlas.covered]
    assert np.median(ratio) < 0.85


@pytest.mark.skipif(not SCANNED_HEAD.exists(), reason="the head with blend shapes is not here")
def test_head_with_blend_shapes_fills_cheeks_in_smile():
    person = make_subject("III", seed=0, size=128, mesh=SCANNED_HEAD)
    bones = near_cheek_bones(person)
    neutral, smile = person.hemoglobin(), person.hemoglobin("smile")
    assert smile[bones].mean() > neutral[bones].mean()
    ratio = smile / neutral
    assert 0.24 < ratio.min() < ratio.max() < 1.76
