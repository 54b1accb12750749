"""What a capture needs of the fibre probe's driver."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from capture.devices.probe import Opening, ProbeStatus, SuctionReport, SuctionState

PROBE_LEASE_S = 5.0
"""A frame may keep the host busy for a while; after this silence the box lets go."""
LEASE_RENEWAL_S = 1.0
"""Silence between two renewals of the lease while nothing but time is waited for."""


class ProbeDriver(Protocol):
    """The part of the probe's driver that a capture needs."""

    @property
    def limits(self) -> Mapping[str, Any]:
        """What the box allows, in its own words and units."""

    def arm(self) -> None:
        """Allow light and suction."""

    def dark(self) -> None:
        """Shut the shutter, put the LED out, vent, and disarm."""

    def set_lease(self, lease_s: float) -> None:
        """Set after how much silence the box does the same."""

    def new_subject(self, pseudonym: str) -> None:
        """Begin to count the dose of light anew."""

    def status(self) -> ProbeStatus:
        """Return the status bits."""

    def place(self, site: str, angle_deg: float) -> None:
        """Pass on where a person has put the head."""

    def suck(self, mbar: float, seconds: float) -> int:
        """Switch the pump on."""

    def suction(self) -> SuctionState:
        """Return what the pump does."""

    def last_suction(self) -> SuctionReport | None:
        """Return how the last suction ended."""

    def vent(self) -> None:
        """Switch the pump off; the head stays placed."""

    def pressure_mbar(self) -> float:
        """Return the suction under the head, mbar."""

    def camera_c(self) -> float:
        """Return the temperature of the camera, degrees Celsius."""

    def set_level(self, level: float) -> None:
        """Drive the LED behind the closed shutter."""

    def cover(self, fibre: int | None) -> None:
        """Cover all detection fibres but one; None: none."""

    def open_shutter(self, seconds: float) -> Opening:
        """Open the shutter, pulsing the camera's line."""

    def close_shutter(self) -> None:
        """Close the shutter, also one that is stuck."""

    def last_opening(self) -> Opening | None:
        """Return the last opening and how it ended."""

    def ping(self) -> float:
        """Return the box's clock, s."""

    def trigger_camera(self, token: str) -> float:
        """Pulse the camera's line without light."""

    def listen(self, seconds: float, *, every_s: float = ...) -> None:
        """Let time pass while the lease is renewed."""
