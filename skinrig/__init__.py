"""skinrig from Python: simulate, capture files, calibrate, reconstruct, fit, report, export.

Each function corresponds to a command of the same name; notebooks display what it returns.
"""

import os

from skinrig.kernel_cache import set_passive_waiting

set_passive_waiting(os.environ)  # before a library of numerics reads it

from skinrig.python_api.functions import (  # noqa: E402
    calibrate,
    diagnose,
    export,
    fit,
    load_session,
    plan,
    reconstruct,
    report,
    simulate,
    view,
)

__all__ = [
    "calibrate",
    "diagnose",
    "export",
    "fit",
    "load_session",
    "plan",
    "reconstruct",
    "report",
    "simulate",
    "view",
]
