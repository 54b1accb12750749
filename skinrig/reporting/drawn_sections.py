"""Keep the sections of a report for the next report on the same maps."""

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field

from skinrig.reporting import page


@dataclass(frozen=True, slots=True)
class DrawnSections:
    """Sections and their checks, by the contents that they were drawn from.

    Examples
    --------
    >>> drawn, checks = DrawnSections(), []
    >>> def draw(checks):
    ...     checks.append(page.Check("error", 1.0, 2.0, "<="))
    ...     yield page.Heading("Maps")
    >>> first = drawn.draw("digest", draw, checks)
    >>> drawn.draw("digest", draw, checks) == first, len(checks), checks[0] is checks[1]
    (True, 2, True)
    """

    _kept: dict[Hashable, tuple[list[page.Block], list[page.Check]]] = field(default_factory=dict)

    def draw(
        self,
        contents: Hashable,
        draw: Callable[[list[page.Check]], Iterable[page.Block]],
        checks: list[page.Check],
    ) -> list[page.Block]:
        """Return the blocks of a section, and add its checks; an earlier section is not redrawn.

        Parameters
        ----------
        contents
            All that the section depends on, such as digests of its files.
        draw
            Draws the section, and adds its checks to the list given to it.
        checks
            Checks of the report.
        """
        if contents not in self._kept:
            own: list[page.Check] = []
            self._kept[contents] = list(draw(own)), own
        blocks, own = self._kept[contents]
        checks += own
        return blocks
