"""The page of a run: complete, self-contained, with the right numbers, and safe from hostile text in files."""

import base64
import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused

from phyradgs_cl.acquisition import CircularOrbit, FrameSweeps, Shutter
from phyradgs_cl.errors import OutputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import Volume, read_volume, write_scan, write_volume
from phyradgs_cl.prepare.rings import RingOptions
from phyradgs_cl.reconstructors import Preprocessing, plan_run
from phyradgs_cl.report import Run, load_run, report_page, write_report
from phyradgs_cl.report.images import Window
from phyradgs_cl.report.run import computed_views, spread_frames
from phyradgs_cl.report.sections import calibration_section
from phyradgs_cl.workflow import run_reconstruction

pytestmark = pytest.mark.slow
ALL = {"slices", "volume", "metrics", "convergence", "projections", "scan", "geometry", "shutter", "provenance"}
HOSTILE = "</title></script><script>alert(1)</script><img src=x onerror='alert(2)'>\"'&amp;"


@pytest.fixture(scope="module")
def page_text(rt, files, tmp_path_factory) -> str:
    page = tmp_path_factory.mktemp("page") / "page.html"
    write_report(files[1], page, lambda: rt)
    return page.read_text(encoding="utf-8")


@pytest.fixture
def page(page_text, parse):
    return parse(page_text)


def no_runtime() -> None:
    raise AssertionError("no device is needed here")


