from .files import load_reference as load_reference
from .files import load_scan as load_scan
from .files import summary as summary
from .reconstruct import run_reconstruction as run_reconstruction
from .scans import run_preparation as run_preparation
from .scans import run_simulation as run_simulation
from .volumes import run_evaluation as run_evaluation
