"""The simulated world: clock, controllers, cameras and faults."""

from rigsim.world.world import Scene, World, WorldClock, find_world, get_world

__all__ = ["Scene", "World", "WorldClock", "find_world", "get_world"]
