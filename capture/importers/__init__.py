"""Foreign data into SESSION/: photographs stripped of what identifies people, scanned meshes."""

from capture.importers.image_stacks import ImportedStack, import_light_list
from capture.importers.images import Photo, PhotoError, read_photo
from capture.importers.light_lists import LightListError
from capture.importers.photos import Imported, import_photos

__all__ = [
    "Imported",
    "ImportedStack",
    "LightListError",
    "Photo",
    "PhotoError",
    "import_light_list",
    "import_photos",
    "read_photo",
]
