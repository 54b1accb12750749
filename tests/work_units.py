"""Files that one process of several runs as a unit, and short messages between the processes.

Files of one folder read the same kernels, tables and syntax trees, and share fixtures of a session:
one process that runs them in turn makes these once. With a process per file, each made its own.
"""

from pathlib import PurePosixPath

from _pytest.runner import runtestprotocol

NOTABLE_S = 0.02
"""A shorter setup or teardown without a message is not worth sending."""


ARCHITECTURE = "tests/architecture"
OF_ARCHITECTURE = frozenset(
    {
        "tests/properties/test_every_function_has_one.py",
        "tests/system/test_compiled_kernels.py",
        "tests/system/test_docs.py",
    }
)
"""Files elsewhere that read the syntax trees of the whole product."""


def name_unit(file):
    """Return the unit of a file: a folder of unit tests, or of the architecture, or the file."""
    parts = PurePosixPath(file).parts
    if file.startswith(f"{ARCHITECTURE}/") or file in OF_ARCHITECTURE:
        return ARCHITECTURE
    if parts[:2] == ("tests", "unit") and len(parts) > 4:
        return "/".join(parts[:4])
    return file


REAL_TIME = frozenset({"faults", "firmware", "hardware", "protocol"})
"""Folders of tests that wait for lines and emulated boards more than they compute."""


def waits(unit):
    """Return whether the tests of a unit mostly wait."""
    return not REAL_TIME.isdisjoint(PurePosixPath(unit).parts[1:2])


def choose_unit(waiting, busy_waiting):
    """Return the position in the queue of the unit that a process gets.

    One process at a time runs units that wait, as long as there are others: cores then have work
    throughout, and the kernels and tables of a computing unit are loaded by fewer processes.

    Parameters
    ----------
    waiting
        Whether each unit of the queue waits.
    busy_waiting
        Whether another process has a unit that waits.
    """
    wanted = not busy_waiting
    return waiting.index(wanted) if wanted in waiting else 0


def pytest_xdist_make_scheduler(config, log):
    """Return a scheduler of units where files are asked for."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class LoadUnits(LoadFileScheduling):
        """Units in the order of the tests; numbers of tests are looked up, not searched for."""

        def _split_scope(self, nodeid):
            return name_unit(super()._split_scope(nodeid))

        def _assign_work_unit(self, node):
            elsewhere = any(
                waits(unit) and not all(tests.values())
                for other, units in self.assigned_work.items()
                if other is not node
                for unit, tests in units.items()
            )
            names = list(self.workqueue)
            name = names[choose_unit([waits(one) for one in names], elsewhere)]
            unit = self.workqueue.pop(name)
            assigned = self.assigned_work.setdefault(node, {})
            for done in [one for one, tests in assigned.items() if all(tests.values())]:
                del assigned[done]  # else each result counts all tests that went before
            assigned[name] = unit
            if not hasattr(self, "_numbers"):
                self._numbers = {nodeid: k for k, nodeid in enumerate(self.collection)}
            node.send_runtest_some([self._numbers[one] for one, done in unit.items() if not done])

    return LoadUnits(config, log)


def pytest_runtest_protocol(item, nextitem):
    """Run a test in a process of several; send reports with a result, a message or a duration."""
    if not hasattr(item.config, "workerinput"):
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for report in runtestprotocol(item, nextitem=nextitem, log=False):
        if is_worth_sending(report):
            item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def is_worth_sending(report):
    """Return whether a report has a result, a message, or a duration that counts."""
    uneventful = report.passed and not report.sections and not report.user_properties
    return report.when == "call" or not uneventful or report.duration >= NOTABLE_S
