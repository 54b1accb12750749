"""Load GenTL producers, the manufacturers' libraries, and connect to the cameras they find.

A producer is a file ``*.cti`` that comes with the camera manufacturer's software. One process can
open a producer only once, so the cameras of one producer share it; it is closed with the last of
them.
"""

import contextlib
import logging
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from capture.devices.camera import CameraBusy, CameraError, CameraUrlError
from capture.devices.port import LinkLost

PRODUCER_PATH_VARIABLE = "GENICAM_GENTL64_PATH"
"""Environment variable that lists the folders of producers (GenTL 1.6, section 3.3)."""

# a camera's answers to an invalid request; any other error means that it does not answer
_REFUSALS = (
    "Access OutOfRange InvalidArgument LogicalError Property InvalidParameter InvalidValue"
    " NotImplemented NotAvailable"
)
_REFUSAL_ERRORS = tuple(f"{name}Exception" for name in _REFUSALS.split())
_BUSY_ERRORS = ("AccessDeniedException", "ResourceInUseException", "BusyException")

# the library logs what it then raises, with a traceback; one message is enough
_library_log = logging.getLogger("capture.genicam_library")
_library_log.setLevel(logging.CRITICAL + 1)


class MissingHarvesters(CameraError, ImportError):
    """Raised when the optional library is not installed."""


@dataclass(frozen=True, slots=True)
class GenicamLibrary:
    """The parts in use of the packages ``harvesters`` and ``genicam``."""

    core: Any
    """``harvesters.core``."""
    errors: tuple[type[Exception], ...]
    """Exceptions of GenApi (features) and GenTL (transport)."""

    @contextlib.contextmanager
    def translate_errors(self, action: str) -> Iterator[None]:
        """Raise the library's errors as camera errors that name the action."""
        try:
            yield
        except self.errors as error:
            kind = type(error).__name__
            text = f"{action}: {' '.join(str(error).split()) or kind}"
            if kind in _BUSY_ERRORS:
                raise CameraBusy(
                    f"{text}; close the other program that has the camera [SR-CAP-023]"
                ) from error
            if kind in _REFUSAL_ERRORS:
                raise CameraError(text) from error
            raise LinkLost(
                f"{text}; the camera does not answer: check its cable and power, then open it again"
            ) from error


def load_library(url: str) -> GenicamLibrary:
    """Import the optional packages.

    Raises
    ------
    MissingHarvesters
    """
    try:
        from genicam import genapi, gentl
        from harvesters import core
    except ImportError as error:
        raise MissingHarvesters(
            f"{url}: needs the optional part 'genicam': pip install 'skinrig[genicam]' [SR-ENV-003]"
        ) from error
    return GenicamLibrary(core, (genapi.GenericException, gentl.GenericException))


def producer_files(url: str, given: str) -> tuple[Path, ...]:
    """Return the producer files to search for cameras.

    Parameters
    ----------
    url
        Address of the camera, for messages.
    given
        A file ``*.cti`` or a folder of such files; empty: the folders of the environment variable
        ``GENICAM_GENTL64_PATH``, which the manufacturers' installers set.

    Raises
    ------
    CameraUrlError
        When there is none.
    """
    places = [given] if given else os.environ.get(PRODUCER_PATH_VARIABLE, "").split(os.pathsep)
    folders = [Path(place) for place in places if place]
    files: dict[Path, None] = {}
    for folder in folders:
        for file in sorted(folder.glob("*.cti")) if folder.is_dir() else [folder]:
            if file.is_file():
                files[file.resolve()] = None
    if not files:
        where = (
            f"in {', '.join(map(str, folders))}"
            if folders
            else f"as {PRODUCER_PATH_VARIABLE} is not set"
        )
        raise CameraUrlError(
            f"{url}: found no GenTL producer (*.cti) {where}; install the camera maker's software, "
            f"then set {PRODUCER_PATH_VARIABLE} to the folder of its .cti file or add "
            "?producer=FILE.cti [SR-ENV-004]"
        )
    return tuple(files)


@dataclass(slots=True)
class _OpenedProducer:
    harvester: Any
    users: int = 0


_opened_producers: dict[Path, _OpenedProducer] = {}


