"""Faults of polarized pairs and gradient patterns, from images on disk to the marks of maps."""

import json

import pytest
from fixtures.faulty_patterns import make_pair, make_state
from fixtures.pattern_sessions import write_gradient_session, write_photographs

from capture.importers import import_photos
from capture.session import Session
from model import store
from skinrig.cli import main

SEED = 2
"""A ball, whose outline shows the signs of axes."""


def diagnose(session, capsys, *more):
    code = main(["diagnose", str(session), "--json", *more])
    return code, json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def images():
    return make_state(SEED)[0]


def exchange(images, one, other):
    return {**images, one: images[other], other: images[one]}


def test_sound_patterns_have_no_finding(images, tmp_path, capsys):
    code, found = diagnose(write_gradient_session(tmp_path / "s", images), capsys)
    assert (code, found["findings"]) == (0, [])
    assert len(found["names"]) == 14


@pytest.mark.parametrize(
    ("one", "other", "fault"),
    [
        (("x", "crossed"), ("y", "crossed"), "exchanged patterns"),
        (("z", "parallel"), ("-x", "parallel"), "exchanged patterns"),
        (("-y", "parallel"), ("-y", "crossed"), "exchanged polarizers"),
    ],
)
def test_exchanged_images_are_named(images, one, other, fault, tmp_path, capsys):
    session = write_gradient_session(tmp_path / "s", exchange(images, one, other))
    page = tmp_path / "page.html"
    code, found = diagnose(session, capsys, "--out", str(page))
    assert code == 1
    (finding,) = found["findings"]
    named = [found["names"][number - 1] for number in finding["images"]]
    assert finding["fault"] == fault
    assert sorted(named) == sorted(f"a000_n0 {light} {name}" for name, light in (one, other))
    shown = page.read_text()
    assert all(f"{name}</figcaption>" in shown for name in named)


def test_image_that_plan_has_is_missing(images, tmp_path, capsys):
    images = {key: image for key, image in images.items() if key != ("y", "crossed")}
    code, found = diagnose(write_gradient_session(tmp_path / "s", images), capsys)
    assert code == 1
    (finding,) = found["findings"]
    assert finding["fault"] == "missing pattern"
    assert found["names"][finding["images"][0] - 1] == "a000_n0 crossed y"


def test_series_without_inverse_patterns_is_complete(images, tmp_path, capsys):
    four = {key: image for key, image in images.items() if not key[0].startswith("-")}
    code, found = diagnose(write_gradient_session(tmp_path / "s", four), capsys)
    assert (code, found["findings"]) == (0, [])
    turned = exchange(exchange(four, ("x", "crossed"), ("y", "crossed")), *XY_PARALLEL)
    code, found = diagnose(write_gradient_session(tmp_path / "t", turned), capsys)
    assert code == 1
    assert {one["fault"] for one in found["findings"]} == {"exchanged patterns"}
    for one in found["findings"]:
        named = [found["names"][number - 1].split() for number in one["images"]]
        assert len({light for _, light, _ in named}) == 1
        assert {pattern for _, _, pattern in named} == {"x", "y"}


XY_PARALLEL = ("x", "parallel"), ("y", "parallel")


@pytest.mark.parametrize("fault", ["", "exchanged"])
def test_maps_of_patterns_name_remaining_faults(images, fault, tmp_path, capsys):
    if fault:
        images = exchange(images, ("z", "parallel"), ("-x", "parallel"))
    session = write_gradient_session(tmp_path / "s", images)
    argv = ["reconstruct", str(session), "--maps", "crossed", "--out", str(tmp_path / "a")]
    assert main(argv) == 0
    printed = capsys.readouterr().out
    found = store.read(tmp_path / "a")
    description = found.maps["crossed_a000_n0"].description
    mark = "images have faults: exchanged patterns (a000_n0 parallel z and 1 more)"
    assert (mark in description) == bool(fault)
    assert ("exchanged patterns" in printed) == bool(fault)
    assert len(found.parameters["diagnosis"]) == bool(fault)


@pytest.mark.parametrize(
    ("fault", "names"),
    [
        ("", []),
        ("exchanged", ["exchanged polarizers"]),
        ("crossed exposed longer", ["unequal exposures"]),
    ],
)
def test_imported_pair_and_its_maps_name_faults(fault, names, tmp_path, capsys):
    parallel, crossed, _ = make_pair(fault, SEED, tone="medium")
    sound = make_pair("", SEED + 3)[:2]
    folder = write_photographs(tmp_path / "f", {"anna": (parallel, crossed), "ben": sound})
    session = tmp_path / "s"
    assert main(["import", "photos", str(folder), "--out", str(session), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [one["fault"] for one in printed["findings"]] == names
    code, found = diagnose(session, capsys)
    assert code == bool(names)
    assert all(one["images"] == [1, 2] for one in found["findings"])
    assert found["names"] == [f"{who} {light}" for who, light in PHOTOGRAPHS]
    argv = ["reconstruct", str(session), "--maps", "diffuse,specular", "--state", "anna"]
    assert main([*argv, "--out", str(tmp_path / "a")]) == 0
    maps = store.read(tmp_path / "a").maps
    marks = [f"images have faults: {name} (anna parallel and 1 more)" for name in names]
    for one in (maps["diffuse"], maps["specular"]):
        assert all(mark in one.description for mark in marks)
        assert ("images have faults" in one.description) == bool(names)


PHOTOGRAPHS = [(who, light) for who in ("anna", "ben") for light in ("parallel", "crossed")]


def test_unnamed_polarizer_makes_no_pair(tmp_path, capsys):
    pair = make_pair("", SEED)[:2]
    folder = write_photographs(tmp_path / "f", {"anna": pair, "ben": pair})
    (folder / "anna crossed.tif").rename(folder / "anna.tif")
    session = tmp_path / "s"
    assert main(["import", "photos", str(folder), "--out", str(session)]) == 0
    assert len(Session.open(session).frames("subject", state="anna")) == 2
    capsys.readouterr()
    code, found = diagnose(session, capsys)
    assert (code, found["names"]) == (0, ["ben parallel", "ben crossed"])
    for file in folder.glob("ben*"):
        file.unlink()
    assert not import_photos(folder, out=tmp_path / "t").has_pairs


def test_photographs_without_pairs_are_refused(tmp_path, capsys):
    parallel, crossed, _ = make_pair("", SEED)
    folder = write_photographs(tmp_path / "f", {"anna": (parallel, crossed)})
    (folder / "anna parallel.tif").unlink()
    assert main(["import", "photos", str(folder), "--out", str(tmp_path / "s")]) == 0
    assert main(["diagnose", str(tmp_path / "s")]) == 3
    assert "expected a polarized pair" in capsys.readouterr().err
