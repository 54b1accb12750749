"""Edited appearances: identity, return, masks, extremes, and the commands as a user meets them."""

import dataclasses
import json

import numpy as np
import pytest

from model import store
from model.skin import SkinMap
from model.skin_reflectance import load_basis
from model.traits.storage import load
from skinrig.appearances import contents, face_textures
from skinrig.cli import main
from skinrig.drawing import png
from skinrig.editing import edit as editing
from skinrig.editing.edit import EditError, EditRequest
from skinrig.editing.spots import SpotRequest


@pytest.fixture(scope="module")
def lab(tmp_path_factory, dome_faces):
    """Eight faces, half of them tanned, half oily, and the traits learned of them."""
    folder = tmp_path_factory.mktemp("lab")
    paths, labels = dome_faces.population(folder)
    argv = ["fit", "traits", *map(str, paths), "--labels", str(labels), "--out"]
    assert main([*argv, str(folder / "traits.npz")]) == 0
    return folder, paths, labels


@pytest.fixture(scope="module")
def library(lab):
    return load(lab[0] / "traits.npz")


@pytest.fixture(scope="module")
def source(lab):
    return face_textures.read(lab[1][0])


def digests(folder):
    """Return the hash of each file that belongs to each map."""
    maps = store.read_document(folder).maps
    return {n: [getattr(m, k) for k in ("values", "stderr", "valid")] for n, m in maps.items()}


def rms(a, b, where):
    return float(np.sqrt(np.mean((a[where].astype(float) / b[where] - 1.0) ** 2)))


@pytest.mark.long
def test_an_edit_of_amount_zero_changes_no_bit(lab, capsys):
    folder, paths, _ = lab
    out = folder / "zero"
    argv = ["edit", str(paths[0]), "--space", str(folder / "traits.npz"), "--out", str(out)]
    assert main([*argv, "--trait", "tan=0,oily=0", "--spots", "moles=0"]) == 0
    assert "nothing changed" in capsys.readouterr().out
    assert digests(out) == digests(paths[0])
    assert store.read(out).files == store.read(paths[0]).files
    record = store.read(out).parameters["edit"]
    assert record["traits"] == {"tan": 0.0, "oily": 0.0}
    assert store.read(out).inputs["appearance"] == contents.hash_file(
        paths[0] / store.DOCUMENT_FILE
    )


@pytest.mark.long
def test_tan_edit_darkens_only_albedo_as_in_population(source, library):
    done = editing.edit_face(source, EditRequest(traits={"tan": 1.0}), library)
    assert done.changed == ("r_d",)
    old, new = source.appearance.maps["r_d"], done.appearance.maps["r_d"]
    good = old.valid
    change = np.log(new.values[good] / old.values[good]).mean(axis=0)
    np.testing.assert_allclose(change, -0.35 * np.array([1.0, 1.1, 1.2]), rtol=0.2)
    # what of it the face's age brought along is in the spread of the population
    assert np.all((new.values[good] > 0) & (new.values[good] <= 1))
    np.testing.assert_allclose(
        new.stderr[good] / new.values[good], old.stderr[good] / old.values[good], rtol=1e-5
    )
    assert done.record["albedo"]["distance_after"] < done.record["albedo"]["distance_before"]


@pytest.mark.long
def test_edit_and_opposite_return_source_within_stated_error(source, library):
    order = EditRequest(traits={"tan": 0.8, "oily": 0.6})
    there = editing.edit_face(source, order, library)
    face = dataclasses.replace(source, appearance=there.appearance)
    opposite = EditRequest(traits={"tan": -0.8, "oily": -0.6}, seed=7)
    back = editing.edit_face(face, opposite, library)
    good = source.r_d.valid
    moved = rms(there.appearance.maps["r_d"].values, source.r_d.values, good)
    left = rms(back.appearance.maps["r_d"].values, source.r_d.values, good)
    told = there.record["albedo"]["return_error_rms"]
    assert moved > 0.2
    assert left < 0.03
    assert left < 3.0 * told + 0.002
    for k in range(4):
        name = f"basis_weight_{k}"
        np.testing.assert_allclose(
            back.appearance.maps[name].values[good],
            source.appearance.maps[name].values[good],
            atol=0.02,
        )
    assert back.record["before"]["traits"] == {"tan": 0.8, "oily": 0.6}


