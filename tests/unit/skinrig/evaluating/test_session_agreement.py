"""Verdicts on two sessions: false-alarm rate, found changes, registration, other cameras."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.evaluating.session_agreement import REGION_NAMES, SessionError, compare_sessions
from skinrig.evaluating.session_maps import SUBSURFACE_FILE

SIDE = 48
STATED, OPTICS = 0.3, 1.21
"""Stated relative uncertainty, and the factor by the person's optics, equal in both sessions."""


def face_position():
    x, y = np.meshgrid(np.linspace(-60.0, 60.0, SIDE), np.linspace(80.0, -80.0, SIDE))
    z = 90.0 - 0.008 * x**2 - 0.005 * y**2 + 3.0 * np.sin(x / 9.0) * np.cos(y / 13.0)
    return np.stack([x, y, z], axis=-1)


def region_of():
    cell = np.arange(SIDE) * 3 // SIDE
    return cell[:, None] * 3 + cell[None, :]


def session(seed, *, change=None, rotation=None, shift=(0.0, 0.0, 0.0), camera="A", order=None):
    """Return a session of one person whose errors are those of the stated model."""
    person, rng = np.random.default_rng(1), np.random.default_rng([seed, 3])
    pattern = gaussian_filter(person.standard_normal((SIDE, SIDE)), 2.0)
    maps = {}
    for name, level, face, region in (
        ("melanin", 0.03, 0.126, 0.029),
        ("hemoglobin", 0.02, 0.057, 0.042),
    ):
        true = level * (1.0 + pattern)
        if change and name in change:
            where, factor = change[name]
            inside = region_of() == REGION_NAMES.index(where) if where else np.ones_like(true)
            true = np.where(inside, factor * true, true)
        off = 1.0 + STATED * face * rng.standard_normal()
        off = off + STATED * region * rng.standard_normal(9)[region_of()]
        noise = 0.01 * level
        values = true * OPTICS * off + noise * rng.standard_normal(true.shape)
        stderr = np.full_like(values, STATED * level * OPTICS)
        maps[name] = SkinMap(values, MAP_UNITS[name], stderr)
        maps[f"{name}_noise_stderr"] = SkinMap(np.full_like(values, noise), "1")
    turn = np.eye(3) if rotation is None else rotation
    place = face_position() @ turn.T + shift
    facing = np.broadcast_to(turn[:, 2], place.shape).copy()
    facing += 0.01 * rng.standard_normal(place.shape)
    facing /= np.linalg.norm(facing, axis=-1, keepdims=True)
    maps["position"] = SkinMap(place, "mm")
    maps["normals"] = SkinMap(facing, "1", np.full_like(place, 0.01))
    if order is not None:
        maps = {
            name: dataclasses.replace(
                one,
                values=one.values[order],
                stderr=None if one.stderr is None else one.stderr[order],
            )
            for name, one in maps.items()
        }
    return SkinAppearance(maps, "simulated", parameters={"color_table": {"camera": camera}})


