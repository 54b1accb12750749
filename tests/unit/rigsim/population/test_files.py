"""Subjects by a file: what it says is what the face, the patch and the tissue are made of."""

import dataclasses
import math

import numpy as np
import pytest

from model.store import write_exr
from rigsim.fiber.probe_tissue import SkinTissue, TissueError
from rigsim.population import files as subject_file
from rigsim.population.files import load_subject, read_subject_file, record_subject
from rigsim.population.population import get_member
from rigsim.population.textures import SubjectFileError, resample_texture
from rigsim.subject import pigment
from rigsim.subject.perfusion import STATE_NAMES
from rigsim.subject.person import make_subject
from rigsim.subject.person_skin import PersonSkin, draw_tissue
from rigsim.tissue.skin_layers import PAPER_SKIN, TYPICAL_SKIN

SCHEMA = 'schema = "skinrig.subject/1"\n'


@pytest.fixture
def person(tmp_path):
    def write(text, name="ann"):
        path = tmp_path / f"{name}.toml"
        path.write_text(SCHEMA + text, encoding="utf-8")
        return str(path)

    return write


def test_file_without_settings_gives_default_preset(person):
    assert read_subject_file(person("")) == load_subject("III")


def test_preset_name_gives_face_of_that_preset():
    by_name, made = load_subject("V").face(seed=3, size=64), make_subject("V", seed=3, size=64)
    np.testing.assert_array_equal(by_name.melanin, made.melanin)
    np.testing.assert_array_equal(by_name.hemoglobin("anger"), made.hemoglobin("anger"))


def test_melanin_between_two_presets_is_between_their_faces(person):
    low, high = (pigment.MELANIN_PRESETS[name] for name in ("III", "IV"))
    face = read_subject_file(person(f"melanin = {(low * high) ** 0.5}\nfreckles = 0.5")).face(
        seed=2, size=64
    )
    below, above = (
        read_subject_file(person(f'preset = "{name}"\nfreckles = 0.5', name))
        .face(seed=2, size=64)
        .melanin
        for name in ("III", "IV")
    )
    covered = face.atlas.covered
    medians = [float(np.median(map_[covered])) for map_ in (below, face.melanin, above)]
    assert medians[0] < medians[1] < medians[2]
    assert medians[1] / medians[0] == pytest.approx((high / low) ** 0.5, rel=0.05)


def test_blood_is_factor_and_freckles_follow_requested_positions(person):
    usual = read_subject_file(person("")).face(seed=4, size=64)
    more = read_subject_file(person("blood = 2\nfreckles = 1\noil = 1.5")).face(seed=4, size=64)
    np.testing.assert_allclose(
        more.perfusion.compartments, 2 * usual.perfusion.compartments, rtol=1e-6
    )
    none = read_subject_file(person("freckles = 0")).face(seed=4, size=64)
    covered = usual.atlas.covered
    assert np.all(more.melanin[covered] >= none.melanin[covered])
    assert np.any(more.melanin[covered] > 1.2 * none.melanin[covered])
    assert more.oiliness == 1.5


@pytest.mark.parametrize("ending", ["npy", "exr"])
def test_file_textures_become_face_maps(person, tmp_path, rng, ending):
    own = {
        "melanin_map": rng.uniform(0.01, 0.3, (64, 64)).astype(np.float32),
        "hemoglobin_map": rng.uniform(0.0, 0.3, (64, 64)).astype(np.float32),
    }
    for name, values in own.items():
        if ending == "npy":
            np.save(tmp_path / f"{name}.npy", values)
        else:
            write_exr(tmp_path / f"{name}.exr", values)
    text = "".join(f'{name} = "{name}.{ending}"\n' for name in own)
    face = read_subject_file(person(text)).face(seed=1, size=64)
    np.testing.assert_array_equal(face.melanin, own["melanin_map"])
    np.testing.assert_allclose(face.hemoglobin(), own["hemoglobin_map"], rtol=1e-5, atol=1e-9)
    assert all(np.isfinite(face.hemoglobin(state)).all() for state in STATE_NAMES)
    finer = read_subject_file(person(text)).face(seed=1, size=128)
    inner = finer.melanin[1:-1, 1:-1]  # bilinear: a row is a quarter on from the first of the file
    down = 0.75 * own["melanin_map"][:-1] + 0.25 * own["melanin_map"][1:]
    np.testing.assert_allclose(inner[0, 0], 0.75 * down[0, 0] + 0.25 * down[0, 1], rtol=1e-5)


