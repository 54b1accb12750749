"""Every package that skinrig installs has a license that its own, MIT, may be combined with."""

import importlib.metadata
import re

import pytest
from fixtures.product_code import ROOT, text_of

PAGE = ROOT / "docs/reference/licenses.md"
COMPATIBLE = (
    *("0BSD", "Apache-2.0", "Apache-2.0 WITH LLVM-exception", "BSD-2-Clause", "BSD-3-Clause"),
    *("CC0-1.0", "ISC", "LGPL-3.0-or-later", "MIT", "MIT-CMU", "MPL-2.0", "PSF-2.0", "Zlib"),
    "LicenseRef-TOST-1.0",  # OpenUSD: Apache-2.0 with another clause on trademarks
)
OPTIONAL_ALONE = {"genicam": "LicenseRef-GenICam-1.6"}
"""Licenses of their own, of packages that only their extra installs."""
SHORT_NAMES = {
    "Apache 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "BSD": "BSD-3-Clause",
    "BSD 2-Clause License": "BSD-2-Clause",
    "BSD 3-Clause License": "BSD-3-Clause",
    "BSD License": "BSD-3-Clause",
    "ISC License": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
    "The MIT License": "MIT",
    "The MIT License (MIT)": "MIT",
}
ROW = re.compile(r"\| ([\w.-]+) \| ([^|]+) \|")


def listed():
    return dict(ROW.findall(text_of(PAGE).partition("| --- |")[2]))


def installed_names():
    lines = text_of(ROOT / "constraints.txt").splitlines()
    return [line.partition("==")[0] for line in lines if "==" in line]


def stated(name):
    """Return the license in a package's metadata, empty where it is not stated there."""
    metadata = importlib.metadata.metadata(name)
    text = metadata.get("License-Expression") or (metadata.get("License") or "").strip()
    text = text if len(text) < 60 and text not in ("UNKNOWN", "Files: *") else ""
    kinds = [line.split(" :: ")[-1] for line in metadata.get_all("Classifier") or ()]
    known = [SHORT_NAMES[kind] for kind in kinds if kind in SHORT_NAMES]
    text = SHORT_NAMES.get(text, text)
    return text if text.split(" ")[0] in COMPATIBLE else (known or [""])[0]


def test_page_lists_every_installed_package():
    assert sorted(listed(), key=str.lower) == sorted(installed_names(), key=str.lower)


def test_licenses_on_page_are_compatible():
    for name, license_ in listed().items():
        for part in re.split(r" AND | OR ", license_):
            assert part in COMPATIBLE or OPTIONAL_ALONE.get(name) == part, (name, part)


@pytest.mark.parametrize("name", installed_names())
def test_license_on_page_is_that_of_metadata(name):
    try:
        found = stated(name)
    except importlib.metadata.PackageNotFoundError:
        pytest.skip(f"optional, not installed: {name}")
    assert found in ("", listed()[name])
