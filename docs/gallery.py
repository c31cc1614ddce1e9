"""Makes the gallery of the documentation: runs its commands, draws docs/images/gallery and writes docs/gallery.md.

    python docs/gallery.py [FOLDER] [NAME ...]

Without names all results are made. With names only those are made, and the page keeps the text of the others. FOLDER takes
scans and volumes (default: a temporary folder). Seconds are processor seconds (user and system) of all commands of a
result."""

import re
import resource
import shlex
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from browser_pictures import SECTION
from matplotlib.figure import Figure

from phyradgs_cl.io import read_volume
from phyradgs_cl.metrics import psnr
from phyradgs_cl.workflow import load_reference

DOCS = Path(__file__).resolve().parent
IMAGES = DOCS / "images" / "gallery"
PAGE = DOCS / "gallery.md"
HEAD = """# Gallery

**Use this when** you look for a command that does what you need. **Run** `python docs/gallery.py`, which makes this page
from its commands. **Trust it if** your scan resembles the phantom: [real scans](real.md) gain less.

Each picture shows one slice of the truth and of the volumes, on one grey scale, with their PSNR. Seconds are processor
seconds of all commands of a result, on two cores of a shared machine.
"""


@dataclass(frozen=True)
class Result:
    """A result: its title and sentence, the commands, and volumes by their labels in the picture."""

    title: str
    text: str
    commands: str
    volumes: dict[str, str]
    scan: str = "scan.h5"
    part: tuple[float, float, float, float, float] = (0.5, 0.0, 1.0, 0.0, 1.0)
    """What is drawn, as shares of the volume: the slice's height, and from where to where along y and x."""


