"""Every file of an export has its source and the subject's consent in its format's own metadata."""

import json

import MaterialX
import OpenEXR
import pytest
from PIL import Image

from model import store
from skinrig import consent
from skinrig.exporting.export import export
from skinrig.exporting.options import ExportSettings
from skinrig.exporting.sealing import PROVENANCE_KEY, describe_provenance, format_provenance


def read_exr(path):
    with OpenEXR.File(str(path)) as file:
        return file.header()[PROVENANCE_KEY]


def read_png(path):
    with Image.open(path) as image:
        return image.info[PROVENANCE_KEY]


def read_materialx(path):
    document = MaterialX.createDocument()
    MaterialX.readFromXmlFile(document, str(path))
    valid, message = document.validate()
    assert valid, message
    return document.getAttribute(PROVENANCE_KEY)


def read_usd(path):
    usd = pytest.importorskip("pxr.Usd")
    stage = usd.Stage.Open(str(path))  # its layers live as long as it
    return stage.GetRootLayer().customLayerData[PROVENANCE_KEY]


READERS = {".exr": read_exr, ".png": read_png, ".mtlx": read_materialx, ".usdc": read_usd}


@pytest.mark.parametrize(
    ("to", "suffixes"),
    [
        ("maps", {".exr", ".png", ".mtlx"}),
        ("mtlx", {".exr", ".png", ".mtlx"}),
        ("usd", {".exr", ".png", ".mtlx", ".usdc"}),
    ],
)
def test_each_file_has_provenance_with_consent(patch, tmp_path, to, suffixes):
    if to == "usd":
        pytest.importorskip("pxr")
    parameters = {consent.CONSENT_KEY: [patch.consent], "assumed": ['light "D65" <é>']}
    face = patch.face(source="measured", parameters=parameters)
    settings = ExportSettings(with_errors=True)
    done = export(store.write(tmp_path / "a", face), tmp_path / "out", to, settings, use="research")
    files = [path for path in sorted(done.path.rglob("*")) if path.suffix in READERS]
    assert {path.suffix for path in files} == suffixes
    for path in files:
        found = json.loads(READERS[path.suffix](path))
        assert found == describe_provenance(face), path.name
        assert found[consent.CONSENT_KEY] == [patch.consent], path.name


def test_provenance_is_one_ascii_line(patch):
    text = format_provenance(patch.face(parameters={"assumed": ["é\n"]}))
    assert text.isascii()
    assert "\n" not in text
