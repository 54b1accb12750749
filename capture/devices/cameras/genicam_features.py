"""Features of a GenICam camera by their standard names (SFNC 2.7): read, set, and read back."""

from typing import Any

from capture.devices.camera import CameraError
from capture.devices.cameras.genicam_producer import Library

# access modes of GenApi
_ABSENT_ACCESS_MODES = (0, 1)
_READABLE_ACCESS_MODES = (3, 4)
_WRITABLE_ACCESS_MODES = (2, 4)


class Features:
    """The features of one camera.

    Parameters
    ----------
    nodes
        Node map of the remote device.
    library
        From :func:`~capture.devices.cameras.genicam_producer.load_library`.
    where
        The camera, for messages.
    """

    def __init__(self, nodes: Any, library: Library, where: str) -> None:
        self._nodes = nodes
        self._library = library
        self._where = where

    def has(self, *names: str) -> bool:
        """Return whether the camera has all of these features now."""
        return all(self._access(name) not in _ABSENT_ACCESS_MODES for name in names)

    def writable(self, name: str) -> bool:
        """Return whether the feature can be set now."""
        return self._access(name) in _WRITABLE_ACCESS_MODES

    def read(self, name: str, *instead: str) -> Any:
        """Return the value of the first of these features that the camera has.

        Raises
        ------
        CameraError
            When it has none of them.
        """
        for candidate in (name, *instead):
            if self._access(candidate) in _READABLE_ACCESS_MODES:
                with self._library.translated(f"{self._where}: {candidate}"):
                    return getattr(self._nodes, candidate).value
        raise CameraError(
            f"{self._where}: has no feature {' or '.join((name, *instead))} that can be read now"
        )

    def unit(self, name: str) -> str:
        """Return the unit of a feature; empty where it tells none."""
        with self._library.translated(f"{self._where}: {name}"):
            return str(getattr(self._nodes, name).unit or "")

    def choices(self, name: str) -> list[str]:
        """Return the values that an enumeration can be set to now; none where it is missing."""
        if not self.has(name):
            return []
        with self._library.translated(f"{self._where}: {name}"):
            entries = getattr(self._nodes, name).entries
            return [e.symbolic for e in entries if e.get_access_mode() not in _ABSENT_ACCESS_MODES]

    def number_of(self, name: str) -> int:
        """Return the number behind an enumeration's present value."""
        with self._library.translated(f"{self._where}: {name}"):
            return int(getattr(self._nodes, name).get_int_value())

    def set(self, name: str, value: Any) -> None:
        """Make a feature have a value.

        One that has it already is not written, so that it may be fixed.

        Raises
        ------
        CameraError
            When it is missing, cannot be set, or has another value afterwards.
        """
        got = self.read(name)
        if got == value:
            return
        if not self.writable(name):
            raise CameraError(
                f"{self._where}: {name}: got {got!r}, expected {value!r}, and it cannot be set"
            )
        choices = self.choices(name) if isinstance(value, str) else []
        if choices and value not in choices:
            raise CameraError(
                f"{self._where}: {name}: got {value!r}, expected one of {', '.join(choices)}"
            )
        with self._library.translated(f"{self._where}: {name} to {value!r}"):
            getattr(self._nodes, name).value = value
        got = self.read(name)
        if got != value:
            raise CameraError(
                f"{self._where}: {name}: set to {value!r}, read back {got!r}; its value is tied to "
                "another setting"
            )

    def set_if_there(self, name: str, value: Any) -> None:
        """As :meth:`set`, for a feature that a camera need not have."""
        if self.has(name):
            self.set(name, value)

    def set_nearest(self, name: str, value: float) -> float:
        """Set a number within what the camera allows; return what it then is."""
        with self._library.translated(f"{self._where}: {name} to {value:g}"):
            node = getattr(self._nodes, name)
            low, high = float(node.min), float(node.max)
            value = min(max(value, low), high)
            integer = isinstance(node.value, int)
            if integer or node.has_inc():
                step = float(node.inc)
                value = low + min(round((value - low) / step), (high - low) // step) * step
            if self.writable(name):
                node.value = int(value) if integer else value
            return float(node.value)

    def execute(self, name: str) -> None:
        """Do a command."""
        if not self.has(name):
            raise CameraError(f"{self._where}: has no command {name}")
        with self._library.translated(f"{self._where}: {name}"):
            getattr(self._nodes, name).execute()

    def _access(self, name: str) -> int:
        try:
            node = getattr(self._nodes, name)
        except AttributeError:
            return 0
        with self._library.translated(f"{self._where}: {name}"):
            return int(node.get_access_mode())
