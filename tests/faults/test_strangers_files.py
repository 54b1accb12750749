"""Files of strangers: each is read, or refused by one clear error, in the memory of a good one.

Mutations are drawn by a seed. The attacks of the table are what an enemy would write.
"""

import contextlib
import dataclasses
import gc
import importlib.util
import io
import json
import tracemalloc
import warnings
import zipfile

import numpy as np
import pytest
from fixtures.mutations import mutate
from fixtures.product_code import ROOT
from fixtures.strangers_files import FORMATS

from skinrig import errors

EXTRA_BYTES = 8 * 2**20
FEW, MANY = 25, 1200


def write_good(folder, form):
    path = folder / form.file
    if not form.file.startswith("s/"):
        path.parent.mkdir(parents=True, exist_ok=True)
    form.write(path)
    return path


def unclear_error(form, path):
    """Return what is unclear about the outcome of reading a file, empty for nothing."""
    printed = io.StringIO()
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(printed):
            warnings.simplefilter("ignore")  # of NumPy and Pillow, about what is then refused
            form.read(path)
    except Exception as error:
        if errors.exit_code(error) != errors.EXIT_BAD_INPUT or not str(error).strip():
            return repr(error)[:200]
    return f"printed {printed.getvalue()[:100]!r}" if printed.getvalue() else ""


@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", FORMATS)
def test_mutated_file_is_read_or_clearly_refused(tmp_path, name, count):
    form = FORMATS[name]
    path = write_good(tmp_path, form)
    good = path.read_bytes()
    assert unclear_error(form, path) == ""
    form.read(path)
    rng = np.random.default_rng([count, *name.encode()])
    found = {}
    for number in range(max(2, int(count * form.weight))):
        path.write_bytes(mutate(good, rng))
        if unclear := unclear_error(form, path):
            found[number] = unclear
    assert found == {}


def npz(**arrays):
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()


def npy_of(header, body=b""):
    """Return an array whose header is one's own."""
    text = header.encode().ljust(118) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + body


def npz_of(header, body=b""):
    """Return an archive with such an array."""
    data = npy_of(header, body)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("faces.npy", data)
    return content.getvalue()


def twice():
    content = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(content, "w") as archive:
        warnings.simplefilter("ignore")
        for _ in range(2):
            archive.writestr("uv.npy", b"x")
    return content.getvalue()


def edited(change):
    """Return a function that edits the JSON of a good file."""

    def edit(good):
        document = json.loads(good)
        change(document)
        return json.dumps(document).encode()

    return edit


def of_exr(good):
    """Declare a data window of 40,000 by 40,000 pixels."""
    place = good.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4 + 8
    return good[:place] + (39_999).to_bytes(4, "little") * 2 + good[place + 8 :]


