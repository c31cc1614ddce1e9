from .live import LivePage as LivePage
from .page import report_page as report_page
from .page import write_report as write_report
from .preview import Preview as Preview
from .preview import view_volume as view_volume
from .preview import write_preview as write_preview
from .run import Run as Run
from .run import load_run as load_run