@pytest.mark.long
def test_oil_edit_changes_only_lobes_as_in_population(source, library):
    done = editing.edit_face(source, EditRequest(traits={"oily": 1.0}), library)
    assert "r_d" not in done.changed
    assert "lobe_residual" not in done.appearance.maps
    assert (
        "lobe_residual",
        "residual of the basis BRDFs before the edit",
    ) in done.appearance.left_out
    good = source.r_d.valid
    change = [
        float(
            (
                done.appearance.maps[f"basis_weight_{k}"].values
                - source.appearance.maps[f"basis_weight_{k}"].values
            )[good].mean()
        )
        for k in range(4)
    ]
    assert abs(change[0] - 0.3) < 0.06
    assert abs(change[3] + 0.6 * 0.35) < 0.08
    lobes = load_basis(done.appearance)  # maps and file go together
    assert lobes.size == done.record["surface"]["lobes"]


@pytest.mark.long
@pytest.mark.parametrize("traits", [{"tan": 1.0}, {"oily": 1.0}])
def test_mask_keeps_every_bit_where_black(traits, source, library, tmp_path):
    shape = source.r_d.values.shape[:2]
    mask = np.zeros(shape, np.uint8)
    mask[10:40, 8:24] = 255
    (tmp_path / "mask.png").write_bytes(png.encode(mask))
    order = EditRequest(
        traits=traits, mask=tmp_path / "mask.png", spots=(SpotRequest("freckles", 1.0, 3.0),)
    )
    done = editing.edit_face(source, order, library)
    most = 0.0
    for name in set(done.changed) & set(source.appearance.maps) - {"lobe_residual"}:
        old, new = source.appearance.maps[name].values, done.appearance.maps[name].values
        np.testing.assert_array_equal(new[mask == 0], old[mask == 0])
        most = max(most, float(np.abs(new - old)[mask > 0].max()))
    assert most > 0.05


@pytest.mark.long
def test_region_edit_changes_beard_not_forehead(source, library):
    done = editing.edit_face(source, EditRequest(traits={"tan": 1.0}, region="beard"), library)
    height = source.position[..., 1]
    good = source.r_d.valid
    ratio = done.appearance.maps["r_d"].values / source.r_d.values
    assert np.all(ratio[good & (height > 25)] == 1.0)
    chin = good & (np.abs(height + 60) < 4) & (np.abs(source.position[..., 0]) < 15)
    assert ratio[chin].mean() < 0.9


@pytest.mark.long
def test_edit_has_no_seam_between_texture_islands(source, library):
    """Both sides of the cut at height 0 darken alike."""
    done = editing.edit_face(source, EditRequest(traits={"tan": 1.0}), library)
    change = np.log(done.appearance.maps["r_d"].values / source.r_d.values).mean(axis=-1)
    half = change.shape[1] // 2
    across = change[4:-4, half - 3] - change[4:-4, half + 2]
    within = change[4:-4, half - 3] - change[4:-4, half - 4]
    # the cut is crossed by one texel's step as any other
    assert np.sqrt(np.mean(across**2)) < 2.0 * np.sqrt(np.mean(within**2)) + 0.01


@pytest.mark.long
@pytest.mark.parametrize(
    "kind", [{"flat": True}, {"color": (0.02, 0.012, 0.009)}, {"color": (0.97, 0.96, 0.95)}]
)
def test_single_colors_darkest_and_whitest_faces_survive(kind, dome_faces, library, tmp_path):
    face = face_textures.read(dome_faces.write(tmp_path, 3, **kind))
    good = face.r_d.valid
    old = face.r_d.values[good]
    for amount in (2.0, -2.0):
        new = editing.edit_face(face, EditRequest(traits={"tan": amount}), library)
        spotted = dataclasses.replace(face, appearance=new.appearance)
        moles = editing.edit_face(
            spotted, EditRequest(traits={}, spots=(SpotRequest("moles", 1.0, 1.0),))
        )
        for one in (new, moles):
            values = one.appearance.maps["r_d"].values[good]
            assert np.isfinite(values).all()
            assert values.min() > 0
            assert np.all(values <= np.maximum(old, 1.0))
        change = new.appearance.maps["r_d"].values[good].mean() - old.mean()
        assert change < 0 if amount > 0 else change >= 0


