from .load import FORMATS as FORMATS
from .load import foreign_volume as foreign_volume
from .load import import_scan as import_scan
from .load import load_attenuation as load_attenuation
from .load import load_beads as load_beads
from .load import load_volume as load_volume
from .load import recognise as recognise
from .options import ImportOptions as ImportOptions