def turned(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def named(verdict, name):
    return next(one for one in verdict.quantities if one.name == name)


def test_false_alarm_rate_of_stated_errors_holds():
    found = [compare_sessions(session(2 * k), session(2 * k + 1)) for k in range(60)]
    # 1 % of 60: more than 3 alarms have a probability of 0.3 %
    assert sum(not verdict.same for verdict in found) <= 3
    # p-values are even between 0 and 1 where the stated errors are those of the sessions, and
    # somewhat higher, as both tests of a map depend on each other
    p_values = [named(verdict, n).p_value for verdict in found for n in ("melanin", "hemoglobin")]
    assert 0.4 < np.mean(p_values) < 0.7
    assert 0.04 < np.mean(np.array(p_values) < 0.2) < 0.36


def test_changed_cheek_is_found_and_named():
    for seed in range(20):
        change = {"melanin": ("middle left", 1.4)}
        verdict = compare_sessions(session(2 * seed), session(2 * seed + 1, change=change))
        assert not verdict.same, seed
        assert [one.name for one in verdict.changed] == ["melanin"]
    found = named(verdict, "melanin")
    assert found.place == "middle left"
    assert found.change == pytest.approx(33.0, abs=10.0)
    assert str(verdict).startswith("Same person, same state: no, by melanosome volume fraction +")


def test_flush_of_the_whole_face_is_found():
    change = {"hemoglobin": ("", 1.25)}
    verdict = compare_sessions(session(0), session(1, change=change))
    assert [one.name for one in verdict.changed] == ["hemoglobin"]
    assert named(verdict, "hemoglobin").place == "the whole skin"


def test_equal_sessions_are_the_same():
    verdict = compare_sessions(session(3), session(3))
    assert verdict.same
    assert all(one.rms < 1e-6 for one in verdict.quantities)
    assert str(verdict).startswith("Same person, same state: yes, by 4 quantities")


def test_moved_head_with_common_texture_is_same():
    moved = session(1, rotation=turned(3.0), shift=(2.0, -1.0, 3.0))
    verdict = compare_sessions(session(0), moved)
    assert verdict.same
    assert "common texture" in verdict.registered
    assert named(verdict, "shape").rms < 1e-3


def test_other_texture_pairs_nearest_points():
    order = (slice(None), np.random.default_rng(0).permutation(SIDE))
    verdict = compare_sessions(session(0), session(1, order=order, shift=(2.0, 1.0, 0.0)))
    assert "nearest points" in verdict.registered
    assert verdict.same
    assert named(verdict, "melanin").samples > 0.5 * SIDE**2


def test_other_camera_does_not_share_optics():
    change = {"melanin": ("middle left", 1.4)}
    verdict = compare_sessions(session(0), session(1, change=change, camera="B"))
    assert not verdict.shared_optics
    assert verdict.same


def test_deformed_face_is_found_by_shape():
    first, second = session(0), session(1)
    place = second.maps["position"].values.copy()
    place[32:, 16:32, 2] += 4.0
    maps = {**second.maps, "position": SkinMap(place, "mm")}
    verdict = compare_sessions(first, dataclasses.replace(second, maps=maps))
    # a face registered by a deformed surface is also tilted, which its normals show
    assert {one.name for one in verdict.changed} - {"normals"} == {"shape"}
    assert named(verdict, "shape").place == "lower center"


def patch(seed, shift=0):
    person, rng = np.random.default_rng([seed, 9]), np.random.default_rng([seed, shift, 4])
    relief = 70.0 * gaussian_filter(person.standard_normal((160, 160)), 2.0)
    seen = relief[20:148, 20 + shift : 148 + shift] + 0.1 * rng.standard_normal((128, 128))
    stderr = np.full(seen.shape, 0.4)
    return SkinAppearance({"height_a000_n0": SkinMap(seen, "um", stderr)}, "simulated")


def test_shifted_patch_is_same_and_other_is_not():
    assert compare_sessions(patch(1), patch(1, shift=6)).same
    other = compare_sessions(patch(1), patch(2))
    assert not other.same
    assert other.changed[0].name == "height_a000_n0"


def probe(values, stderr=0.02):
    rows = [
        {
            "site": site,
            "fits": [
                {
                    "channel": channel,
                    "method": "photon_table",
                    "valid": True,
                    "sigma_tr_per_mm": value,
                    "sigma_tr_stderr": stderr,
                    "sigma_tr_stderr_readings": 0.1 * stderr,
                }
                for channel in ("red", "green", "blue")
            ],
        }
        for site, value in values.items()
    ]
    file = json.dumps({"measurements": rows}).encode()
    return SkinAppearance({}, "simulated", files={SUBSURFACE_FILE: file})


def test_probe_sites_are_compared_by_name():
    first = probe({"cheek": 1.0, "chin": 1.2})
    assert compare_sessions(first, probe({"chin": 1.21, "cheek": 0.99})).same
    verdict = compare_sessions(first, probe({"chin": 1.2, "cheek": 1.3}))
    assert not verdict.same
    assert verdict.changed[0].place == "cheek"


def test_sessions_without_common_maps_are_refused():
    with pytest.raises(SessionError, match="expected maps of one kind of rig"):
        compare_sessions(session(0), probe({"cheek": 1.0}))
    with pytest.raises(SessionError, match="no common skin"):
        compare_sessions(probe({"chin": 1.0}), probe({"cheek": 1.0}))
    with pytest.raises(SessionError, match="false_alarm: got 0"):
        compare_sessions(session(0), session(1), false_alarm=0.0)