@pytest.mark.long
def test_reflectance_above_white_is_kept_but_never_made(source, library):
    r_d = source.r_d
    values = r_d.values.copy()
    values[20:23, 12:15] = 1.3
    maps = {**source.appearance.maps, "r_d": dataclasses.replace(r_d, values=values)}
    face = dataclasses.replace(source, appearance=dataclasses.replace(source.appearance, maps=maps))
    done = editing.edit_face(face, EditRequest(traits={"tan": -1.0}), library)
    new = done.appearance.maps["r_d"].values
    assert new[r_d.valid].max() <= np.float32(1.3)
    outlier = (values > 1).any(axis=-1)
    assert new[r_d.valid & ~outlier].max() <= 1.0


@pytest.mark.long
def test_face_without_lobes_is_edited_in_albedo(source, library):
    maps = {n: m for n, m in source.appearance.maps.items() if not n.startswith("basis")}
    face = dataclasses.replace(
        source, appearance=dataclasses.replace(source.appearance, maps=maps, files={})
    )
    assert editing.edit_face(face, EditRequest(traits={"tan": 0.5}), library).changed == ("r_d",)
    with pytest.raises(EditError, match="the appearance has albedo"):
        editing.edit_face(face, EditRequest(traits={"oily": 1.0}, parts=("surface",)), library)


@pytest.mark.long
def test_the_same_seed_makes_the_same_face(source, library):
    order = EditRequest(traits={"tan": 1.0}, spots=(SpotRequest("freckles", 1.0),), seed=5)
    one, two = (editing.edit_face(source, order, library).appearance.maps["r_d"] for _ in range(2))
    np.testing.assert_array_equal(one.values, two.values)
    other = editing.edit_face(source, dataclasses.replace(order, seed=6), library)
    assert not np.array_equal(other.appearance.maps["r_d"].values, one.values)


@pytest.mark.long
@pytest.mark.parametrize(
    ("argv", "code", "says"),
    [
        (["--trait", "tann=1"], 3, "did you mean 'tan'?"),
        (["--trait", "tan"], 2, "NAME=NUMBER"),
        (["--trait", "tan=1,tan=2"], 2, "each name once"),
        ([], 2, "neither traits nor spots"),
        (["--trait", "tan=1", "--region", "ears"], 3, "ears"),
        (["--trait", "tan=1", "--parts", "hair"], 3, "hair"),
        (["--spots", "pimples=1"], 3, "freckles, moles, follicles"),
        (["--spots", "moles=lots"], 2, "KIND=AMOUNT"),
        (["--spots", "moles=-2"], 3, "at least -1"),
        (["--trait", "tan=1", "--mask", "none.png"], 3, "none.png"),
        (["--trait", "tan=1", "--landmarks", "none.csv"], 3, "none.csv"),
        (["--trait", "tan=1000"], 3, "trait tan: got 1000, expected -10 to 10"),
        (["--trait", "tan=nan"], 3, "trait tan: got nan, expected -10 to 10"),
        (["--trait", "tan=1", "--iterations", "0"], 3, "--iterations: got 0, expected 1 or more"),
        (["--trait", "tan=1", "--seed", "-1"], 3, "--seed: got -1, expected 0 or more"),
    ],
)
def test_invalid_edit_gives_clear_error_and_writes_nothing(argv, code, says, lab, capsys):
    folder, paths, _ = lab
    out = folder / "wrong"
    space = ["--space", str(folder / "traits.npz")]
    assert main(["edit", str(paths[0]), *argv, *space, "--out", str(out)]) == code
    err = capsys.readouterr().err
    assert says in err
    assert "Traceback" not in err
    assert not out.exists()


@pytest.mark.long
def test_invalid_masks_are_refused_by_name(source, library, tmp_path):
    (tmp_path / "black.png").write_bytes(png.encode(np.zeros((64, 64), np.uint8)))
    (tmp_path / "wide.png").write_bytes(png.encode(np.ones((32, 64), np.uint8)))
    (tmp_path / "text.png").write_text("no picture")
    for name, says in (("black", "black everywhere"), ("wide", "64 x 32"), ("text", "as PNG")):
        with pytest.raises(ValueError, match=says):
            editing.edit_face(
                source, EditRequest(traits={"tan": 1.0}, mask=tmp_path / f"{name}.png"), library
            )


@pytest.mark.long
def test_an_interrupted_edit_leaves_nothing_half_written(lab, monkeypatch):
    folder, paths, _ = lab
    out = folder / "halted"
    writes = store.write_exr

    def stop(path, image):
        if path.name.startswith("r_d"):
            raise KeyboardInterrupt
        writes(path, image)

    monkeypatch.setattr(store, "write_exr", stop)
    argv = ["edit", str(paths[0]), "--space", str(folder / "traits.npz"), "--out", str(out)]
    before = {p.name for p in folder.iterdir()}
    assert main([*argv, "--trait", "tan=1"]) == 130
    assert {p.name for p in folder.iterdir()} == before