HUGE = "{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776,), }"
OBJECTS = "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }"
PICKLE = b"cos\nsystem\n(S'false'\ntR."
ATTACKS = {
    "npz declares terabytes": ("npz", lambda good: npz_of(HUGE)),
    "npz holds a pickle": ("npz", lambda good: npz_of(OBJECTS, PICKLE)),
    "npy declares terabytes": ("npy", lambda good: npy_of(HUGE)),
    "npy holds a pickle": ("npy", lambda good: npy_of(OBJECTS, PICKLE)),
    "npz header with a syntax error": ("npz", lambda good: npz_of(HUGE.replace("}", "("))),
    "npz has a name twice": ("npz", lambda good: twice()),
    "npz negative shape": ("npz", lambda good: npz_of(HUGE.replace("109", "-109"))),
    "npz blend shapes pickle": ("npz blend shapes", lambda good: npz_of(OBJECTS, PICKLE)),
    "exr map declares gigabytes": ("exr map", of_exr),
    "exr photograph declares gigabytes": ("exr photograph", of_exr),
    "gltf accessor of 2^40 rows": (
        "gltf",
        edited(
            lambda d: d["accessors"][1].update(count=2**40) or d["accessors"][1].pop("bufferView")
        ),
    ),
    "gltf buffer in a parent": (
        "gltf",
        edited(lambda d: d["buffers"][0].update(uri="../../../etc/passwd")),
    ),
    "gltf buffer at a path": ("gltf", edited(lambda d: d["buffers"][0].update(uri="/etc/passwd"))),
    "gltf nested": ("gltf", lambda good: b'{"asset":' + b"[" * 200_000),
    "json nested": ("json", lambda good: b"[" * 200_000),
    "json key twice": ("json", lambda good: b'{"a": 1, "a": 2}'),
    "json NaN": ("json", lambda good: b'{"a": NaN}'),
    "json long number": ("json", lambda good: b"[" + b"9" * 100_000 + b"]"),
    "json plan nested": ("json plan", lambda good: b'{"a":' * 200_000),
    "toml nested": ("toml rig", lambda good: b"a = " + b"[" * 100_000),
    "toml key twice": ("toml rig", lambda good: b"name = 'a'\nname = 'b'\n"),
    "obj index of 2^63": ("obj", lambda good: good.replace(b"f 1/1", b"f 9223372036854775808/1")),
    "ply of 2^40 vertices": (
        "ply",
        lambda good: good.replace(b"vertex 3", b"vertex 1099511627776"),
    ),
    "png of 2^31 pixels": ("png", lambda good: good[:16] + b"\x00\x00\x80\x00" * 2 + good[24:]),
    "lp of 2^63 lights": ("lp", lambda good: good.replace(b"2\n", b"9223372036854775808\n", 1)),
    "merl of 2^31 bins": ("merl", lambda good: b"\xff\xff\xff\x7f" * 3 + good[12:100]),
    "appearance nested": ("APPEARANCE", lambda good: b"[" * 200_000),
    "appearance file outside": (
        "APPEARANCE",
        lambda good: good.replace(b'"albedo.exr"', b'"../x/albedo.exr"'),
    ),
    "calibration nested": ("CALIBRATION", lambda good: b"[" * 200_000),
    "session nested": ("SESSION manifest", lambda good: b"[" * 200_000),
}


def peak_bytes(act):
    gc.collect()
    tracemalloc.start()
    try:
        return act(), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.long
@pytest.mark.parametrize("attack", ATTACKS)
def test_attack_is_refused_within_memory(tmp_path, attack):
    name, forge = ATTACKS[attack]
    form = FORMATS[name]
    path = write_good(tmp_path, form)
    _, of_good = peak_bytes(lambda: form.read(path))
    path.write_bytes(forge(path.read_bytes()))
    with pytest.raises(Exception) as caught:  # its kind is judged below
        form.read(path)
    assert errors.exit_code(caught.value) == errors.EXIT_BAD_INPUT, repr(caught.value)
    unclear, peak = peak_bytes(lambda: unclear_error(form, path))
    assert unclear == ""
    assert peak <= 3 * of_good + EXTRA_BYTES


def test_link_out_of_the_folder_is_not_followed(tmp_path):
    form = FORMATS["gltf"]
    (tmp_path / "model").mkdir()
    path = write_good(tmp_path / "model", form)
    (tmp_path / "secret.bin").write_bytes(bytes(102))
    (tmp_path / "model" / "data.bin").symlink_to(tmp_path / "secret.bin")
    path.write_bytes(edited(lambda d: d["buffers"][0].update(uri="data.bin"))(path.read_bytes()))
    with pytest.raises(ValueError, match="expected a file next to it"):
        form.read(path)


def test_fuzzer_has_every_reader():
    path = ROOT / "tools/fuzz_readers.py"
    spec = importlib.util.spec_from_file_location("fuzz_readers", path)
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    assert set(tool.READERS) == set(FORMATS)
    assert set(tool.sum_runs()[0]) <= set(FORMATS)


def test_unclear_outcomes_are_found(tmp_path):
    def raising(error):
        def read(path):
            raise error

        return dataclasses.replace(FORMATS["json"], read=read)

    for error in (KeyError("a"), MemoryError(), RecursionError("deep"), ValueError("")):
        assert unclear_error(raising(error), tmp_path)
    assert "printed" in unclear_error(
        dataclasses.replace(FORMATS["json"], read=lambda path: print("warning")), tmp_path
    )
    assert unclear_error(raising(ValueError("got 1, expected 2")), tmp_path) == ""
