"""The hemoglobin rig: local statistics, basis, blends and documents."""

from model.facial_color.rig import HemoglobinBlend as HemoglobinBlend
from model.facial_color.rig import HemoglobinRig as HemoglobinRig
from model.facial_color.rig import local_statistics as local_statistics
from model.facial_color.state_maps import FacialColorError as FacialColorError
from model.facial_color.state_maps import StateMaps as StateMaps
from model.facial_color.state_maps import check_name as check_name
