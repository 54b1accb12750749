"""Import foreign data into SESSION/: photographs without personal metadata, scanned meshes."""

from capture.importers.image_checks import PhotoError
from capture.importers.image_stacks import ImageStackImport, import_light_list
from capture.importers.images import Photo, read_photo
from capture.importers.light_tables import LightListError
from capture.importers.photos import PhotoImport, import_photos

__all__ = [
    "ImageStackImport",
    "LightListError",
    "Photo",
    "PhotoError",
    "PhotoImport",
    "import_light_list",
    "import_photos",
    "read_photo",
]
