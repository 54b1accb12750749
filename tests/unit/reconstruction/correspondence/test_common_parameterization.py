"""Faces of several shapes in one map: landmarks coincide, folds and bad landmarks are refused."""

import numpy as np
import pytest

from reconstruction.correspondence import charts, common_regions
from reconstruction.correspondence import common_parameterization as common
from reconstruction.correspondence.common_parameterization import Cylinder, ParameterizationError

SIZE = 96


def surface(size=SIZE, *, wide=1.0, tall=1.0):
    """Return a half cylinder as a texture of positions, mm, with the nose's tip in the middle."""
    u, v = np.meshgrid(np.linspace(-1.0, 1.0, size), np.linspace(1.0, -1.0, size))
    x, y = 75.0 * wide * np.sin(1.2 * u), 90.0 * tall * v
    z = 75.0 * np.cos(1.2 * u) + 8.0 * np.exp(-((u / 0.2) ** 2 + (v / 0.2) ** 2)) - 83.0
    return np.stack([x, y, z], axis=-1)


def marks(position):
    """Return twenty named texels of a surface."""
    rows = np.linspace(0.1, 0.9, 5) * (len(position) - 1)
    columns = np.linspace(0.1, 0.9, 4) * (len(position) - 1)
    found = {
        f"p{i}{j}": tuple(position[round(r), round(c)])
        for i, r in enumerate(rows)
        for j, c in enumerate(columns)
    }
    middle = len(position) // 2
    return found | {"nose tip": tuple(position[middle, middle])}


@pytest.fixture(scope="module")
def faces():
    return [surface(), surface(wide=1.1, tall=0.95), surface(wide=0.92, tall=1.06)]


@pytest.fixture(scope="module")
def frame(faces):
    names, places = common.average_landmarks([marks(face) for face in faces])
    unrolled = [Cylinder(marks(f)["nose tip"]).unroll(f.reshape(-1, 3)) for f in faces]
    return common.fit_common_frame(names, places, unrolled, size=SIZE)


def test_same_point_of_faces_maps_to_same_position(faces, frame):
    places = []
    for face in faces:
        found = common.fit_correspondence(marks(face), frame, stderr_mm=0.05)
        places.append(found.map_points(face[20:76:7, 20:76:7])[0])
    spread = np.std(places, axis=0)
    unrolled = np.std(
        [Cylinder(marks(f)["nose tip"]).unroll(f[20:76:7, 20:76:7]) for f in faces], axis=0
    )
    assert np.median(spread) < 0.3
    assert np.median(unrolled) > 1.0  # without landmarks they do not


def test_errors_grow_with_landmark_noise_and_cover_effect(faces, frame):
    rng = np.random.default_rng(4)
    face = faces[0]
    at = face[30:66:6, 30:66:6].reshape(-1, 3)
    exact = common.fit_correspondence(marks(face), frame, stderr_mm=0.1).map_points(at)[0]
    fine, told = [], []
    for _ in range(24):
        noisy = {
            n: tuple(np.asarray(p) + (0 if n == "nose tip" else rng.normal(0, 1.0, 3)))
            for n, p in marks(face).items()
        }
        place, error = common.fit_correspondence(noisy, frame, stderr_mm=1.0).map_points(at)
        fine.append(place - exact)
        told.append(error)
    measured = np.sqrt(np.mean(np.square(fine)))
    said = np.sqrt(np.mean(np.square(told)))
    assert 0.3 < measured / said < 1.5
    small = common.fit_correspondence(marks(face), frame, stderr_mm=0.1).map_points(at)[1]
    assert small.mean() < 0.5 * np.mean(told)


