"""What exposures of every scene share: the light that they are given, and what is wrong with it."""

from __future__ import annotations

from typing import Protocol


class SceneError(ValueError):
    """A scene is asked for something that it does not hold."""


class LitLight(Protocol):
    """A stretch of steady light, as the world reports it, clipped to the exposure."""

    @property
    def level(self) -> float:
        """Fraction of full power, 0 to 1."""

    @property
    def t_on_s(self) -> float:
        """World time at which it went on, s."""

    @property
    def t_off_s(self) -> float:
        """World time at which it went off, s."""


def full_power_s(light: LitLight, name: str) -> float:
    """Return for how long full power would give the light of a stretch, s.

    Parameters
    ----------
    light
        The stretch.
    name
        What shone, for the error.

    Returns
    -------
    float
        Level times duration, s.

    Raises
    ------
    SceneError
        The level is not from 0 to 1, or the light ends before it begins.

    Examples
    --------
    >>> from rigsim.boxes.dome import LedPulse
    >>> full_power_s(LedPulse(led=3, level=0.5, t_on_s=1.0, t_off_s=1.5), "LED 3")
    0.25
    """
    if not 0.0 <= light.level <= 1.0:
        raise SceneError(f"level of {name}: got {light.level}, expected 0 to 1")
    if not light.t_off_s >= light.t_on_s:
        raise SceneError(
            f"light of {name}: got {light.t_on_s} to {light.t_off_s} s, "
            "expected an end after its beginning"
        )
    return light.level * (light.t_off_s - light.t_on_s)
