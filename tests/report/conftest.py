"""A small fly-scan with its truth, and a reconstruction of it, as files."""

import base64
import importlib.util
from collections.abc import Callable
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from skimage.io import imread

from phyradgs_cl.acquisition import ConeGeometry, Scan, make_protocol
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_scan
from phyradgs_cl.reconstructors import plan_run
from phyradgs_cl.simulation import SimulationOptions, phantom_scene, simulate
from phyradgs_cl.workflow import run_reconstruction

collect_ignore = [] if importlib.util.find_spec("napari_ome_zarr") else ["test_napari.py"]
VOID = {"br", "img", "input", "link", "meta"}


class Page(HTMLParser):
    """A page as elements (tag, attributes), texts by tag, and what was opened and never closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.texts: dict[str, list[str]] = {}
        self.open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {key: value or "" for key, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data: str) -> None:
        if self.open:
            self.texts.setdefault(self.open[-1], []).append(data)

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]

    @property
    def ids(self) -> list[str]:
        return [attributes["id"] for _, attributes in self.elements if "id" in attributes]

    @staticmethod
    def pixels(source: str) -> np.ndarray:
        kind, _, content = source.partition(",")
        assert kind == "data:image/png;base64"
        return imread(BytesIO(base64.b64decode(content, validate=True)))

    @property
    def words(self) -> str:
        shown = (" ".join(texts) for tag, texts in self.texts.items() if tag not in ("style", "script"))
        return " ".join(" ".join(shown).split())


@pytest.fixture(scope="session")
def scan_maker(rt) -> Callable[..., Scan]:
    """A factory of 12³ voxels and 8 frames of 16 × 14 pixels; its changes are those of the simulation."""

    def make(**changes: object) -> Scan:
        geometry, axis = ConeGeometry(5.0, 7.0, (16, 14), (0.25, 0.25)), str(changes.get("readout_axis", "rows"))
        scene = phantom_scene(rt, "jaw", geometry, Grid.cube(12, 2.0), 12, axis, 0)
        protocol = changes.pop("protocol", make_protocol("rapid", views=8, exposure_deg=20.0))
        options = SimulationOptions(protocol=protocol, **changes)
        words = {"reference": scene.reference, "title": "a <b>small</b> scan"}
        return simulate(scene.source, geometry, scene.grid, options, **words)

    return make


@pytest.fixture(scope="session")
def small_scan(scan_maker) -> Scan:
    return scan_maker()


@pytest.fixture(scope="session")
def files(rt, small_scan, tmp_path_factory) -> tuple[Path, Path]:
    """Scan and volume files in one folder."""
    folder = tmp_path_factory.mktemp("run")
    scan, volume = folder / "scan.h5", folder / "volume.h5"
    write_scan(scan, small_scan)
    changes = {"motion": "micro-views", "strips": 3, "iterations": 3}
    run_reconstruction(plan_run("sart", changes), scan, volume, lambda: rt)
    return scan, volume


@pytest.fixture(scope="session")
def any_volume() -> tuple[np.ndarray, Grid]:
    """A volume whose three sides and voxel sizes differ, brighter upwards, away and to the right."""
    grid = Grid((5, 6, 8), (0.3, 0.2, 0.1), (0.0, 0.1, 0.0))
    z, y, x = np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij")
    return (100 * z + 10 * y + x).astype(np.float32), grid


@pytest.fixture(scope="session")
def parse() -> type[Page]:
    return Page
