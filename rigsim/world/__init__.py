"""The simulated world: clock, controllers, cameras and faults."""

from rigsim.world.world import Scene, World, WorldClock, get, get_by_name_or_box

__all__ = ["Scene", "World", "WorldClock", "get", "get_by_name_or_box"]
