"""A reconstruction as a page, a picture or a window for people."""

from phyradgs_cl.report.page import report_page, write_report
from phyradgs_cl.report.pictures.preview import Preview, check_preview, write_preview
from phyradgs_cl.report.pictures.volume_viewer import view_volume
from phyradgs_cl.report.run import Run, load_run

__all__ = [
    "Preview", "Run", "check_preview", "load_run", "report_page", "view_volume", "write_preview",
    "write_report"
]  # fmt: skip