class Connection:
    """Exclusive connection of this process to a camera.

    Parameters
    ----------
    acquirer
        Image acquirer of the library.
    file
        File of the producer.
    model, identifier
        As reported by the producer; may be empty.

    Attributes
    ----------
    acquirer, model, identifier
        As given.
    """

    def __init__(
        self, library: GenicamLibrary, acquirer: Any, file: Path, *, model: str, identifier: str
    ) -> None:
        self.acquirer = acquirer
        self.model = model
        self.identifier = identifier
        self._library = library
        self._file: Path | None = file

    def close(self) -> None:
        """Release the camera, also a disconnected one; calling it twice is allowed."""
        file, self._file = self._file, None
        if file is None:
            return
        try:
            with contextlib.suppress(*self._library.errors):
                self.acquirer.destroy()
        finally:
            _opened_producers[file].users -= 1
            _close_unused(self._library, file)


def connect_camera(
    library: GenicamLibrary, url: str, serial: str, files: Sequence[Path]
) -> Connection:
    """Open the camera with a serial number.

    Parameters
    ----------
    library
        From :func:`load_library`.
    url
        Address of the camera, for messages.
    serial
        Its serial number, or its identifier at the producer, as listed in the message for a camera
        that is not found.
    files
        Producers; the first one that finds the camera is used.

    Raises
    ------
    CameraUrlError
        When no such camera is found; the message lists those that are.
    CameraBusy
        When another program uses it.
    LinkLost
        When it does not answer.
    """
    found: list[str] = []
    for file in files:
        try:
            opened = _open(library, url, file)
        except CameraUrlError as error:
            if len(files) == 1:
                raise
            found.append(str(error).removeprefix(f"{url}: "))
            continue
        try:
            for device in opened.harvester.device_info_list:
                own, identifier = (
                    _read_device_attribute(library, device, "serial_number"),
                    str(device.id_),
                )
                model = _read_device_attribute(library, device, "model")
                if serial not in (own, identifier):
                    found.append(f"{model} {own or identifier}".strip())
                    continue
                with library.translate_errors(f"{url}: cannot be opened"):
                    acquirer = _create(library, opened.harvester, device)
                opened.users += 1
                return Connection(library, acquirer, file, model=model, identifier=identifier)
        finally:
            _close_unused(library, file)
    more = ", then close the other cameras, since they hide new ones" if _opened_producers else ""
    raise CameraUrlError(
        f"{url}: no such camera; found {', '.join(found) or 'none'} through "
        f"{', '.join(file.name for file in files)}; plug it in and switch it on{more} [SR-CAP-021]"
    )


def _open(library: GenicamLibrary, url: str, file: Path) -> _OpenedProducer:
    if file not in _opened_producers:
        harvester = library.core.Harvester(logger=_library_log)
        try:
            harvester.add_file(str(file), check_existence=True, check_validity=True)
            with library.translate_errors(f"{url}: {file.name}"):
                harvester.update()
        except OSError as error:
            raise CameraUrlError(
                f"{url}: the GenTL producer {file} cannot be loaded ({error}); it must be made for "
                "this system and processor"
            ) from error
        _opened_producers[file] = _OpenedProducer(harvester)
    return _opened_producers[file]


def _close_unused(library: GenicamLibrary, file: Path) -> None:
    if _opened_producers[file].users == 0:
        with contextlib.suppress(*library.errors):
            _opened_producers.pop(file).harvester.reset()


def _create(library: GenicamLibrary, harvester: Any, device: Any) -> Any:
    """Open a device and restore the handler of Ctrl-C, which the library replaces."""
    core = library.core
    # chunks are not used, and an unreadable one would lose its frame
    config = core.ParameterSet({core.ParameterKey.ENABLE_AUTO_CHUNK_DATA_UPDATE: False})
    if threading.current_thread() is not threading.main_thread():
        return harvester.create(device, config=config)
    handler = signal.getsignal(signal.SIGINT)
    try:
        return harvester.create(device, config=config)
    finally:
        if handler is not None:  # None: not set from Python
            signal.signal(signal.SIGINT, handler)


def _read_device_attribute(library: GenicamLibrary, device: Any, name: str) -> str:
    try:
        return str(getattr(device, name) or "")
    except library.errors:  # optional in GenTL
        return ""


# access modes of GenApi
_ABSENT_ACCESS_MODES = (0, 1)
_READABLE_ACCESS_MODES = (3, 4)
_WRITABLE_ACCESS_MODES = (2, 4)


