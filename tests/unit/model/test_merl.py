"""The MERL layout to the byte, and half/difference angles against their definition."""

import struct

import numpy as np
import pytest

from model import merl


@pytest.fixture(scope="module")
def table():
    rng = np.random.default_rng(3)
    stored = rng.exponential(size=(3, *merl.TABLE_SHAPE))
    stored[:, 89, 89, ::7] = -1.0
    return merl.MerlTable(stored)


def test_file_matches_published_layout_to_the_byte(table, tmp_path):
    path = tmp_path / "some.binary"
    merl.write(path, table)
    content = path.read_bytes()
    assert len(content) == 34_992_012
    assert struct.unpack("<3i", content[:12]) == (90, 90, 180)
    h, d, phi = 11, 22, 33
    for channel, scale in enumerate((1.0 / 1500.0, 1.15 / 1500.0, 1.66 / 1500.0)):
        offset = 12 + 8 * (1_458_000 * channel + phi + 180 * d + 16200 * h)
        (value,) = struct.unpack("<d", content[offset : offset + 8])
        theta_h = (11.5 / 90) ** 2 * np.pi / 2
        found = table.lookup(theta_h, 22.5 / 90 * np.pi / 2, 33.5 / 180 * np.pi)
        assert found[channel] == pytest.approx(value * scale, rel=1e-15)


def test_written_table_reads_back_unchanged(table, tmp_path):
    merl.write(tmp_path / "a.binary", table)
    back = merl.read(tmp_path / "a.binary")
    np.testing.assert_array_equal(back.stored, table.stored)
    merl.write(tmp_path / "b.binary", back)
    assert (tmp_path / "a.binary").read_bytes() == (tmp_path / "b.binary").read_bytes()


def test_foreign_file_unmeasured_entries_round_trip_byte_exact(tmp_path, rng):
    # -1 and other negative numbers, -0.0, denormal and huge values, as measured files hold them
    values = rng.choice([-1.0, -1500.0, -1e-9, -0.0, 5e-324, 0.0, 1.0, 3e7], 3 * 1_458_000)
    content = struct.pack("<3i", 90, 90, 180) + values.astype("<f8").tobytes()
    (tmp_path / "a.binary").write_bytes(content)
    merl.write(tmp_path / "b.binary", merl.read(tmp_path / "a.binary"))
    assert (tmp_path / "b.binary").read_bytes() == content


def test_channel_mean_is_known_where_all_are(table, tmp_path):
    stored = table.stored.copy()
    stored[1, 3, 4, 5] = -1e-3
    merl.write(tmp_path / "a.binary", merl.MerlTable(stored))
    mean = merl.read_mean(tmp_path / "a.binary")
    known = table.measured.copy()
    known[3, 4, 5] = False
    np.testing.assert_array_equal(np.isfinite(mean), known)
    expected = np.tensordot(merl.BRDF_SCALE, stored, 1)[known] / 3.0
    np.testing.assert_allclose(mean[known], expected, rtol=1e-14)


def test_entry_missing_any_channel_is_stored_as_unmeasured():
    values = np.ones((*merl.TABLE_SHAPE, 3))
    values[1, 2, 3, 2] = -0.5
    stored = merl.MerlTable.from_values(values).stored
    assert stored[:, 1, 2, 3].tolist() == [-1.0, -1.0, -1.0]
    np.testing.assert_allclose(stored[:, 0, 0, 0], 1.0 / merl.BRDF_SCALE, rtol=1e-15)


def test_truncated_and_foreign_files_are_named(table, tmp_path):
    merl.write(tmp_path / "good.binary", table)
    whole = (tmp_path / "good.binary").read_bytes()
    for name, content, message in [
        ("short", whole[:-8], "truncated: got 34992004 bytes"),
        ("long", whole + b"x", "followed by something else"),
        ("tiny", whole[:5], "got 5 bytes"),
        ("foreign", b"II*\0" + whole[4:], "90 x 180 bins, expected 90 x 90 x 180"),
        ("infinite", whole[:12] + struct.pack("<d", np.inf) + whole[20:], "not finite"),
    ]:
        (tmp_path / name).write_bytes(content)
        with pytest.raises(merl.MerlFileError, match=message):
            merl.read(tmp_path / name)


