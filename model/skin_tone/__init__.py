"""Skin tone: CIE Lab, typology angle, Monk scale, erythema and melanin indices, measured skin."""

from model.skin_tone.indices import dawson_erythema_index as dawson_erythema_index
from model.skin_tone.indices import erythema_index as erythema_index
from model.skin_tone.indices import erythema_index_stderr as erythema_index_stderr
from model.skin_tone.indices import melanin_index as melanin_index
from model.skin_tone.indices import melanin_index_stderr as melanin_index_stderr
from model.skin_tone.lab import hue_chroma as hue_chroma
from model.skin_tone.lab import lab as lab
from model.skin_tone.lab import lab_covariance as lab_covariance
from model.skin_tone.lab import lab_of_spectra as lab_of_spectra
from model.skin_tone.measured import SkinPercentiles as SkinPercentiles
from model.skin_tone.measured import measured_skin as measured_skin
from model.skin_tone.measured import setting_half as setting_half
from model.skin_tone.measured import sphere_specular as sphere_specular
from model.skin_tone.scales import ITA_BANDS as ITA_BANDS
from model.skin_tone.scales import ITA_EDGES_DEG as ITA_EDGES_DEG
from model.skin_tone.scales import ita as ita
from model.skin_tone.scales import ita_band as ita_band
from model.skin_tone.scales import ita_stderr as ita_stderr
from model.skin_tone.scales import monk as monk
from model.skin_tone.scales import monk_colors as monk_colors