FOOT = (0.28, 0.25, 1.0, 0.3, 0.72)
RESULTS = {
    "motion": Result(
        "The motion of the gantry",
        "The default method, with one pose per projection and with every row at its own times.",
        """
        phyradgs simulate --phantom foot --size 48 --detector 96 --noise tigre -o scan.h5
        phyradgs reconstruct scan.h5 --motion static -o static.h5
        phyradgs reconstruct scan.h5 -o known.h5
        """,
        {"motion ignored": "static.h5", "motion known": "known.h5"},
        part=FOOT,
    ),
    "splats": Result(
        "Gaussians that move during the exposure",
        "The paper's method, at rest and exact in time, with the preset of 500 iterations.",
        """
        phyradgs simulate --phantom foot --size 48 --detector 96 --noise tigre -o scan.h5
        phyradgs reconstruct scan.h5 --method phyradgs --preset quick --motion static -o static.h5
        phyradgs reconstruct scan.h5 --method phyradgs --preset quick -o exact.h5
        """,
        {"at rest": "static.h5", "exact in time": "exact.h5"},
        part=FOOT,
    ),
    "views": Result(
        "Few views",
        "Twelve views of a scan that stops for each: filtered backprojection, SIRT and the default.",
        """
        phyradgs simulate --phantom jaw --size 48 --detector 96 --protocol static --views 12 --noise tigre -o scan.h5
        phyradgs reconstruct scan.h5 --method fdk -o fdk.h5
        phyradgs reconstruct scan.h5 --method sirt -o sirt.h5
        phyradgs reconstruct scan.h5 -o fista.h5
        """,
        {"fdk": "fdk.h5", "sirt": "sirt.h5", "fista": "fista.h5"},
    ),
    "intensity": Result(
        "A panel that averages intensity",
        "Line integrals up to 6, which the panel averages as intensity: modelled as line integrals, then as intensity.",
        """
        phyradgs simulate --phantom shepp-logan --size 48 --detector 72 --peak 6 --detector-model intensity -o scan.h5
        phyradgs reconstruct scan.h5 --method fista-tv --detector-model log -o log.h5
        phyradgs reconstruct scan.h5 --method fista-tv -o intensity.h5
        """,
        {"line integrals": "log.h5", "intensity": "intensity.h5"},
    ),
    "dose": Result(
        "Few photons",
        "300 photons per pixel: SIRT, and the default, whose prior follows the noise of the projections.",
        """
        phyradgs simulate --phantom jaw --size 48 --detector 96 --noise beer --dose 300 -o scan.h5
        phyradgs reconstruct scan.h5 --method sirt -o sirt.h5
        phyradgs reconstruct scan.h5 -o fista.h5
        """,
        {"sirt": "sirt.h5", "fista": "fista.h5"},
    ),
    "offset": Result(
        "A panel that is not where the file says",
        "The panel is three pixels off. `check` measures the offset and writes it into a copy.",
        """
        phyradgs simulate --phantom foot --size 32 --detector 64 --noise tigre --detector-offset 0,0.1875 -o scan.h5
        python -c "import h5py; h5py.File('scan.h5', 'r+')['entry/phyradgs/detector_offset'][1] = 0"
        phyradgs check scan.h5 --fix-offset -o fixed.h5
        phyradgs reconstruct scan.h5 -o stated.h5
        phyradgs reconstruct fixed.h5 -o mended.h5
        """,
        {"as stated": "stated.h5", "after check": "mended.h5"},
        part=FOOT,
    ),
    "readout": Result(
        "A readout time that is wrong",
        "Columns are read; the file states 0.6 s in place of 0.86 s. `calibrate` finds the readout from the projections.",
        """
        phyradgs simulate --phantom foot --size 32 --detector 64 --first left --noise tigre -o scan.h5
        python -c "import h5py; h5py.File('scan.h5', 'r+')['entry/instrument/detector/detector_readout_time'][()] = 0.6"
        phyradgs calibrate scan.h5 --what readout,exposure -o calibrated.h5
        phyradgs reconstruct scan.h5 -o stated.h5
        phyradgs reconstruct calibrated.h5 -o found.h5
        """,
        {"as stated": "stated.h5", "calibrated": "found.h5"},
        part=FOOT,
    ),
    "rings": Result(
        "Rings and sparks",
        "Pixels whose gain is off by 2 %, and sparks in 0.1 % of them, before and after the usual three steps.",
        """
        phyradgs simulate --phantom jaw --size 48 --detector 72 --views 180 --exposure-deg 1.6 --noise beer --dose 1e5 \\
            --rings 0.02 --sparks 0.001 -o scan.h5
        phyradgs reconstruct scan.h5 --method fdk -o before.h5
        phyradgs reconstruct scan.h5 --method fdk --steps sparks,dead,rings -o after.h5
        """,
        {"as recorded": "before.h5", "sparks, dead, rings": "after.h5"},
    ),
    "scatter": Result(
        "Scattered light",
        "Scatter of 30 % of the primary light behind the object, fitted to the light around the object and removed.",
        """
        phyradgs simulate --phantom jaw --size 32 --detector 48 --views 60 --exposure-deg 4.8 --noise beer --dose 1e5 \\
            --peak 3 --scatter 0.3 -o scan.h5
        phyradgs reconstruct scan.h5 --method fista-tv -o before.h5
        phyradgs reconstruct scan.h5 --method fista-tv --steps scatter -o after.h5
        """,
        {"as recorded": "before.h5", "scatter removed": "after.h5"},
    ),
    "hardening": Result(
        "A beam that hardens",
        "A tube of 120 kV, and the correction by its spectrum with bone taken into account.",
        """
        phyradgs simulate --phantom jaw --size 32 --detector 48 --views 60 --exposure-deg 4.8 --noise beer --dose 1e5 \\
            --peak 3 --kvp 120 -o scan.h5
        phyradgs reconstruct scan.h5 --method fdk -o before.h5
        phyradgs reconstruct scan.h5 --method fdk --steps hardening --set hardening.kvp=120 -o after.h5
        """,
        {"as recorded": "before.h5", "hardening removed": "after.h5"},
    ),
    "truncation": Result(
        "A panel that is too narrow",
        "Half of the columns are cut off. FDK lets the rows end in air, or continues them as chords of a cylinder.",
        """
        phyradgs simulate --phantom shepp-logan --size 48 --detector 96 --views 60 --exposure-deg 4.8 \\
            --truncation 0.5 -o scan.h5
        phyradgs reconstruct scan.h5 --method fdk -o cut.h5
        phyradgs reconstruct scan.h5 --method fdk --set extrapolate=cylinder -o cylinder.h5
        """,
        {"rows end": "cut.h5", "rows continued": "cylinder.h5"},
    ),
    "prior": Result(
        "An earlier volume of the same object",
        "Nine views alone, and nine views with the volume of an earlier scan of 120 views as prior image.",
        """
        phyradgs simulate --phantom jaw --size 32 --detector 64 --views 120 --exposure-deg 2.4 --noise tigre -o earlier.h5
        phyradgs simulate --phantom jaw --size 32 --detector 64 --views 9 --noise tigre -o scan.h5
        phyradgs reconstruct earlier.h5 -o earlier_volume.h5
        phyradgs reconstruct scan.h5 -o alone.h5
        phyradgs reconstruct scan.h5 --initial earlier_volume.h5 --prior piccs -o piccs.h5
        """,
        {"nine views": "alone.h5", "with the prior image": "piccs.h5"},
    ),
}


