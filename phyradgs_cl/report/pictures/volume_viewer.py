"""A volume in napari, where that is installed: a window in which one turns and cuts it."""

from pathlib import Path
from typing import Any

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import StoredVolume, file_kind, read_volume
from phyradgs_cl.report.pictures.preview import grey_range

_AXES = ("z", "y", "x")


def view_volume(path: Path) -> None:
    """Opens a window with a volume file and returns when it is closed. InputError: no napari, or no volume file of ours."""
    napari = checks.package("napari", "the package for this, 0.5.4 or later", "napari[all]")
    if (kind := file_kind(path)) != "volume":
        raise InputError(str(path), f"a {kind}", "a volume of phyradgs-cl")
    add_volume(napari.Viewer(title=f"{path.name} – phyradgs"), read_volume(path), path.stem)
    napari.run()


def add_volume(viewer: Any, stored: StoredVolume, name: str) -> None:
    """Puts a volume into a viewer at its place in the world: lengths in mm, axes z, y, x, y up, grey from 0."""
    viewer.add_image(
        stored.volume,
        name=f"{name} (1/mm)",
        scale=stored.grid.voxel_size_mm,
        translate=stored.grid.first_centre_mm,
        units=("mm", "mm", "mm"),
        axis_labels=_AXES,
        contrast_limits=grey_range(stored.volume),
        colormap="gray",
    )
    viewer.dims.axis_labels = _AXES
    if hasattr(viewer.camera, "orientation2d"):  # since napari 0.6; before, y points down
        viewer.camera.orientation2d = ("up", "right")
    # napari 0.9 has moved its overlays
    overlays = viewer.canvas.overlays if hasattr(viewer, "canvas") else viewer
    overlays.scale_bar.visible = True
