"""The simulated world: clock, controllers, cameras and faults."""

from rigsim.boxes.dome import LedPulse
from rigsim.boxes.flash import FlashPop
from rigsim.boxes.gradient_sphere import PatternLight
from rigsim.boxes.probe import SourceLight
from rigsim.world.light_record import Light
from rigsim.world.scene_protocols import CaliperScene, ProbeScene, Scene
from rigsim.world.suction import HeadState
from rigsim.world.taped_skin import GripState
from rigsim.world.world import World, WorldClock, get, get_by_name_or_box

__all__ = [
    "CaliperScene",
    "FlashPop",
    "GripState",
    "HeadState",
    "LedPulse",
    "Light",
    "PatternLight",
    "ProbeScene",
    "Scene",
    "SourceLight",
    "World",
    "WorldClock",
    "get",
    "get_by_name_or_box",
]
