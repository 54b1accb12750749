"""Strike lines between host and controllers as a man in the middle: damage, replay, reset.

`LineFaults` outlives connections, so that lines of an earlier host come again in a later one. A
`rigsim.world.link.Link` asks it what becomes of each line.
"""

from collections import Counter
from typing import Final, Protocol

import numpy as np

LINE_FAULT_KINDS: Final = (
    *("flip", "drop_byte", "drop_line", "double", "reorder", "delay", "replay", "replay_run"),
    *("replay_hello", "truncate", "glue", "insert_noise", "insert_bare", "reset"),
)
BARE_LINES: Final = (
    *(b"SAFE\n", b"*RST\n", b"SYST:ERR?\n", b"FLAS:POW 1\n", b"SYST:ARM\n", b"STAT?\n"),
)
MAX_DELAY_S = 1.5
REPLAYED_LINES = 12
MAX_NOISE_BYTES = 60


class LineReset(Exception):
    """The connection is reset: its line is lost, and the port must be opened again."""


class LineTap(Protocol):
    """Interface of what is between the two ends of a line."""

    def pass_on(self, way: str, line: bytes) -> list[tuple[float, bytes]]:
        """Return what becomes of a line: pairs of a delay in s and bytes.

        Raises
        ------
        LineReset
            When the connection is reset.
        """


class LineFaults:
    """Faults on both directions of a line, drawn at random.

    Parameters
    ----------
    rng
        Draws which lines are struck, and how.
    share
        Share of the lines that are struck, 0 to 1.

    Attributes
    ----------
    strikes : Counter of str
        Number of faults by kind.
    lines : dict of str to list of bytes
        All lines so far; ``>`` to the controller, ``<`` to the host.
    """

    def __init__(self, rng: np.random.Generator, share: float) -> None:
        self.rng, self.share = rng, share
        self.strikes: Counter[str] = Counter()
        self.lines: dict[str, list[bytes]] = {">": [], "<": []}
        self._held = {">": b"", "<": b""}

    def pass_on(self, way: str, line: bytes) -> list[tuple[float, bytes]]:
        """Return what becomes of a line; see `LineTap`."""
        history, held = self.lines[way], self._held[way]
        struck = bool(history) and self.rng.random() < self.share
        self._held[way] = b""
        history.append(line)
        if not struck:
            return [(0.0, line + held)]
        kind = str(self.rng.choice(LINE_FAULT_KINDS))
        self.strikes[kind] += 1
        if kind == "reset":
            raise LineReset
        if kind == "reorder":
            self._held[way] = line
            return [(0.0, held)]
        if kind == "delay":
            return [(float(self.rng.uniform(0.05, MAX_DELAY_S)), line), (0.0, held)]
        return [(0.0, self._damage(kind, history, line) + held)]

    def _damage(self, kind: str, history: list[bytes], line: bytes) -> bytes:
        place = int(self.rng.integers(len(line)))
        earlier = int(self.rng.integers(len(history)))
        match kind:
            case "flip":
                bit = 1 << int(self.rng.integers(8))
                return line[:place] + bytes([line[place] ^ bit]) + line[place + 1 :]
            case "drop_byte":
                return line[:place] + line[place + 1 :]
            case "drop_line":
                return b""
            case "double":
                return 2 * line
            case "replay":
                parts = [history[earlier], line]
                return b"".join(parts if self.rng.random() < 0.5 else parts[::-1])
            case "replay_run":
                return b"".join([*history[earlier : earlier + REPLAYED_LINES], line])
            case "replay_hello":
                hellos = [k for k, old in enumerate(history) if b"HELLO?" in old] or [0]
                first = int(self.rng.choice(hellos))
                return b"".join([*history[first : first + REPLAYED_LINES], line])
            case "truncate":
                return line[:place]
            case "glue":
                return line.rstrip(b"\n")
            case "insert_noise":
                return self.rng.bytes(int(self.rng.integers(1, MAX_NOISE_BYTES))) + b"\n" + line
            case _:  # insert_bare
                return BARE_LINES[int(self.rng.integers(len(BARE_LINES)))] + line