def test_a_page_is_whole_and_asks_nothing_of_the_world(page, page_text) -> None:
    """Every section once, every link leads somewhere, every control and picture has a name, and one script may run."""
    assert not page.open and len(page.ids) == len(set(page.ids)) and set(page.ids) >= ALL
    for link in page.all("a"):
        assert link["href"].startswith("#") and link["href"][1:] in page.ids
    for _, attributes in page.elements:
        for key in ("aria-labelledby", "aria-describedby"):
            assert set(attributes.get(key, page.ids[0]).split()) <= set(page.ids)
    labelled = {label.get("for") for label in page.all("label")}
    for control in page.all("input"):
        assert control["id"] in labelled or control["type"] == "radio"  # radio buttons lie in their labels
    assert all(svg["role"] == "img" and svg["aria-label"] for svg in page.all("svg"))
    assert all(i["alt"] and i["src"].startswith("data:image/png;base64,") for i in page.all("img"))
    assert not page.all("link") and not re.findall(r"https?://[^\s\"'<]*|@import|url\((?!#)", page_text)
    policy = next(m["content"] for m in page.all("meta") if "http-equiv" in m)
    digest = base64.b64encode(hashlib.sha256(page.texts["script"][-1].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in policy and "default-src 'none'" in policy
    assert [s.get("type", "") for s in page.all("script")] == [*3 * ["application/json"], ""]


def test_a_slice_says_why_there_is_no_picture_in_3d(tmp_path, parse) -> None:
    thin = tmp_path / "thin.h5"
    write_volume(thin, np.ones((1, 8, 8), np.float32), Grid((1, 8, 8), (1.0, 1.0, 1.0)), {})
    page = parse(report_page(load_run(thin)))
    assert "no picture in 3D of a volume one voxel thick" in page.words and "volume" not in page.ids


def test_metrics_and_convergence_are_those_of_the_file(page, files) -> None:
    stored = read_volume(files[1])
    residuals = [line["residual"] for line in stored.provenance["record"]]
    course = f"Residual: from {residuals[0]:.4g} to {residuals[-1]:.4g} at iteration 3"
    for told in (f"{stored.metrics['psnr_db']:.2f} dB", f"{stored.metrics['ssim']:.4f}", course):
        assert told in page.words


def test_pictures_decode_to_the_volume_slices(page, files, small_scan) -> None:
    stored, data = read_volume(files[1]), json.loads(page.texts["script"][0])
    layers = {"result": stored.values, "truth": small_scan.reference, "difference": stored.values - small_scan.reference}
    assert list(data["windows"]) == list(layers)
    for name, axis in (("axial", 0), ("coronal", 1), ("sagittal", 2)):
        plane = data["planes"][name]
        assert plane["indices"] == list(range(12)) and len(plane["places"]) == plane["count"] == 12
        assert set(plane["layers"]) == set(layers)
        for layer, volume in layers.items():
            window = data["windows"][layer]
            step = (window["most"] - window["least"]) / 255
            for k in (0, 5, 11):
                image = page.pixels("data:image/png;base64," + plane["layers"][layer][k])
                expected = np.clip(volume.take(k, axis=axis)[::-1], window["least"], window["most"])
                assert np.abs(window["least"] + step * image - expected).max() <= 0.501 * step
                assert 10 ** -window["decimals"] <= step < 10 ** (1 - window["decimals"])


def test_without_a_script_the_middle_slices_have_the_stated_window(page, files) -> None:
    high = float(re.search(r"white ([\d.]+) 1/mm", page.words)[1])
    stills = [image for image in page.all("img") if "slice of the volume" in image["alt"]]
    for axis, still in enumerate(stills):
        expected = 255 * np.clip(read_volume(files[1]).values.take(6, axis=axis)[::-1] / high, 0, 1)
        assert np.abs(page.pixels(still["src"]) - expected).max() <= 1
    marks = [text for text in page.texts["b"] if text[0] in "+−"]
    assert marks == ["−x", "+x", "+y", "−y", "−x", "+x", "+z", "−z", "−y", "+y", "+z", "−z"]
    assert page.texts["span"].count("0.5 mm") == 3  # a bar of the largest round length below 0.3 of 2 mm


def test_a_window_has_room_for_overshoots_and_says_what_lies_beyond() -> None:
    volume = np.array([-0.1, 0.0, 1.0, 9.0])
    assert Window.of(0.0, 1.0, volume) == Window(0.0, 1.0, -0.1, 1.25, (False, True))
    assert Window.of(0.0, 1.0, volume[1:3]) == Window(0.0, 1.0, 0.0, 1.0, (False, False))


def test_the_shown_frames_are_close_to_the_measured_ones(rt, files, page) -> None:
    run = load_run(files[1])
    views = computed_views(run, rt, 3)
    assert [view.frame for view in views] == [0, 2, 5] == spread_frames(8, 3)
    assert spread_frames(3, 16) == [0, 1, 2] and all(view.relative < 0.2 for view in views)
    images = [image for image in page.all("img") if image["alt"].startswith("frame ")]
    assert len(images) == 9 and page.pixels(images[0]["src"]).shape == (16, 14)
    assert f"residual, RMS {views[0].rms:.4g}" in page.words


def test_frames_of_an_intensity_panel_are_compared_with_intensities(rt, scan_maker) -> None:
    scan = scan_maker(detector_model="intensity", peak=8.0)
    truth = Volume(scan.reference, scan.grid, {})
    as_it_is = computed_views(Run(Path("v.h5"), truth, scan), rt, 8)
    as_log = computed_views(Run(Path("v.h5"), truth, replace(scan, detector_model="log")), rt, 8)
    means = [np.mean([view.residual.mean() for view in views]) for views in (as_it_is, as_log)]
    assert abs(means[0]) < 0.7 * abs(means[1])  # the rest is what 12³ voxels leave of the finer phantom
    assert sum(view.rms for view in as_it_is) < sum(view.rms for view in as_log)


def test_masked_pixels_do_not_count(rt, files, small_scan) -> None:
    stored = read_volume(files[1])
    mask, frames = np.zeros((16, 14), bool), small_scan.projections.copy()
    mask[3, 4], frames[:, 3, 4] = True, 1e6
    scan = replace(small_scan, projections=frames, pixel_mask=mask)
    (view,) = computed_views(Run(files[1], stored, scan), rt, 1)
    assert view.residual[3, 4] == 0 and not view.valid[3, 4] and view.relative < 0.2


def test_what_files_say_is_never_a_part_of_the_page(rt, files, small_scan, tmp_path, parse) -> None:
    stored = read_volume(files[1])
    scan_path, volume_path = tmp_path / "s.h5", tmp_path / "<i>v.h5"
    write_scan(scan_path, replace(small_scan, title=HOSTILE))
    record = [{"iteration": 1, HOSTILE: 2.0, "loss": HOSTILE}, {"iteration": 2, HOSTILE: 3.0}, HOSTILE]
    options = {"motion": {"name": HOSTILE}, HOSTILE: [HOSTILE]}
    facts = {"options": options, "input": {"holdout": HOSTILE}, "record": record}
    facts |= {"method": HOSTILE, HOSTILE: HOSTILE, "scan": HOSTILE}
    write_volume(volume_path, stored.values, stored.grid, facts, None, {"psnr_db": HOSTILE, HOSTILE: 1})
    write_report(volume_path, tmp_path / "p.html", lambda: rt, scan=scan_path)
    text = (tmp_path / "p.html").read_text(encoding="utf-8")
    page = parse(text)
    assert not page.open and len(page.all("script")) == 4 and len(page.all("title")) == 1
    assert not any(key.startswith("on") for _, attributes in page.elements for key in attributes)
    assert not [image for image in page.all("img") if image["src"] == "x"]
    assert "alert(1)" in page.words  # it is shown, as text


def test_what_version_0_2_did_to_the_frames_is_done_again(any_volume, tmp_path) -> None:
    facts = {"ignore_lag": True, "median_filter": 0, "steps": "rings", "rings": {"method": "mean", "window": 5}}
    write_volume(tmp_path / "v.h5", *any_volume, {"input": facts})
    assert load_run(tmp_path / "v.h5").preprocessing == Preprocessing(ignore_lag=True, steps="rings", rings=RingOptions(5))


def test_a_run_without_its_scan_still_shows_the_volume_and_a_bare_result_its_picture(
    files, any_volume, tmp_path, parse, caplog
) -> None:
    volume, stored = tmp_path / "alone.h5", read_volume(files[1])
    write_volume(volume, stored.values, stored.grid, {**stored.provenance, "scan": "gone.h5"}, None, stored.metrics)
    run = write_report(volume, tmp_path / "p.html", no_runtime)
    assert run.scan is None and "--scan" in run.notes[0] and "gone.h5" in caplog.text
    page = parse((tmp_path / "p.html").read_text(encoding="utf-8"))
    assert set(page.ids) & ALL == {"slices", "volume", "metrics", "convergence", "provenance"}
    assert not [i for i in page.ids if i.startswith("layer-")]
    write_volume(tmp_path / "v.h5", *any_volume, {})
    page = parse(report_page(load_run(tmp_path / "v.h5")))
    assert set(page.ids) & ALL == {"slices", "volume", "provenance"}
    sizes = {image["style"] for image in page.all("img")}
    assert len(sizes) == 3 and "aspect-ratio: 0.8 / 1.2" in sizes


def test_a_scan_that_stops_has_no_times(rt, files, small_scan, tmp_path, parse) -> None:
    orbit = CircularOrbit(small_scan.geometry, FrameSweeps(np.arange(8.0), 0.0, *2 * [np.linspace(0, 5, 8)]))
    stops = {"trajectory": orbit, "frame_start_s": np.arange(8.0), "is_fly": False}
    for exposure_s in (0.0, 0.25):
        write_scan(tmp_path / "s.h5", replace(small_scan, **stops, shutter=Shutter(exposure_s)))
        write_report(files[1], tmp_path / "p.html", lambda: rt, scan=tmp_path / "s.h5", views=0)
        page = parse((tmp_path / "p.html").read_text(encoding="utf-8"))
        assert ("shutter" in page.ids) == ("exposure 0.25 s" in page.words) == (exposure_s > 0)
        assert "exposure 0 s" not in page.words and "first frames on one axis of time" not in page.words
        assert "first gantry angle" in page.words


def test_a_scan_that_has_changed_is_not_taken_for_the_run_scan(files, small_scan, tmp_path, parse) -> None:
    volume, stored = tmp_path / "volume.h5", read_volume(files[1])
    facts = {**stored.provenance, "scan": str(tmp_path / "other.h5")}
    write_volume(volume, stored.values, stored.grid, facts)
    write_scan(tmp_path / "other.h5", replace(small_scan, reference=None))
    assert load_run(volume).scan is None
    run = load_run(volume, tmp_path / "other.h5")
    assert run.scan is not None and "hash differs" in run.notes[0]
    page = parse(report_page(run))
    assert set(page.ids) & ALL == ALL - {"projections", "metrics"}


def test_files_of_another_kind_are_named_and_inputs_never_replaced(files, tmp_path) -> None:
    scan, volume = files
    page = tmp_path / "p.html"
    assert_refused({
        "found a scan": lambda: write_report(scan, page, no_runtime),
        "--scan.*found a volume": lambda: write_report(volume, page, no_runtime, scan=volume),
        "reads or writes": lambda: write_report(volume, scan, no_runtime),
        r"^-o: found the suffix \.pdf": lambda: write_report(volume, tmp_path / "page.pdf", no_runtime),
    })
    with pytest.raises(OutputError, match="nowhere"):
        write_report(volume, tmp_path / "nowhere" / "p.html", no_runtime)
    assert not list(tmp_path.iterdir())


def test_steps_before_the_method_are_shown(rt, small_scan, tmp_path, parse) -> None:
    """A frame, a sinogram and a slice before and after, their differences and a histogram for each; of a scan that was
    prepared already, its numbers."""
    sparked = small_scan.projections.copy()
    sparked[1, 5, 6] -= 3
    told = {"prepared": [{"step": "air", "light": [0.98, 1.01]}]}
    write_scan(tmp_path / "scan.h5", replace(small_scan, projections=sparked, provenance=told))
    plan = plan_run("fdk", {"steps": "sparks,rings"})
    run_reconstruction(plan, tmp_path / "scan.h5", tmp_path / "volume.h5", lambda: rt)
    write_report(tmp_path / "volume.h5", tmp_path / "page.html", lambda: rt)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    section = text.split('id="preparation"')[1].split("</section>")[0]
    assert "sparks: frame 1" in section and "rings: frame" in section and "0.98" in section
    assert section.count("sparks: sinogram of row 5") == 1 and section.count("middle slice by fdk</h3>") == 2
    assert section.count("<img") == 18 and section.count("Histogram of line integrals") == 2 and not parse(text).open


def test_what_a_calibration_says_of_itself_may_be_anything(small_scan, parse) -> None:
    """Sound values are shown in full; any other value leaves the page whole, and none becomes markup."""
    line = {"name": "roll", "unit": "deg", "stated": 0.0, "found": 0.5, "deviation": 0.1, "verdict": "corrected"}
    views = {"shift_u_mm": [0.1] * small_scan.frames, "turn_deg": [1.0], "<b>": ["x"] * small_scan.frames, "none": "text"}
    good = {"parameters": [line, {"name": "<i>x</i>"}, 3], "alike": ["a against b"], "views": views, "residual_rms_after": 2}
    for told, rows, charts in (
        ({"calibration": good}, 2, 1),
        ({"calibration": good, "calibrated_before": [good, 4]}, 4, 2),
        ({"calibration": 7}, 0, 0), ({"calibration": [good]}, 0, 0), ({"calibration": {"parameters": {}}}, 0, 0),
    ):  # fmt: skip
        scan = replace(small_scan, provenance=told)
        section = calibration_section(scan) or ""
        assert (section.count("<tr>") - section.count("<thead>"), section.count("<svg")) == (rows, charts)
        assert ("0.50 ± 0.10" in section) == ("a against b" in section) == bool(rows)
        if "calibrated_before" in told or told["calibration"] == 7:
            text = report_page(Run(Path("v.h5"), Volume(scan.reference, scan.grid, {}), scan))
            assert ('id="calibration"' in text) == ("0.50 ± 0.10" in text) == bool(rows)
            assert "<i>" not in text and not parse(text).open
