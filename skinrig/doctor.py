"""Check the installation, with a fix for each fault."""

import importlib.metadata
import importlib.util
import os
import platform
import sys
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class InstallationCheck:
    """Result of one check."""

    what: str
    state: str
    fine: bool
    fix: str = ""
    """Command or action that removes the fault; empty if none is needed."""


FIX_KEY = "remedy"
"""Key of `InstallationCheck.fix` in the document skinrig.doctor/2."""
_PROTOCOL = "compare the firmware with docs/reference/wire-protocol.md"
_OTHER_NAMES = {
    "serial": "pyserial",
    "cv2": "opencv-contrib-python-headless",
    "colour": "colour-science",
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
    "jinja2": "Jinja2",
    "PIL": "pillow",
}
"""Distribution by module, where their names differ."""
_REQUIRED_PACKAGES = {
    module: _OTHER_NAMES.get(module, module)
    for module in (
        "numpy scipy numba pydantic serial xxhash rawpy tifffile OpenEXR cv2 colour skimage "
        "sklearn mitsuba matplotlib jinja2 PIL pygltflib"
    ).split()
}
_EXTRA_PACKAGES = {
    "distributed": "cluster",
    "pxr": "usd",
    "gphoto2": "gphoto",
    "harvesters": "genicam",
    "playwright": "browser",
    "skfem": "fem",
}


def check_controller(url: str) -> list[InstallationCheck]:
    """Judge the controller at a serial URL; nothing lights, moves or sucks."""
    from capture.devices.checkup import CheckupPort, judge_controller

    with CheckupPort(url) as port:
        return [
            InstallationCheck(found.what, found.state, found.fine, "" if found.fine else _PROTOCOL)
            for found in judge_controller(port)
        ]


def check_installation(*, probe_renderer: bool = True) -> list[InstallationCheck]:
    """Check Python, packages, the renderer's variant, threads and serial ports.

    Parameters
    ----------
    probe_renderer
        Also load the renderer, which takes 1 to 2 s.
    """
    new_enough = sys.version_info >= (3, 11)
    fix = "" if new_enough else "install Python 3.11 or newer"
    findings = [InstallationCheck("Python", platform.python_version(), new_enough, fix)]
    for module, name in _REQUIRED_PACKAGES.items():
        present = importlib.util.find_spec(module) is not None
        state = importlib.metadata.version(name) if present else "missing"
        findings.append(
            InstallationCheck(name, state, present, "" if present else f"pip install {name}")
        )
    for module, extra in _EXTRA_PACKAGES.items():
        present = importlib.util.find_spec(module) is not None
        state = "installed" if present else "not installed"
        fix = "" if present else f"pip install 'skinrig[{extra}]' when you need it"
        findings.append(InstallationCheck(f"optional: {extra}", state, True, fix))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    findings.append(InstallationCheck("cores", str(cores), True))
    if probe_renderer:
        findings.append(_renderer())
    findings.append(_serial_ports())
    if importlib.util.find_spec("harvesters") is not None:
        findings.append(_camera_producers())
    return findings


def _renderer() -> InstallationCheck:
    from rigsim.mitsuba import variant

    choice = variant.choose_variant()
    vectorized = choice.is_vectorized
    fix = "" if vectorized else "for Mitsuba install LLVM 17 or newer: apt-get install libllvm19"
    found = f"{choice.name} ({choice.why}); renderer of sessions: {choice.renderer}"
    return InstallationCheck("Mitsuba variant", found, True, fix)


def _serial_ports() -> InstallationCheck:
    from capture.devices.port_url import serial_ports

    ports = serial_ports()
    fix = "" if ports else "not needed for simulation; connect the rig and run doctor again"
    return InstallationCheck("serial ports", ", ".join(ports) or "none", True, fix)


def _camera_producers() -> InstallationCheck:
    from capture.devices.camera import CameraUrlError
    from capture.devices.cameras.genicam_producer import PRODUCER_PATH_VARIABLE, producer_files

    try:
        state = ", ".join(file.name for file in producer_files("genicam", ""))
    except CameraUrlError:
        state = ""
    fix = f"install the camera maker's software and set {PRODUCER_PATH_VARIABLE} to its folder"
    return InstallationCheck("GenTL producers", state or "none", True, "" if state else fix)
