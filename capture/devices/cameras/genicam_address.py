"""Addresses of industrial cameras: ``genicam:SERIAL`` and what may follow it."""

import math
from dataclasses import dataclass
from urllib.parse import parse_qsl

from capture.devices.camera import CameraUrlError
from capture.devices.cameras import pixel_format

BASE_ISO = 100
"""Sensitivity that a gain of 0 dB is called where the address does not say."""


@dataclass(frozen=True, slots=True)
class Address:
    """What ``genicam:SERIAL?NAME=VALUE&...`` says.

    Attributes
    ----------
    serial
        Serial number of the camera.
    producer
        File or folder of the GenTL producer; empty: as GENICAM_GENTL64_PATH says.
    pixel_format
        As the camera names it; empty: the deepest raw one.
    line
        Input of the trigger; empty: that which the camera is set to, else its first.
    iso
        What a gain of 0 dB is called, above 0.
    black
        Level of no light, DN; None: as the camera's BlackLevel says.
    """

    serial: str
    producer: str = ""
    pixel_format: str = ""
    line: str = ""
    iso: int = BASE_ISO
    black: float | None = None

    @property
    def url(self) -> str:
        """The address without what follows the serial number."""
        return f"genicam:{self.serial}"


def parse_address(rest: str) -> Address:
    """Return what an address says.

    Raises
    ------
    CameraUrlError

    Examples
    --------
    >>> parse_address("40012345?format=BayerRG12&line=Line1&black=64").pixel_format
    'BayerRG12'
    """
    serial, _, query = rest.partition("?")
    expected = (
        f"genicam:{rest}: expected genicam:SERIAL, then at will ?producer=FILE.cti, "
        "format=NAME, line=NAME, iso=NUMBER, black=DN, joined by &"
    )
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
        words = dict(pairs)
        iso, black = int(words.pop("iso", BASE_ISO)), words.pop("black", None)
        address = Address(
            serial,
            producer=words.pop("producer", ""),
            pixel_format=words.pop("format", ""),
            line=words.pop("line", ""),
            iso=iso,
            black=None if black is None else float(black),
        )
    except ValueError as error:
        raise CameraUrlError(f"{expected}; got {query!r}") from error
    black_good = address.black is None or (math.isfinite(address.black) and address.black >= 0)
    twice = len({name for name, _ in pairs}) < len(pairs)
    if not serial or words or twice or "" in dict(pairs).values() or iso <= 0 or not black_good:
        raise CameraUrlError(f"{expected}; got {rest!r}")
    if address.pixel_format and pixel_format.parse(address.pixel_format) is None:
        raise CameraUrlError(
            f"{expected}; format: got {address.pixel_format!r}, expected a raw one such as "
            "BayerRG12, BayerRG12p or Mono16"
        )
    return address
