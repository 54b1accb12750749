"""Two runs beside each other: chance is no difference, a difference is found where it is."""

import json
import math

import numpy as np
import pytest

from model import store
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.benchmarks.document import to_document
from skinrig.benchmarks.results import Limit, Point, StageBenchmark, Timing
from skinrig.reporting import report
from skinrig.reporting.comparison import maps as map_comparison
from skinrig.reporting.comparison import runs as run_comparison
from skinrig.reporting.comparison.maps import CHANCE_FRACTIONS, compare_maps
from skinrig.reporting.report import ReportError

SIDE = 200
PIXELS = SIDE * SIDE
Z = 3.89
"""Of a two-sided test that fails once in 10,000 seeds."""


def share_is(found, expected):
    return abs(found - expected) <= Z * math.sqrt(expected * (1 - expected) / PIXELS)


def two_estimates(rng, *, stated=1.0, spread=(0.3, 0.4)):
    truth = rng.uniform(1.0, 2.0, (SIDE, SIDE))
    maps = [
        SkinMap(truth + rng.normal(0.0, s, truth.shape), "mm", np.full(truth.shape, stated * s))
        for s in spread
    ]
    return maps[0], maps[1]


def test_noise_of_stated_size_differs_as_expected(rng):
    found = compare_maps("thickness", *two_estimates(rng))
    for share, expected in zip(found.beyond, CHANCE_FRACTIONS, strict=True):
        assert share_is(share, expected)
    assert found.combined == pytest.approx(0.5, rel=1e-5)
    assert not found.disagree


def test_noise_twice_stated_size_is_reported_as_disagreement(rng):
    found = compare_maps("thickness", *two_estimates(rng, stated=0.5))
    assert not share_is(found.beyond[0], CHANCE_FRACTIONS[0])
    assert found.disagree


def test_spot_shifted_by_five_standard_errors_is_located(rng):
    one, other = two_estimates(rng)
    values = other.values.copy()
    values[20:60, 100:140] += 2.5
    found = compare_maps("thickness", one, SkinMap(values, "mm", other.stderr))
    assert found.disagree
    spot = np.zeros((SIDE, SIDE), bool)
    spot[20:60, 100:140] = True
    far = np.abs(found.sigmas) > 3.0
    assert far[spot].mean() > 0.95  # 5 sigma less 1 sigma of noise: 97.7 % lie beyond 3
    assert far[~spot].mean() < 0.01


def turned(normals, angle, direction):
    """Turn normals near z by small angles in directions across them."""
    shift = angle[..., None] * np.stack([np.cos(direction), np.sin(direction)], axis=-1)
    out = np.concatenate([shift, np.ones((*angle.shape, 1))], axis=-1)
    return out / np.linalg.norm(out, axis=-1, keepdims=True)


def noisy_normals(rng, spread, stated):
    x, y = rng.normal(0.0, spread, (2, SIDE, SIDE))
    normals = turned(None, np.hypot(x, y), np.arctan2(y, x))
    return SkinMap(normals, "1", np.full(normals.shape, stated))


def test_normals_with_stated_errors_differ_as_expected(rng):
    honest = [noisy_normals(rng, 0.01, 0.01) for _ in range(2)]
    found = compare_maps("normals", *honest)
    assert found.unit == "°"
    for share, expected in zip(found.beyond, CHANCE_FRACTIONS, strict=True):
        assert share_is(share, expected)
    assert not found.disagree
    assert compare_maps("normals", *(noisy_normals(rng, 0.01, 0.005) for _ in range(2))).disagree


def test_equal_maps_differ_by_zero_despite_zero_error():
    one = SkinMap(np.ones((3, 4)), "mm", np.zeros((3, 4)))
    found = compare_maps("thickness", one, one)
    assert found.high == 0.0
    assert found.beyond == (0.0, 0.0, 0.0)
    assert not found.disagree


def test_pixels_masked_in_either_estimate_are_counted_only():
    valid = np.array([[True, False, True]])
    one = SkinMap(np.ones((1, 3)), "mm", np.ones((1, 3)), valid)
    found = compare_maps("thickness", one, SkinMap(np.full((1, 3), 2.0), "mm", np.ones((1, 3))))
    assert (found.pixels, found.only_a, found.only_b) == (2, 0, 1)
    assert np.isnan(found.difference[0, 1])


def test_color_map_shows_channel_of_largest_difference():
    one = SkinMap(np.zeros((1, 1, 3)), "1", np.ones((1, 1, 3)))
    other = SkinMap(np.array([[[0.0, -6.0, 3.0]]]), "1", np.ones((1, 1, 3)))
    found = compare_maps("r_d", one, other)
    assert found.sigmas[0, 0] == pytest.approx(-6.0 / math.sqrt(2.0))
    assert found.difference[0, 0] == pytest.approx(-1.0)


@pytest.mark.parametrize(
    ("other", "word"),
    [
        (SkinMap(np.ones((2, 3)), "mm"), r"shapes \(2, 2\) and \(2, 3\)"),
        (SkinMap(np.ones((2, 2)), "um"), "units 'mm' and 'um'"),
    ],
)
def test_unsubtractable_maps_are_refused_with_difference(other, word):
    with pytest.raises(ValueError, match=word):
        compare_maps("thickness", SkinMap(np.ones((2, 2)), "mm"), other)