def test_patch_and_tissue_belong_to_same_person(person):
    ann = read_subject_file(person("melanin = 0.1\nblood = 1.5"))
    patch, plain = (
        ann.patch("cheek", seed=1, size_mm=0.3),
        load_subject("V").patch("cheek", seed=1, size_mm=0.3),
    )
    assert patch.skin == ann.tissue(seed=1).person.at("cheek") == ann.skin(seed=1).at("cheek")
    assert patch.albedo.mean() < plain.albedo.mean()
    usual = SkinTissue(PersonSkin(0.1, seed=1))
    assert ann.tissue(seed=1).melanin("cheek") == usual.melanin("cheek")
    assert patch.skin.c_hd == pytest.approx(1.5 * usual.person.at("cheek").c_hd, rel=1e-4)
    assert not any(ann.unused_keys(rig) for rig in ("flash", "dome", "gradient", "probe"))


def test_record_distinguishes_files_of_same_name(person, tmp_path):
    path = person('preset = "IV"\nmelanin_map = "m.npy"')
    np.save(tmp_path / "m.npy", np.full((64, 64), 0.1, np.float32))
    first = record_subject(path)
    np.save(tmp_path / "m.npy", np.full((64, 64), 0.2, np.float32))
    assert record_subject(path)["melanin_map"]["sha256"] != first["melanin_map"]["sha256"]
    assert {key: first[key] for key in ("file", "preset")} == {"file": "ann.toml", "preset": "IV"}
    assert str(tmp_path) not in str(first)
    assert record_subject("IV") == "IV"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("melanin = 0.9", r"melanin: got 0\.9, expected 0\.001 to 0\.45"),
        ("blood = 0", "blood: got 0"),
        ("melanine = 0.1", "did you mean melanin"),
        ('preset = "VII"', "preset: got 'VII'"),
        ('melanin = "dark"', "melanin"),
        ("melanin = nan", "melanin"),
        ('mesh = "none.obj"', r"mesh: got .*none\.obj, expected an existing file"),
        ('mesh = "text.npz"', r"mesh: .*text\.npz: cannot be read as \.npz"),
        ('mesh = "objects.npz"', r"mesh: .*objects\.npz: .*arrays of numbers"),
        ('mesh = "text.obj"', r"mesh: .*text\.obj"),
        ('mesh = "flat.npy"', r"mesh: .*expected \.npz or \.obj"),
        ('melanin_map = "none.npy"', r"melanin_map: got .*none\.npy, expected an existing file"),
        ('melanin_map = "flat.npy"', r"got float64 of shape \(64,\)"),
        ('melanin_map = "much.npy"', r"got 0\.9 to 0\.9, expected finite volume fractions"),
        ('melanin_map = "holes.npy"', "finite volume fractions"),
        ('melanin_map = "flat.png"', r"expected \.npy or \.exr"),
        ('melanin_map = "several.npy"', r"no valid \.npy file"),
        ('melanin_map = "text.npy"', r"no valid \.npy file"),
        ('melanin_map = "header.npy"', r"got float64 of shape \(1000000, 1000000\)"),
        ('melanin_map = "large.npy"', r"got float32 of shape \(8193, 8193\)"),
        ('melanin_map = "cut.npy"', "got 10 bytes of data, expected 32768 "),
        ('melanin_map = "objects.npy"', "got object of shape"),
        ('melanin_map = "text.exr"', "expected an OpenEXR image"),
        ('melanin = 0.1\nmelanin_map = "flat.npy"', "no melanin or freckles together with it"),
        ('blood = 2\nhemoglobin_map = "flat.npy"', "no blood together with it"),
        ("melanin", "is not TOML"),
    ],
)
def test_subject_file_error_names_fault(person, tmp_path, text, said):
    np.save(tmp_path / "flat.npy", np.ones(64))
    np.save(tmp_path / "much.npy", np.full((64, 64), 0.9))
    np.save(tmp_path / "holes.npy", np.full((64, 64), np.nan))
    np.savez(tmp_path / "several.npz", a=np.ones((64, 64)))
    (tmp_path / "several.npz").rename(tmp_path / "several.npy")
    for name, kind, side in (
        ("header", "<f8", 10**6),
        ("large", "<f4", 8193),
        ("cut", "<f8", 64),
        ("objects", "|O", 64),
    ):
        with (tmp_path / f"{name}.npy").open("wb") as stream:
            header = {"descr": kind, "fortran_order": False, "shape": (side, side)}
            np.lib.format.write_array_header_1_0(stream, header)
            stream.write(bytes(10))
    objects = {name: np.array([{}]) for name in ("vertices_mm", "faces", "uv")}
    np.savez(tmp_path / "objects.npz", **objects)
    for name in ("flat.png", "text.npy", "text.exr", "text.npz", "text.obj"):
        (tmp_path / name).write_text("words", encoding="utf-8")
    with pytest.raises(SubjectFileError, match=said) as caught:
        read_subject_file(person(text))
    assert "ann.toml" in str(caught.value) or "_map" in str(caught.value)
    assert "pickle" not in str(caught.value)