@pytest.mark.long
def test_json_is_single_document_of_performed_edit(lab, capsys):
    folder, paths, _ = lab
    argv = ["edit", str(paths[0]), "--space", str(folder / "traits.npz"), "--json"]
    assert main([*argv, "--trait", "age=10", "--out", str(folder / "older")]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["schema"] == "skinrig.edit/1"
    assert told["traits"] == {"age": 10.0}
    assert told["warnings"]


@pytest.mark.long
def test_the_source_is_never_written_over(lab, capsys):
    _, paths, _ = lab
    assert main(["edit", str(paths[0]), "--spots", "moles=1", "--out", str(paths[0])]) == 3
    assert "is the source" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.parametrize(
    ("table", "says"),
    [
        ("name,tan\n0,1\n", "no line for 1"),
        ("face,tan\n", "expected name,TRAIT"),
        ("name,tan\n0,yes\n1,0\n", "line 2, column tan: got 'yes'"),
        ("name,tan\n0,1\n0,1\n", "occurs twice"),
        ("name,tan\n0,1,1\n1,0\n", "got 3 cells"),
        ("name,tan\n0,0\n1,0\n", "nobody of 2 has it"),
        ("", "is empty"),
    ],
)
def test_bad_labels_give_single_clear_error(table, says, lab, tmp_path, capsys):
    _, paths, _ = lab
    (tmp_path / "labels.csv").write_text(table)
    out = tmp_path / "traits.npz"
    argv = ["fit", "traits", str(paths[0]), str(paths[1]), "--labels", str(tmp_path / "labels.csv")]
    assert main([*argv, "--out", str(out)]) == 3
    assert says in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.long
def test_faces_without_landmarks_are_refused_with_remedy(lab, tmp_path, dome_faces, capsys):
    _, paths, labels = lab
    bare = store.write(tmp_path / "appearance-1", dome_faces.face(1))
    argv = ["fit", "traits", str(paths[0]), str(bare), "--labels", str(labels)]
    assert main([*argv, "--out", str(tmp_path / "t.npz")]) == 3
    err = capsys.readouterr().err
    assert "--landmarks DIR" in err
    assert "1.csv" in err


@pytest.mark.long
def test_groups_of_fewer_than_five_are_warned_of(lab, capsys):
    folder, paths, labels = lab
    argv = ["fit", "traits", *map(str, paths), "--labels", str(labels), "--json"]
    assert main([*argv, "--out", str(folder / "again.npz")]) == 0
    told = json.loads(capsys.readouterr().out)
    assert any("only 4 faces with it" in text for text in told["warnings"])
    assert {row["trait"] for row in told["rows"]} == {"tan", "oily", "age"}


@pytest.mark.long
def test_landmark_table_in_texels_matches_mesh_landmarks(source, tmp_path):
    rows, columns = np.nonzero(source.surface)
    picked = {"nose tip": (int(columns[5]), int(rows[5])), "chin": (int(columns[9]), int(rows[9]))}
    table = tmp_path / "marks.csv"
    table.write_text("name,x,y\n" + "".join(f"{n},{x},{y}\n" for n, (x, y) in picked.items()))
    found = face_textures.read_landmarks(table, source)
    for name, (x, y) in picked.items():
        np.testing.assert_allclose(found[name], source.position[y, x])
    table.write_text("name,x,y\nchin,0,0\n")
    with pytest.raises(face_textures.FaceError, match="not on the surface"):
        face_textures.read_landmarks(table, source)
    table.write_text("name,x,y,z\nchin,0,-60.5,nan\n")
    with pytest.raises(ValueError, match="finite"):
        face_textures.read_landmarks(table, source)


@pytest.mark.long
def test_map_without_error_or_mask_is_edited(source, library):
    bare = {
        n: SkinMap(m.values, m.unit) for n, m in source.appearance.maps.items() if n != "position"
    }
    maps = {**bare, "position": source.appearance.maps["position"]}
    face = dataclasses.replace(source, appearance=dataclasses.replace(source.appearance, maps=maps))
    done = editing.edit_face(face, EditRequest(traits={"tan": 1.0}), library)
    assert done.appearance.maps["r_d"].stderr is None