def write_maps(folder, rng, *, shift=0.0, **parameters):
    melanin = np.full((40, 50), 0.05)
    noisy = melanin * (1 + shift) + rng.normal(0, 0.001, melanin.shape)
    store.write(
        folder,
        SkinAppearance(
            {"melanin": SkinMap(noisy, MAP_UNITS["melanin"], np.full(melanin.shape, 0.001))},
            "simulated",
            parameters={"truth": "truth", **parameters},
            inputs={"session": f"sha256:{folder.name}"},
        ),
    )
    return folder


def write_truth(folder):
    maps = {
        name: SkinMap(np.full((40, 50), 0.05), MAP_UNITS["melanin"] if name == "melanin" else "1")
        for name in ("melanin", "melanin_blurred")
    }
    store.write(folder, SkinAppearance(maps, "simulated", parameters={"kind": "truth"}))
    return folder


def write_bench(path, seconds=1.0):
    points = tuple(
        Point({"n": n}, Timing(n * seconds, (n, n), 2 * n, 1.0), 1 / n, (0.9 / n, 1.1 / n))
        for n in (1, 2, 4)
    )
    stage = StageBenchmark("inversion", "error, %", "truth", 0.1, points, (Limit("s", 2, 3, "<="),))
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(to_document([stage])))
    return path


@pytest.fixture
def folders(tmp_path, rng):
    return {
        "a": write_maps(tmp_path / "a", rng, step=1),
        "b": write_maps(tmp_path / "b", rng, step=2, shift=0.3),
        "truth": write_truth(tmp_path / "truth"),
        "bench": write_bench(tmp_path / "bench.json"),
    }


@pytest.mark.parametrize(
    ("given", "compared"),
    [
        (("a", "b"), True),
        (("a", "b", "truth"), True),
        (("a", "truth"), False),  # a set of maps and what it is judged by: one collection
        (("a", "bench"), False),
        (("a", "b", "bench"), False),
        (("a",), False),
    ],
)
def test_two_inputs_of_same_kind_make_a_comparison(folders, given, compared):
    paths = [folders[name] for name in given]
    assert (run_comparison.split_sides(paths) is not None) == compared
    assert run_comparison.split_sides(paths, require_comparison=False) is None


def test_comparison_of_other_than_two_runs_is_refused(folders):
    with pytest.raises(ReportError, match=r"a \(maps\).*truth \(truth\), expected two of one kind"):
        report.build_any([folders["a"], folders["truth"]], compare=True)
    with pytest.raises(ReportError, match="does not exist"):
        report.build_any([folders["a"], folders["a"] / "nothing"])


def test_worsened_check_is_reported_first(folders):
    done = report.build_any([folders["a"], folders["b"], folders["truth"]])
    assert done.compared == ("A: a", "B: b")
    assert "1 of 1 checks changed their verdict, 1 from kept to missed." in done.html
    assert "1 of 1 maps differ significantly." in done.html
    assert "Errors against the ground truths" in done.html
    assert "parameter step" in done.html
    assert done.html == report.build_any([folders["a"], folders["b"], folders["truth"]]).html


def test_comparison_without_truth_leaves_better_run_undecided(folders):
    html = report.build_any([folders["a"], folders["b"]]).html
    assert "errors are unknown" in html
    assert "Errors against the ground truths" not in html


def test_two_runs_are_paired_by_folder_names(tmp_path, rng):
    for run in ("one", "two"):
        (tmp_path / run).mkdir()
        write_maps(tmp_path / run / "face", rng)
    write_maps(tmp_path / "two" / "hand", rng)
    html = report.build_any([tmp_path / "one", tmp_path / "two"]).html
    assert "Maps: face" in html
    assert "Only in one" in html
    assert "hand" in html


def test_runs_of_same_frames_are_reported_as_correlated(tmp_path, rng):
    for run in ("one", "two"):
        (tmp_path / run).mkdir()
        write_maps(tmp_path / run / "face", rng)
    assert (
        "Both estimates are from the same frames"
        in report.build_any([tmp_path / "one", tmp_path / "two"]).html
    )


def test_two_benchmarks_are_compared_setting_by_setting(tmp_path):
    paths = [write_bench(tmp_path / name / "bench.json", s) for name, s in (("x", 1.0), ("y", 2.0))]
    html = report.build_any(paths).html
    assert "Settings measured in both runs" in html
    assert '<td class="n">2</td>' in html  # seconds of B over those of A


def test_meshes_at_other_positions_are_not_subtracted(tmp_path, rng):
    for name, at in (("a", 0.0), ("b", 8.0)):
        place = np.zeros((20, 20, 3))
        place[..., 0], place[..., 1] = np.meshgrid(np.arange(20.0) + at, np.arange(20.0))
        maps = {
            "position": SkinMap(place, "mm"),
            "r_d": SkinMap(np.full((20, 20, 3), 0.3), "1", np.full((20, 20, 3), 0.01)),
        }
        store.write(tmp_path / name, SkinAppearance(maps, "simulated"))
    html = report.build_any([tmp_path / "a", tmp_path / "b"]).html
    assert "texels of the two meshes differ by 8.0 mm" in html


def test_errors_against_the_truth_come_with_their_band(folders):
    rows = map_comparison.list_truth_errors(store.read(folders["b"]), store.read(folders["truth"]))
    assert {row.skin for row in rows} == {"all", "melanin 0.05–0.1"}
    assert all(row.error == pytest.approx(30.0, abs=0.3) for row in rows)
    assert map_comparison.MAX_FRACTION_BEYOND > CHANCE_FRACTIONS[-1]
