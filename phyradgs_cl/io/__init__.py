"""Files: scans, volumes, scanner descriptions, and outputs that are written whole or not at all."""

from phyradgs_cl.acquisition.field_of_view import default_grid
from phyradgs_cl.io.checkpoint import (
    checkpoint_path,
    former_checkpoint_path,
    partial_path,
    read_checkpoint,
    write_checkpoint,
)
from phyradgs_cl.io.hashing import hashing, sha256_of
from phyradgs_cl.io.lock import only_run
from phyradgs_cl.io.output import check_writable, written_beside
from phyradgs_cl.io.scan.reader import ToAttenuation, read_scan, scan_summary
from phyradgs_cl.io.scan.writer import write_scan
from phyradgs_cl.io.scanner import Scanner, load_scanner, with_detector_count
from phyradgs_cl.io.volume import (
    LoadedVolume,
    StoredVolume,
    file_kind,
    load_attenuation,
    load_volume,
    read_volume,
    volume_summary,
    write_volume,
)

__all__ = [
    "LoadedVolume",
    "Scanner",
    "StoredVolume",
    "ToAttenuation",
    "check_writable",
    "checkpoint_path",
    "default_grid",
    "file_kind",
    "former_checkpoint_path",
    "hashing",
    "load_scanner",
    "load_attenuation",
    "load_volume",
    "only_run",
    "partial_path",
    "read_checkpoint",
    "read_scan",
    "read_volume",
    "scan_summary",
    "sha256_of",
    "volume_summary",
    "with_detector_count",
    "write_checkpoint",
    "write_scan",
    "write_volume",
    "written_beside",
]
