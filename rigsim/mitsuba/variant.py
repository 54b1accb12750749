"""Choose the Mitsuba variant for this machine, without risk of a crash of this process.

Dr.Jit compiles its kernels with the LLVM library it finds. Libraries before version 17 abort
the process when a kernel is compiled (15, 16) or are refused (14). A library is therefore checked
first by the version in its file name, then by rendering eight by eight pixels in another process.
The verdict is cached in the user's cache folder by the library's real path and modification time.
"""

import contextlib
import json
import logging
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from glob import glob
from pathlib import Path
from typing import Final, Literal

from rigsim.mitsuba.render_error import RenderError

logger = logging.getLogger(__name__)

Kind = Literal["rgb", "mono", "mono_polarized", "spectral", "spectral_polarized"]

MIN_LLVM_VERSION: Final = 17
"""Oldest major version of LLVM with the intrinsics of Dr.Jit's kernels."""

PROBE_TIMEOUT_S: Final = 120.0
"""Time after which a probe counts as failed; it takes one second on an idle machine."""

# The scalar variants that are built into Mitsuba's wheels; a mono kind has no scalar twin.
_SCALAR_VARIANTS: Final[Mapping[Kind, str]] = {
    "rgb": "scalar_rgb",
    "mono": "scalar_rgb",
    "mono_polarized": "scalar_spectral_polarized",
    "spectral": "scalar_spectral",
    "spectral_polarized": "scalar_spectral_polarized",
}

_LLVM_FOLDERS: Final = (
    "/usr/lib/*-linux-gnu*",
    "/usr/lib/llvm-*/lib",
    "/usr/lib64",
    "/usr/lib64/llvm*/lib",
    "/usr/lib",
    "/usr/local/lib",
    "/usr/local/opt/llvm*/lib",
    "/opt/homebrew/opt/llvm*/lib",
    f"{sys.prefix}/lib",
)

_NOT_RUN: Final = "the probe did not finish"

_PROBE_SCRIPT: Final = """
import drjit as dr, drjit.llvm
if not dr.has_backend(dr.JitBackend.LLVM):
    raise SystemExit("no LLVM backend")
version = dr.detail.llvm_version()
if tuple(version) < (%d,):
    raise SystemExit("LLVM " + ".".join(map(str, version)) + " is too old")
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
scene = mi.load_dict({"type": "scene", "integrator": {"type": "path", "max_depth": 2},
    "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
    "light": {"type": "constant"}, "ball": {"type": "sphere", "center": [0.0, 0.0, 4.0]}})
image = mi.TensorXf(mi.render(scene, spp=1)).numpy()
if not (image > 0.0).any():
    raise SystemExit("the image is black")
print("LLVM " + ".".join(map(str, version)))
"""


@dataclass(frozen=True, slots=True)
class LibraryCheck:
    """Result of the check of one LLVM library."""

    path: str
    """Path of the library file, links resolved."""
    usable: bool
    """Whether kernels can be compiled with it."""
    why: str
    """Version when usable, otherwise the reason in words."""


Renderer = Literal["mitsuba", "fast", "reference"]
"""Renderers of a session's images: Mitsuba's scenes, compiled loops with Embree's rays, or voxels
of a patch of skin by Mitsuba."""


@dataclass(frozen=True, slots=True)
class VariantChoice:
    """The selected Mitsuba variant, with the reason."""

    name: str
    """Mitsuba's name of the variant, such as ``llvm_ad_rgb``."""
    why: str
    """Reason in words, for users."""
    library: str
    """Path of the LLVM library; empty for scalar variants."""

    @property
    def renderer(self) -> Renderer:
        """Return the renderer of a scene with this variant."""
        return "mitsuba" if self.is_vectorized else "fast"

    @property
    def is_vectorized(self) -> bool:
        """Whether arrays of rays are traced in one call."""
        return self.name.startswith("llvm")


