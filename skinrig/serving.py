"""Serve a simulated rig with a face before it, until interrupted."""

from __future__ import annotations

import sys

from capture.rig import load_rig
from skinrig.simulation import WIDTHS_PX, SimulationError


def serve_rig(
    rig_name: str,
    *,
    pty: bool,
    tcp: str,
    allow_remote: bool,
    subject: str,
    size: str,
    seed: int,
    seconds: float | None = None,
) -> None:
    """Print the addresses of boxes and cameras, one ``NAME URL`` a line, and serve.

    Parameters
    ----------
    rig_name
        "flash", or a rig's TOML file.
    pty
        Boxes on pseudo terminals; cameras are on TCP in either case.
    tcp
        HOST:PORT; port 0 chooses a free one.
    allow_remote
        Permit an address that other machines reach.
    subject, size, seed
        As for a simulation.
    seconds
        How long; None serves until Ctrl-C.
    """
    from rigsim.scenes.flash import FlashScene
    from rigsim.serve import serve
    from rigsim.subject import make_subject

    if size not in WIDTHS_PX:
        raise SimulationError(f"size: got {size!r}, expected one of {', '.join(WIDTHS_PX)}")
    rig = load_rig(rig_name)
    width = WIDTHS_PX[size]
    rig = rig.resized(width) if width != rig.views[0].width_px else rig
    scene = FlashScene(rig, make_subject(subject, seed=seed), seed=seed)
    # rendered before anybody asks, so that no client waits for it
    scene.radiance("crossed")
    with serve(rig, pty=pty, tcp=tcp, allow_remote=allow_remote, seed=seed, scene=scene) as served:
        for name, url in served.addresses.items():
            print(f"{name} {url}", flush=True)
        boxes = " ".join(f"--port {n}={served.addresses[n]}" for n in rig.boxes)
        cameras = " ".join(f"--camera {v.name}={served.addresses[v.name]}" for v in rig.views)
        print(
            f"next: skinrig capture {rig_name} {boxes} {cameras} --out session\nCtrl-C ends it",
            file=sys.stderr,
        )
        try:
            served.wait(seconds)
        except KeyboardInterrupt:
            print("no longer served; the lights are dark", file=sys.stderr)
            raise
