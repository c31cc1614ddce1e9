from .objects import foreign_volume as foreign_volume
from .objects import load_attenuation as load_attenuation
from .objects import load_beads as load_beads
from .objects import load_volume as load_volume
from .options import ImportOptions as ImportOptions
from .scan import FORMATS as FORMATS
from .scan import import_scan as import_scan
from .scan import recognise as recognise
