"""Foreign data into SESSION/: photographs stripped of what identifies people, scanned meshes."""

from capture.importers.photos import Imported, import_photos
from capture.importers.pictures import Photo, PhotoError, read_photo

__all__ = ["Imported", "Photo", "PhotoError", "import_photos", "read_photo"]
