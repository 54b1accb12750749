"""Open cameras of a world by their URL."""

from capture.devices import camera
from capture.rig import RigError
from rigsim.world.world import find_world


def open_camera(rest: str) -> camera.Camera:
    """Open ``sim://WORLD/VIEW``; the world must be registered, or its controller be open.

    WORLD is the name of ``sim://BOX?world=NAME``, or BOX itself where no name was given.
    """
    name, slash, view_name = rest.partition("/")
    if not (name and slash and view_name):
        raise camera.CameraUrlError(f"sim://{rest}: got {rest!r}, expected WORLD/VIEW")
    try:
        return find_world(name).camera(view_name)
    except (KeyError, RigError) as exc:
        raise camera.CameraUrlError(
            f"sim://{rest}: {exc.args[0]}; open its controller first, by "
            "sim://BOX?world=NAME, and its cameras by sim://NAME/VIEW"
        ) from exc