def test_subject_file_errors_are_reported_together(person):
    with pytest.raises(SubjectFileError) as caught:
        read_subject_file(person('melanin = 0.9\nblood = 9\npreset = "VII"'))
    assert all(name in str(caught.value) for name in ("melanin", "blood", "preset"))


def test_type_range_and_name_errors_are_reported_together(tmp_path):
    (tmp_path / "ann.toml").write_text(
        'melanin = nan\nblood = inf\noil = -1\nfre = 2\npreset = 3\nmesh = "none.obj"\n',
        encoding="utf-8",
    )
    with pytest.raises(SubjectFileError, match="7 faults") as caught:
        read_subject_file(tmp_path / "ann.toml")
    keys = [fault.path for fault in caught.value.faults]
    assert sorted(keys) == ["blood", "fre", "melanin", "mesh", "oil", "preset", "schema"]
    assert "preset: got 3, expected a valid string" in str(caught.value)


def test_unknown_key_gives_single_error(person):
    with pytest.raises(SubjectFileError, match=r"a\.b.*an unknown key"):
        read_subject_file(person('"a.b" = 1\n"" = 2'))


@pytest.mark.parametrize("size", [64, 77, 100])
def test_downsampled_texels_are_area_means(tmp_path, rng, size):
    """Expected: means over a grid so fine that it divides both, in double precision."""
    values = rng.uniform(0.01, 0.3, (128, 128)).astype(np.float32)
    np.save(tmp_path / "m.npy", values)
    small = resample_texture("melanin_map", str(tmp_path / "m.npy"), size)
    parts = math.lcm(128, size)
    rows = np.arange(parts) * 128 // parts  # of the file, for each fine row
    by_row = values.astype(np.float64)[rows].reshape(size, -1, 128).mean(axis=1)
    expected = by_row[:, rows].reshape(size, size, -1).mean(axis=2)
    np.testing.assert_allclose(small, expected, rtol=2e-6)


def test_fine_stripes_leave_no_coarse_ones(tmp_path):
    """Of 2.56 texels two, a bright and a dark one, make up for each other; 0.56 are left."""
    values = np.tile(np.array([0.01, 0.3], np.float32), (256, 128))
    np.save(tmp_path / "m.npy", values)
    small = resample_texture("melanin_map", str(tmp_path / "m.npy"), 100)
    assert np.abs(small - 0.155).max() <= 0.145 * 0.56 / 2.56 * (1.0 + 1e-4)
    assert small.mean() == pytest.approx(0.155, rel=1e-5)


def test_unknown_tissue_is_refused_with_hint_of_files():
    with pytest.raises(TissueError, match=r"got 'ann\.TOML'.*or a file NAME\.toml"):
        subject_file.load_tissue("ann.TOML", seed=0)
    with pytest.raises(TissueError) as caught:
        subject_file.load_tissue("homogeneous:-1,1", seed=0)
    assert "a file NAME" not in str(caught.value)