def find_llvm_libraries(environment: Mapping[str, str] | None = None) -> tuple[Path, ...]:
    """Return the LLVM libraries of this machine, newest version first.

    Parameters
    ----------
    environment
        Environment variables; the file in its ``DRJIT_LIBLLVM_PATH`` comes first.

    Returns
    -------
    tuple of Path
        Real paths without duplicates. Libraries without a version in their name come last.
    """
    environment = os.environ if environment is None else environment
    found: dict[Path, None] = {}
    named = environment.get("DRJIT_LIBLLVM_PATH", "")
    if named:
        found[Path(named).resolve()] = None
    found.update(dict.fromkeys(_list_installed_libraries(_LLVM_FOLDERS)))
    return tuple(found)


@cache
def _list_installed_libraries(folders: tuple[str, ...]) -> tuple[Path, ...]:
    """Return the libraries in folders, newest version first; a search takes 40 ms."""
    candidates = {
        Path(name).resolve()
        for folder in folders
        for pattern in ("libLLVM.so*", "libLLVM-[0-9]*.so*", "libLLVM*.dylib")
        for name in glob(f"{folder}/{pattern}")
    }
    return tuple(sorted(candidates, key=lambda path: (-major_version(path), str(path))))


def major_version(path: Path) -> int:
    """Return the major version in an LLVM library's file name, 0 without one.

    Examples
    --------
    >>> major_version(Path("libLLVM.so.19.1")), major_version(Path("libLLVM-15.so.1"))
    (19, 15)
    >>> major_version(Path("libLLVM.so"))
    0
    """
    match = re.search(r"libLLVM(?:-|\.so\.)(\d+)", path.name)
    return int(match.group(1)) if match else 0


def check_library(path: Path, *, cache: Path | None = None) -> LibraryCheck:
    """Check, without risk to this process, whether an LLVM library is usable.

    Parameters
    ----------
    path
        The library file.
    cache
        Folder of cached verdicts; ``None``: the user's cache folder.

    Returns
    -------
    LibraryCheck
        Usable or not, with the reason.
    """
    path = path.resolve()
    version = major_version(path)
    if 0 < version < MIN_LLVM_VERSION:
        return LibraryCheck(str(path), False, f"LLVM {version} is older than {MIN_LLVM_VERSION}")
    if not path.is_file():
        return LibraryCheck(str(path), False, "file not found")
    folder = user_cache_dir() if cache is None else cache
    key = f"{path}|{path.stat().st_mtime_ns}|{sys.executable}"
    known = _read_cache(folder)
    if key in known:
        usable, why = known[key]
        return LibraryCheck(str(path), usable, why)
    verdict = probe_library(path)
    if _NOT_RUN not in verdict.why:  # a busy machine is not evidence against the library
        known[key] = (verdict.usable, verdict.why)
        _write_cache(folder, known)
    return verdict


def probe_library(path: Path, *, timeout_s: float = PROBE_TIMEOUT_S) -> LibraryCheck:
    """Render eight by eight pixels with an LLVM library in another process.

    Parameters
    ----------
    path
        The library file.
    timeout_s
        Time after which the probe counts as failed.

    Returns
    -------
    LibraryCheck
        Usable when the other process ended well; a crash there is a verdict here.
    """
    environment = dict(os.environ, DRJIT_LIBLLVM_PATH=str(path))
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE_SCRIPT % MIN_LLVM_VERSION],
            env=environment,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return LibraryCheck(str(path), False, f"{_NOT_RUN}: {error}")
    if done.returncode == 0 and done.stdout.strip():
        return LibraryCheck(str(path), True, done.stdout.strip().splitlines()[-1])
    message = (done.stderr.strip().splitlines() or ["no message"])[-1]
    if done.returncode < 0:
        message = f"it ended the probe by signal {-done.returncode}"
    return LibraryCheck(str(path), False, message)


