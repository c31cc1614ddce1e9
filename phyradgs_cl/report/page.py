"""Writes a report about a reconstruction as one HTML page that needs no other file and no network."""

import hashlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from phyradgs_cl import __version__
from phyradgs_cl.acquisition.motion import motion_facts
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import check_writable, refuse_overwriting, written_beside
from phyradgs_cl.metrics import printed
from phyradgs_cl.reconstructors.projected import FramePair
from phyradgs_cl.report import sections
from phyradgs_cl.report.images import base64_of
from phyradgs_cl.report.markup import Markup, element, grouped, label, number, raw_text, tiles
from phyradgs_cl.report.run import Change, Run, computed_views, load_run, step_changes
from phyradgs_cl.runtime import Runtime

DEFAULT_VIEWS = 3  # frames that a page compares with frames computed from the volume
# slices.js sends the grey values when it loads, so space.js and motion.js, which listen for them, must come first.
_SCRIPT = ("common", "shaders", "render", "space", "motion", "slices", "rows")
_SCRIPTED = ("volume",)  # these sections stay hidden until the page's script shows them


@np.errstate(all="ignore")  # values from a file may overflow; the page still shows all others
def write_report(
    volume: Path, output: Path, make_runtime: Callable[[], Runtime], *, scan: Path | None = None,
    views: int = DEFAULT_VIEWS,
) -> Run:
    """Writes a report about a volume file to ``output``, completely or not at all, and returns the run.

    scan: None takes the file that the volume's provenance names, if it is unchanged. views: how many frames are computed
    from the volume, on the device of ``make_runtime``; for 0 no device is needed.

    Raises InputError for files that cannot be read or are of another kind, and for an output that is an input or no HTML.
    Raises OutputError if the page cannot be written, and DeviceError if no device can project."""
    check_writable(output)
    run = load_run(volume, scan)
    refuse_overwriting("-o", output, volume, run.scan_path)
    if Path(output).suffix.lower() not in ("", ".html", ".htm"):
        found, remedy = f"the suffix {Path(output).suffix}", "a browser prints the page to a PDF"
        raise InputError("-o", found, "an HTML page, as NAME.html", remedy)
    shown = computed_views(run, make_runtime(), views) if run.scan is not None and views > 0 else []
    page = report_page(run, shown, step_changes(run, make_runtime()) if shown else [])
    with written_beside(output) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return run


def report_page(run: Run, views: Sequence[FramePair] = (), changes: Sequence[Change] = ()) -> str:
    """Returns the page's HTML. views, changes: what ``computed_views`` and ``step_changes`` return."""
    of_scan = {} if run.scan is None else {
        "preparation": sections.preparation_section(run, changes),
        "projections": sections.projections_section(run.scan, views),
        "calibration": sections.calibration_section(run.scan), "scan": sections.scan_section(run),
        "geometry": sections.geometry_section(run.scan), "shutter": sections.shutter_section(run, run.scan),
    }  # fmt: skip
    parts = {
        "slices": sections.slices_section(run), "doubt": sections.doubt_section(run),
        "metrics": sections.metrics_section(run, views), "convergence": sections.convergence_section(run),
        "motion": sections.motion_section(run), "states": sections.states_section(run),
        "volume": sections.volume_section(run), **of_scan, "provenance": sections.provenance_section(run),
    }  # fmt: skip
    shown = {name: part for name, part in parts.items() if part is not None}
    footer = element("footer", f"Written by phyradgs-cl {__version__} from {run.path.name}.")
    title = f"{run.path.name} – {run.stored.provenance.get('method', 'volume')}"
    script = web_script(*(part for part in _SCRIPT if part != "motion" or part in shown))
    return document(title, script, _top(run), list(shown), "slices", _arranged(shown), footer)


def document(
    title: str, script: str, top: Sequence[Markup], links: Sequence[str], content: str, parts: Sequence[Markup],
    last: Markup, reload_s: int | None = None,
) -> str:
    """Returns a whole page: ``top``, ``links`` to sections, the sections ``parts`` and ``last``. content: the section to
    which users of a keyboard may skip. reload_s: as in ``_head``."""
    anchors = [element("a", name.capitalize(), href=f"#{name}", hidden=name in _SCRIPTED) for name in links]
    body = element(
        "body", element("a", "To the content", href=f"#{content}", class_="skip"),
        element("header", *top, element("nav", *anchors, aria_label="Sections")),
        element("main", *parts), last, raw_text("script", script),
    )
    return "<!doctype html>\n" + element("html", _head(title, script, reload_s), body, lang="en") + "\n"


def _arranged(shown: dict[str, Markup]) -> list[Markup]:
    """Returns the sections in order. Metrics and convergence are side by side if the window is wide enough."""
    narrow = [part for name, part in shown.items() if name in ("metrics", "convergence")]
    wide = [part for name, part in shown.items() if name not in ("metrics", "convergence")]
    pair = element("div", *narrow, class_="pair") if narrow else Markup()
    return [wide[0], pair, *wide[1:]]


def _head(title: str, script: str, reload_s: int | None) -> Markup:
    """Returns the page's head, with styles and a policy that forbids network access and all scripts except ``script``.
    reload_s: time in s after which a browser without scripts loads the page again."""
    digest = base64_of(hashlib.sha256(script.encode()).digest())
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    policy += "; base-uri 'none'; form-action 'none'"
    return element(
        "head", element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"), element("title", title),
        raw_text("style", _web("page.css")),
        None if reload_s is None else element("noscript", element("meta", http_equiv="refresh", content=str(reload_s))),
    )


def _top(run: Run) -> list[Markup]:
    title = run.scan.title if run.scan is not None else run.path.name
    motion = f", motion {motion_facts(run.motion)['name']}" if run.motion is not None else ""
    method = run.stored.provenance.get("method", "unknown method")
    words = f"{run.path.name}: {method}{motion}"
    if run.scan_path is not None:
        words += f", from {run.scan_path.name}"
    notes = [element("p", note, class_="warning", role="note") for note in run.notes]
    return [element("h1", title), element("p", words), *notes, tiles(_facts(run))]


def _facts(run: Run) -> list[tuple[str, str]]:
    facts = [("method", str(run.stored.provenance.get("method", "unknown"))[:40]), *printed(run.metrics)]
    if run.record and (names := [k for k in run.record[-1] if k in ("loss", "residual")]):
        facts.append((f"last {label(names[0])}", number(run.record[-1][names[0]])))
    gaussians, seconds = (run.stored.provenance.get(key) for key in ("gaussians", "seconds"))
    if isinstance(gaussians, int) and gaussians > 0:
        facts.append(("Gaussians", grouped(gaussians)))
    if isinstance(seconds, int | float):
        facts.append(("run time", f"{number(float(seconds))} s"))
    return facts


def web_script(*names: str) -> str:
    """Returns files of the folder ``web``, joined to one script."""
    return "".join(_web(f"{name}.js") for name in names)


@cache
def _web(name: str) -> str:
    return (Path(__file__).parent / "web" / name).read_text(encoding="utf-8")