def test_texture_round_trips_through_common_map(faces, frame):
    face = faces[1]
    texture = np.stack([np.sin(face[..., 0] / 15), face[..., 1] / 90, face[..., 2] / 90], axis=-1)
    valid = np.ones(texture.shape[:2], bool)
    valid[40:50, 60:70] = False
    chart = charts.chart_texels(
        face, np.ones_like(valid), common.fit_correspondence(marks(face), frame), frame
    )
    image, known = chart.gather(np.where(valid[..., None], texture, 50.0), valid)
    assert known.mean() > 0.75
    assert np.abs(image[known]).max() < 1.5  # nothing of what is not valid
    back, inside = chart.read(image)
    use = valid & inside
    assert np.sqrt(np.mean((back - texture)[use] ** 2)) < 0.02


def test_ear_shadowed_texels_do_not_mix_with_ear(frame, faces):
    front = faces[0]
    behind = front * [0.7, 1.0, 1.0] - [0.0, 0.0, 25.0]
    position = np.concatenate([front, behind])
    texture = np.concatenate([np.ones((SIZE, SIZE)), np.zeros((SIZE, SIZE))])
    chart = charts.chart_texels(
        position,
        np.ones(texture.shape, bool),
        common.fit_correspondence(marks(front), frame),
        frame,
    )
    image, known = chart.gather(texture)
    middle = slice(SIZE // 4, -SIZE // 4)
    assert image[middle, middle].min() > 0.999
    assert known[middle, middle].all()


def test_left_and_right_exchanged_is_refused_by_name(faces, frame):
    wrong = marks(faces[0])
    wrong["p11"], wrong["p12"] = wrong["p12"], wrong["p11"]
    with pytest.raises(ParameterizationError, match=r"has folds.*'p1"):
        common.fit_correspondence(wrong, frame)


def test_too_few_and_collinear_landmarks_are_refused(faces, frame):
    all_marks = marks(faces[0])
    few = {n: all_marks[n] for n in list(all_marks)[:3]}
    with pytest.raises(ParameterizationError, match="got 3 of the common map"):
        common.fit_correspondence(few, frame)
    line = {n: (0.0, 10.0 * k, 0.0) for k, n in enumerate(all_marks)}
    with pytest.raises(ParameterizationError, match="one line"):
        common.fit_correspondence(line, frame)
    with pytest.raises(ParameterizationError, match="lacks 'nose tip'"):
        common.average_landmarks([{"chin": (0.0, 0.0, 0.0)}])


def test_a_frame_comes_back_from_its_document(frame):
    again = common.CommonFrame.from_document(frame.to_document())
    assert again.names == frame.names
    np.testing.assert_array_equal(again.grid_mm(), frame.grid_mm())
    with pytest.raises(ParameterizationError, match="side_mm"):
        common.CommonFrame.from_document(
            {k: v for k, v in frame.to_document().items() if k != "side_mm"}
        )


def test_beard_region_surrounds_mouth_but_excludes_lips():
    frame = common_regions.standard_frame(side_mm=240.0, center_mm=(0.0, 0.0), size=120)
    beard = common_regions.region_mask("beard", frame)
    rest = common_regions.region_mask("no-beard", frame)

    def at(u, v, mask):
        column, row = np.round(frame.to_pixel((u, v))).astype(int)
        return bool(mask[row, column])

    assert at(0, -60, beard)
    assert at(60, -40, beard)
    assert at(0, -18, beard)
    assert not at(0, -35, beard)
    assert not at(0, 40, beard)
    assert at(0, 40, rest)
    assert at(0, -35, rest)
    assert not (beard & rest).any()
    assert abs(int(beard[:, :60].sum()) - int(beard[:, 60:].sum())) < 0.02 * beard.sum()
    with pytest.raises(common_regions.RegionError, match="got 'ears'"):
        common_regions.region_mask("ears", frame)


def test_face_without_landmarks_is_unwrapped_from_foremost_texels():
    position = surface()
    valid = np.ones(position.shape[:2], np.bool_)
    found = common.find_cylinder(position + np.array([3.0, -4.0, 5.0]), valid)
    np.testing.assert_allclose(found.tip_mm, [3.0, -4.0, 5.0], atol=1.0)
    valid[:] = False
    with pytest.raises(ParameterizationError, match="got no valid texel"):
        common.find_cylinder(position, valid)