class Features:
    """Feature access of one camera.

    Parameters
    ----------
    nodes
        Node map of the remote device.
    library
        From :func:`~capture.devices.cameras.genicam_producer.load_library`.
    where
        Name of the camera, for messages.
    """

    def __init__(self, nodes: Any, library: GenicamLibrary, where: str) -> None:
        self._nodes = nodes
        self._library = library
        self._where = where

    def has(self, *names: str) -> bool:
        """Return whether all of these features are available now."""
        return all(self._access(name) not in _ABSENT_ACCESS_MODES for name in names)

    def is_writable(self, name: str) -> bool:
        """Return whether the feature can be written now."""
        return self._access(name) in _WRITABLE_ACCESS_MODES

    def read(self, name: str, *alternatives: str) -> Any:
        """Return the value of the first of these features that the camera has.

        Raises
        ------
        CameraError
            When it has none of them.
        """
        for candidate in (name, *alternatives):
            if self._access(candidate) in _READABLE_ACCESS_MODES:
                with self._library.translate_errors(f"{self._where}: {candidate}"):
                    return getattr(self._nodes, candidate).value
        raise CameraError(
            f"{self._where}: has no feature {' or '.join((name, *alternatives))} that can be "
            "read now"
        )

    def unit(self, name: str) -> str:
        """Return the unit of a feature; empty when it states none."""
        with self._library.translate_errors(f"{self._where}: {name}"):
            return str(getattr(self._nodes, name).unit or "")

    def choices(self, name: str) -> list[str]:
        """Return the values that an enumeration can take now; empty when the feature is missing."""
        if not self.has(name):
            return []
        with self._library.translate_errors(f"{self._where}: {name}"):
            entries = getattr(self._nodes, name).entries
            return [e.symbolic for e in entries if e.get_access_mode() not in _ABSENT_ACCESS_MODES]

    def enum_number(self, name: str) -> int:
        """Return the integer value of an enumeration's present entry."""
        with self._library.translate_errors(f"{self._where}: {name}"):
            return int(getattr(self._nodes, name).get_int_value())

    def set(self, name: str, value: Any) -> None:
        """Set a feature to a value and read it back.

        A feature that has the value already is not written, so that it may be read-only.

        Raises
        ------
        CameraError
            When it is missing, cannot be set, or has another value afterwards.
        """
        got = self.read(name)
        if got == value:
            return
        if not self.is_writable(name):
            raise CameraError(
                f"{self._where}: {name}: got {got!r}, expected {value!r}, and it cannot be set"
            )
        choices = self.choices(name) if isinstance(value, str) else []
        if choices and value not in choices:
            raise CameraError(
                f"{self._where}: {name}: got {value!r}, expected one of {', '.join(choices)}"
            )
        with self._library.translate_errors(f"{self._where}: {name} to {value!r}"):
            getattr(self._nodes, name).value = value
        got = self.read(name)
        if got != value:
            raise CameraError(
                f"{self._where}: {name}: set to {value!r}, read back {got!r}; its value is tied to "
                "another setting"
            )

    def set_if_present(self, name: str, value: Any) -> None:
        """Set an optional feature, as :meth:`set`; do nothing when it is missing."""
        if self.has(name):
            self.set(name, value)

    def set_nearest(self, name: str, value: float) -> float:
        """Set a number to the nearest allowed value and return the value read back."""
        with self._library.translate_errors(f"{self._where}: {name} to {value:g}"):
            node = getattr(self._nodes, name)
            low, high = float(node.min), float(node.max)
            value = min(max(value, low), high)
            integer = isinstance(node.value, int)
            if integer or node.has_inc():
                step = float(node.inc)
                value = low + min(round((value - low) / step), (high - low) // step) * step
            if self.is_writable(name):
                node.value = int(value) if integer else value
            return float(node.value)

    def execute(self, name: str) -> None:
        """Execute a command feature."""
        if not self.has(name):
            raise CameraError(f"{self._where}: has no command {name}")
        with self._library.translate_errors(f"{self._where}: {name}"):
            getattr(self._nodes, name).execute()

    def _access(self, name: str) -> int:
        try:
            node = getattr(self._nodes, name)
        except AttributeError:
            return 0
        with self._library.translate_errors(f"{self._where}: {name}"):
            return int(node.get_access_mode())
