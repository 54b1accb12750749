"""skinrig from Python: simulate, capture files, calibrate, reconstruct, fit, report, export.

Each function corresponds to a command of the same name; notebooks display what it returns.
"""

from skinrig.python_api.functions import (
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