def test_file_with_other_or_missing_schema_is_refused(tmp_path):
    for text in ('schema = "skinrig.subject/2"\n', "melanin = 0.1\n"):
        (tmp_path / "ann.toml").write_text(text, encoding="utf-8")
        with pytest.raises(SubjectFileError, match="schema"):
            read_subject_file(tmp_path / "ann.toml")


@pytest.mark.parametrize("text", ["VII", "ann", "none.toml"])
def test_neither_preset_nor_file_is_refused(text):
    with pytest.raises(SubjectFileError, match=r"file not found|or a file NAME\.toml"):
        subject_file.load_subject(text)


def test_a_mesh_is_named_once(person, tmp_path):
    corners = "v 0 0 0\nv 9 0 0\nv 0 9 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    (tmp_path / "face.obj").write_text(corners, encoding="utf-8")
    with pytest.raises(SubjectFileError, match="omit the other mesh"):
        read_subject_file(person('mesh = "face.obj"')).face(seed=0, size=64, mesh="other.obj")


def test_properties_of_the_tissue_reach_every_rig(person):
    ann = read_subject_file(person('tissue_model = "papers"\noxygenation = 0.5'))
    expected = dataclasses.replace(PAPER_SKIN, oxygenation=0.5)
    assert ann.face(seed=1, size=64).tissue == expected
    assert ann.patch("cheek", seed=1, size_mm=0.3).skin.tissue == expected
    top = ann.tissue(seed=1).optics("cheek", 0.0, 60.0).stacks[0].layers[0]
    assert top.thickness_mm == expected.epidermis_mm
    typical = read_subject_file(person('tissue_model = "typical"'))
    assert typical.face(seed=1, size=64).tissue == TYPICAL_SKIN
    drawn = load_subject("III")
    assert drawn.face(seed=1, size=64).tissue == drawn.skin(seed=1).tissue == draw_tissue(1)


def test_impossible_tissue_is_refused_by_name(person):
    with pytest.raises(SubjectFileError) as caught:
        read_subject_file(person('tissue_model = "wax"\nepidermis_mm = 3.0'))
    known = "drawn, published, typical, papers"
    assert f"tissue_model: got 'wax', expected one of {known}" in str(caught.value)
    assert "epidermis_mm: got 3.0, expected 0.03 to 0.4" in str(caught.value)


def test_tone_in_file_replaces_melanin(person):
    ann = read_subject_file(person('tone = "ita:40"'))
    assert ann == dataclasses.replace(load_subject("ita:40"), preset=ann.preset)
    pale, dark = (ann.melanosome_fraction(seed=seed) for seed in (1, 2))
    assert pale != dark  # each seed's skin has its own optics
    with pytest.raises(SubjectFileError, match="tone: got 'ita:40', expected no melanin"):
        read_subject_file(person('tone = "ita:40"\nmelanin = 0.03'))
    with pytest.raises(SubjectFileError, match="expected monk:1 to monk:10"):
        read_subject_file(person('tone = "monk:11"'))


def test_member_in_file_keeps_all_but_changes(person):
    own = get_member("P12")
    changed = read_subject_file(person('member = "P12"\nmelanin = 0.06\nblood = 1.5\n')).person()
    assert changed == dataclasses.replace(own, melanin=0.06, blood=1.5 * own.blood)
    same = load_subject(person('member = "P12"\n', "same"))
    np.testing.assert_array_equal(same.face(seed=9, size=64).melanin, own.face(64).melanin)
    assert same.skin(seed=9) == own.skin
    assert read_subject_file(person("", "nobody")).person() is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('member = "P99"\n', "P99"),
        ('member = "P12"\ntone = "ita:20"\n', "no tone together with it"),
        ("beard = 0.5\n", "a member together with it"),
        ('member = "P12"\nmelanin = 0.4\n', "melanin of P12"),
    ],
)
def test_unusable_member_in_file_is_refused(person, text, said):
    with pytest.raises(SubjectFileError, match=said):
        read_subject_file(person(text))