def test_unmeasured_entries_stay_negative(table):
    found = table.lookup(np.pi / 2, np.pi / 2, 0.001)
    assert np.all(found < 0.0)
    assert not table.measured[89, 89, 0]
    assert table.measured[89, 89, 1]


def test_lookups_at_bin_centers_return_each_bin(table):
    h, d, phi = merl.bin_centers()
    np.testing.assert_array_equal(
        table.lookup(h[:, None], d[None, :], phi[17]),
        np.moveaxis(table.stored[:, :, :, 17], 0, -1) * merl.BRDF_SCALE,
    )


def test_a_negative_azimuth_means_its_reciprocal(table):
    h, d, phi = 0.4, 0.7, np.linspace(0.01, 3.1, 50)
    np.testing.assert_array_equal(table.lookup(h, d, phi - np.pi), table.lookup(h, d, phi))


def test_angles_outside_the_table_are_refused(table):
    with pytest.raises(ValueError, match="theta_h"):
        table.lookup(1.7, 0.0, 0.0)
    with pytest.raises(ValueError, match="phi_d"):
        table.lookup(0.7, 0.0, np.nan)
    with np.errstate(all="raise"), pytest.raises(ValueError, match="phi_d"):
        table.lookup(0.7, 0.0, np.inf)
    with pytest.raises(ValueError, match=r"theta_h, theta_d, phi_d: got"):
        table.lookup(np.zeros(3), np.zeros(4), 0.0)


def directions(rng, n):
    v = rng.standard_normal((n, 3))
    v[:, 2] = np.abs(v[:, 2])
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def test_angles_follow_rusinkiewicz_by_two_rotations(rng):
    light, view = directions(rng, 500), directions(rng, 500)
    theta_h, theta_d, phi_d = merl.to_angles(light, view, [0.0, 0.0, 1.0])
    half = light + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    np.testing.assert_allclose(theta_h, np.arccos(half[:, 2]), atol=1e-12)
    np.testing.assert_allclose(np.cos(theta_d), np.sum(half * light, axis=1), atol=1e-14)
    # rotate by -phi_h about z, then by -theta_h about y: the half vector becomes z
    phi_h = np.arctan2(half[:, 1], half[:, 0])
    c, s = np.cos(-phi_h), np.sin(-phi_h)
    x, y, z = c * light[:, 0] - s * light[:, 1], s * light[:, 0] + c * light[:, 1], light[:, 2]
    c, s = np.cos(-theta_h), np.sin(-theta_h)
    x, z = c * x + s * z, -s * x + c * z
    np.testing.assert_allclose(np.cos(theta_d), z, atol=1e-13)
    np.testing.assert_allclose(phi_d, np.arctan2(y, x), atol=1e-10)


def test_angle_directions_round_trip_swapping_rotates_half_circle(rng):
    angles = merl.to_angles(directions(rng, 300), directions(rng, 300), [0.0, 0.0, 1.0])
    light, view = merl.to_directions(*angles)
    for back, angle in zip(merl.to_angles(light, view, [0.0, 0.0, 1.0]), angles, strict=True):
        np.testing.assert_allclose(back, angle, atol=1e-12)
    turned = merl.to_angles(view, light, [0.0, 0.0, 1.0])[2]
    np.testing.assert_allclose(np.mod(turned - angles[2], 2 * np.pi), np.pi, atol=1e-10)


def test_degenerate_directions_have_finite_angles():
    z, back = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])
    assert [float(a) for a in merl.to_angles(z, z, z)] == [0.0, 0.0, 0.0]
    assert np.all(np.isfinite(merl.to_angles(z, back, z)))
