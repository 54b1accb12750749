"""Benchmark of the dome's renderer: all lights of a view from one set of rays, and Mitsuba's."""

from __future__ import annotations

from skinrig.benchmark import Limit, Point, StageBenchmark, Timing

PATH_SPEED_UP = 10.0
DIRECT_SPEED_UP = 5.0


def render(*, toy: bool) -> StageBenchmark:
    """Time one view of the dome, light after light, in three ways.

    The full size is that of the rig's cameras. Mitsuba's samples are stratified, which makes them
    as even as our regular rays: with its default, independent ones it is twice as noisy.
    """
    from rigsim.scenes.dome_reference import Way, compare

    width, lights = (64, 2) if toy else (1300, 4)
    points = []

    def add(name: str, rays: int, way: Way) -> None:
        timing = Timing(way.seconds, (way.seconds, way.seconds), way.seconds, 0.0)
        error = 100.0 * way.error
        points.append(Point({"way": name, "rays": rays}, timing, error, (error, error)))

    efforts = (1, 2) if toy else (1, 3, 2)
    fine = 4 if toy else 6
    for subpixels in efforts:
        found = compare(
            width_px=width,
            lights=1 if subpixels != efforts[-1] else lights,
            subpixels=subpixels,
            fine=fine,
            rounds=2 if subpixels == efforts[-1] else 1,
        )
        for name in ("ours", "path", "direct"):
            add(name, subpixels**2, getattr(found, name))
    finest = next(p for p in points if p.knobs == {"way": "ours", "rays": max(efforts) ** 2})
    limits = (
        Limit("times faster than Mitsuba's path tracer, no noisier", found.speed_up(found.path),
              PATH_SPEED_UP, ">="),
        Limit("times faster than Mitsuba's direct integrator, no noisier",
              found.speed_up(found.direct), DIRECT_SPEED_UP, ">="),
    )  # fmt: skip
    return StageBenchmark(
        "render-dome",
        "RMS error over the mean, seconds a light, %",
        f"ours with {fine**2} rays a pixel; Mitsuba's mean agrees with it but for noise. Its own "
        "error falls at least with the root of the rays from that of the most here",
        finest.error * max(efforts) / fine,
        tuple(points),
        limits,
        left_out=(("subjects with relief and vellus hair", "Mitsuba has no such lobe"),),
        interval_of="tiles of the pictures",
    )