def choose_renderer(renderer: Renderer) -> VariantChoice:
    """Return the variant of a renderer: "mitsuba" needs LLVM, otherwise its reason is in `why`.

    Raises
    ------
    RenderError
        "reference" without LLVM.

    Examples
    --------
    >>> choose_renderer("fast").renderer
    'fast'
    """
    if renderer == "fast":
        return VariantChoice(_SCALAR_VARIANTS["rgb"], "requested", "")
    choice = choose_variant("rgb")
    if not choice.is_vectorized:
        if renderer == "reference":
            raise RenderError(
                f"renderer: reference needs LLVM, got {choice.why}; install LLVM or use fast"
            )
        _warn_of_fast(choice.why)
    return choice


@cache
def _warn_of_fast(why: str) -> None:
    """Warn once that compiled loops make the images, as Mitsuba's scenes need LLVM."""
    logger.warning("renderer: fast instead of mitsuba, which needs LLVM: %s", why)


def choose_variant(
    kind: Kind = "rgb",
    *,
    environment: Mapping[str, str] | None = None,
    libraries: Iterable[Path] | None = None,
    cache: Path | None = None,
) -> VariantChoice:
    """Choose the fastest Mitsuba variant that works on this machine.

    Parameters
    ----------
    kind
        Required kind of variant: ``rgb``, ``mono``, ``mono_polarized``, ``spectral`` or
        ``spectral_polarized``.
    environment
        Environment variables; ``SKINRIG_MITSUBA=scalar`` requests a scalar variant.
    libraries
        LLVM libraries to consider, in this order; ``None`` searches for them.
    cache
        Folder of cached verdicts; ``None``: the user's cache folder.

    Returns
    -------
    VariantChoice
        Name, reason and library.

    Raises
    ------
    ValueError
        The kind is unknown, or the environment requests something else than ``scalar``.

    Examples
    --------
    >>> choose_variant("rgb", environment={"SKINRIG_MITSUBA": "scalar"}).name
    'scalar_rgb'
    """
    if kind not in _SCALAR_VARIANTS:
        raise ValueError(f"kind: got {kind!r}, expected one of {', '.join(_SCALAR_VARIANTS)}")
    environment = os.environ if environment is None else environment
    asked = environment.get("SKINRIG_MITSUBA", "")
    if asked == "scalar":
        return VariantChoice(_SCALAR_VARIANTS[kind], "requested by SKINRIG_MITSUBA=scalar", "")
    if asked not in ("", "llvm"):
        raise ValueError(
            f"SKINRIG_MITSUBA: got {asked!r}, expected scalar, llvm or nothing; correct it, or "
            "unset it [SR-ENV-005]"
        )
    refused = []
    for path in find_llvm_libraries(environment) if libraries is None else libraries:
        verdict = check_library(path, cache=cache)
        if verdict.usable:
            return VariantChoice(f"llvm_ad_{kind}", f"{verdict.why} works", verdict.path)
        refused.append(f"{verdict.path}: {verdict.why}")
        logger.debug("LLVM library refused: %s: %s", verdict.path, verdict.why)
    why = "; ".join(refused) if refused else "no LLVM library was found"
    return VariantChoice(_SCALAR_VARIANTS[kind], f"no LLVM {MIN_LLVM_VERSION} or newer ({why})", "")


def user_cache_dir() -> Path:
    """Return the folder of cached verdicts, by the XDG convention."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if base else Path.home() / ".cache") / "skinrig"


def _read_cache(folder: Path) -> dict[str, tuple[bool, str]]:
    try:
        document = json.loads((folder / "llvm.json").read_text(encoding="utf-8"))
        return {str(key): (bool(usable), str(why)) for key, (usable, why) in document.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}  # absent or damaged: the probe runs again


def _write_cache(folder: Path, known: Mapping[str, tuple[bool, str]]) -> None:
    # A read-only folder costs a probe each time, but does not fail the run.
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=folder, suffix=".json")
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            json.dump(known, file, indent=1)
        os.replace(name, folder / "llvm.json")