def main() -> None:
    words = sys.argv[1:]
    names = [word for word in words if word in RESULTS] or list(RESULTS)
    folders = [word for word in words if word not in RESULTS]
    IMAGES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        for name in names:
            folder = Path(folders[0] if folders else temporary) / name
            folder.mkdir(parents=True, exist_ok=True)
            seconds = run(RESULTS[name].commands, folder)
            draw(RESULTS[name], folder, IMAGES / f"{name}.png")
            write(name, seconds)
            print(f"{name}: {seconds:.0f} s", flush=True)


def run(commands: str, folder: Path) -> float:
    """Runs commands in a folder. Returns the processor seconds of all. Status 10 of `check` is no failure."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    for line in commands.replace("\\\n", " ").strip().splitlines():
        program, *words = shlex.split(line)
        module = ["-m", "phyradgs_cl"] if program == "phyradgs" else []
        done = subprocess.run([sys.executable, *module, *words], cwd=folder, check=False, capture_output=True, text=True)
        if done.returncode not in (0, 10):
            sys.exit(f"{line}\n{done.stderr}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def draw(result: Result, folder: Path, path: Path) -> None:
    """Draws one slice of the truth and of every volume, on the grey scale of the truth."""
    truth = load_reference(folder / result.scan)[0].values
    nz, ny, nx = truth.shape
    z, y0, y1, x0, x1 = result.part
    part = round(z * nz), slice(round(y0 * ny), round(y1 * ny)), slice(round(x0 * nx), round(x1 * nx))
    wide = truth[part].shape[0] > 1.3 * truth[part].shape[1]
    slices = {"truth": truth, **{label: read_volume(folder / name).values for label, name in result.volumes.items()}}
    figure = Figure(figsize=(2.5 * len(slices), 1.65 if wide else 2.75), layout="constrained")
    for axes, (label, volume) in zip(figure.subplots(1, len(slices)), slices.items(), strict=True):
        image = volume[part]
        axes.imshow(image.T if wide else image, cmap="gray", vmin=0, vmax=float(truth[part].max()), origin="lower")
        title = label if volume is truth else f"{label}: {psnr(volume, truth):.1f} dB"
        axes.set_title(title, fontsize=9)
        axes.set_axis_off()
    figure.savefig(path, dpi=80, metadata={"Software": None})


def write(name: str, seconds: float) -> None:
    """Puts a result into the page, which has the results in the order of ``RESULTS``."""
    result = RESULTS[name]
    old = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
    sections = {title: body for title, body in re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", old, re.S | re.M)}
    commands = "\n".join(line[8:] for line in result.commands.strip("\n").splitlines()).strip()
    sections[result.title] = (
        f"\n{result.text} {seconds:.0f} seconds.\n\n```sh\n{commands}\n```\n\n"
        f"![{name}](images/gallery/{name}.png)\n\n"
    )
    ordered = [f"## {one.title}\n{sections[one.title].rstrip()}\n" for one in RESULTS.values() if one.title in sections]
    PAGE.write_text("\n".join([HEAD, *ordered, SECTION]), encoding="utf-8")


if __name__ == "__main__":
    main()
