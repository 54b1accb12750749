"""The choice of a Mitsuba variant, without importing Mitsuba here."""

import json
import os
from pathlib import Path

import pytest

from rigsim.mitsuba import variant

INSTALLED = variant.find_llvm_libraries({})


def library(folder: Path, name: str) -> Path:
    path = folder / name
    path.write_bytes(b"not a library")
    return path


def test_libraries_too_old_by_name_skip_probe(tmp_path, monkeypatch):
    monkeypatch.setattr(variant, "probe_library", lambda *_, **__: pytest.fail("probed"))
    for name in ("libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM.so.16.0"):
        verdict = variant.check_library(library(tmp_path, name), cache=tmp_path / "cache")
        assert not verdict.usable
        assert "older than 17" in verdict.why


def test_non_library_file_ends_probe_not_this_process(tmp_path):
    path = library(tmp_path, "libLLVM.so.99.1")
    verdict = variant.check_library(path, cache=tmp_path / "cache")
    assert not verdict.usable
    assert verdict.why


@pytest.mark.skipif(
    not any(0 < variant.major_version(path) < variant.MIN_LLVM_VERSION for path in INSTALLED),
    reason="no old LLVM library on this machine",
)
def test_real_old_library_is_refused_by_probe():
    for path in INSTALLED:
        if 0 < variant.major_version(path) < variant.MIN_LLVM_VERSION:
            assert not variant.probe_library(path).usable


def test_missing_usable_library_gives_scalar_variant_with_reason(tmp_path):
    old = library(tmp_path, "libLLVM-15.so.1")
    choice = variant.choose_variant(
        "spectral_polarized", environment={}, libraries=[old], cache=tmp_path
    )
    assert choice.name == "scalar_spectral_polarized"
    assert "libLLVM-15.so.1" in choice.why
    assert choice.library == ""
    assert not choice.is_vectorized


def test_first_usable_library_is_chosen_and_verdict_cached(tmp_path, monkeypatch):
    calls = []

    def probe(path, **_):
        calls.append(path)
        return variant.LibraryCheck(str(path), "20" in path.name, "tried")

    monkeypatch.setattr(variant, "probe_library", probe)
    paths = [library(tmp_path, "libLLVM.so.19.1"), library(tmp_path, "libLLVM.so.20.1")]
    for _ in range(2):
        choice = variant.choose_variant(
            "rgb", environment={}, libraries=paths, cache=tmp_path / "cache"
        )
        assert choice == variant.VariantChoice("llvm_ad_rgb", "tried works", str(paths[1]))
    assert len(calls) == 2


def test_a_changed_library_is_probed_again(tmp_path, monkeypatch):
    calls = []

    def probe(path, **_):
        calls.append(path)
        return variant.LibraryCheck(str(path), True, "tried")

    monkeypatch.setattr(variant, "probe_library", probe)
    path = library(tmp_path, "libLLVM.so.19.1")
    variant.check_library(path, cache=tmp_path / "cache")
    os.utime(path, ns=(1, 1))
    variant.check_library(path, cache=tmp_path / "cache")
    assert len(calls) == 2


@pytest.mark.parametrize("damage", ["", "[1, 2]", '{"a": 3}', "{"])
def test_a_damaged_cache_costs_a_probe_only(tmp_path, monkeypatch, damage):
    monkeypatch.setattr(
        variant, "probe_library", lambda path, **_: variant.LibraryCheck(str(path), True, "tried")
    )
    (tmp_path / "llvm.json").write_text(damage)
    assert variant.check_library(library(tmp_path, "libLLVM.so.19.1"), cache=tmp_path).usable
    assert len(json.loads((tmp_path / "llvm.json").read_text())) == 1


def test_environment_requests_scalar_variant_or_is_refused():
    assert variant.choose_variant("rgb", environment={"SKINRIG_MITSUBA": "scalar"}).why
    with pytest.raises(ValueError, match="SKINRIG_MITSUBA: got 'fast'"):
        variant.choose_variant("rgb", environment={"SKINRIG_MITSUBA": "fast"})
    with pytest.raises(ValueError, match="kind: got 'rbg'"):
        variant.choose_variant("rbg")  # type: ignore[arg-type]


def test_missing_llvm_is_reported_once(monkeypatch, caplog):
    monkeypatch.setenv("SKINRIG_MITSUBA", "scalar")
    variant._warn_of_fast.cache_clear()
    assert [variant.choose_renderer("mitsuba").renderer for _ in range(2)] == ["fast"] * 2
    assert caplog.messages == [
        "renderer: fast instead of mitsuba, which needs LLVM: requested by SKINRIG_MITSUBA=scalar"
    ]
    variant.choose_renderer("fast")
    assert len(caplog.messages) == 1
