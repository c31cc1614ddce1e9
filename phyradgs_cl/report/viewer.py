"""Makes a viewer of a volume's slices for a page, used by keyboard, mouse or finger, and pictures without controls."""

import math
from collections.abc import Mapping

import numpy as np

from phyradgs_cl.drawing import round_length
from phyradgs_cl.report.images import Plane, Window, base64_of, data_uri, diverging, png_bytes
from phyradgs_cl.report.markup import Markup, element, joined, json_block, number

_LAYER_NAMES = {"result": "Result", "truth": "Truth", "difference": "Difference", "doubt": "Error bar"}
_MOST_ZOOM = 8
_BAR = 0.3  # the scale bar is at most this fraction of a picture's width
_HELP = (
    "Arrow keys, Page Up and Down, Home and End move a slider. The wheel moves the slice under the pointer, with Ctrl the "
    "zoom. A click in a picture, or dragging, moves the other two slices to that point."
)


def viewer(planes: list[Plane], windows: Mapping[str, Window]) -> Markup:
    """Returns three slices with sliders, controls for layers, grey values and zoom, and the data of the page's script."""
    sliders = [
        slider("black", "Black", 0, 255, 0, ""), slider("white", "White", 0, 255, 255, ""),
        slider("zoom", "Zoom", 1, _MOST_ZOOM, 1, "1×", 0.5), element("button", "Reset", type="button", id="reset"),
    ]
    names = {layer: words for layer, words in _LAYER_NAMES.items() if layer in windows}
    figures = element("div", *(_figure(plane) for plane in planes), class_="slices")
    layers = {key: {**vars(w), "decimals": decimals_of((w.most - w.least) / 255)} for key, w in windows.items()}
    colours = base64_of(diverging().tobytes()) if "difference" in windows else None
    data = {plane.name: _plane_data(plane) for plane in planes}
    first = windows["result"]
    legend = f"Black is {number(first.low, first.high)}, white {number(first.high)} 1/mm."
    return joined(
        element("div", choice("layer", "layer", names) if len(names) > 1 else None, *sliders, class_="tools"), figures,
        element("p", element("output", legend, id="reading"), class_="note"),
        element("p", _HELP, class_="note help"),
        json_block("slice-data", {"planes": data, "windows": layers, "colours": colours}),
    )


def slider(name: str, words: str, low: float, high: float, value: float, shown: str, step: float = 1) -> Markup:
    """Returns a slider with its name and its value as text, which the script updates."""
    control = element(
        "input", type="range", id=name, min=low, max=high, step=step, value=value, aria_describedby=f"{name}-value"
    )
    label = element("label", words, for_=name)
    return element("span", label, control, element("output", shown, id=f"{name}-value", for_=name))


def _figure(plane: Plane) -> Markup:
    ids, last = (f"slider-{plane.name}", f"place-{plane.name}"), len(plane.indices) - 1
    shown = picture(plane, "volume", canvases=1, has_lines=True)
    return element("figure", shown, *plane_slider(plane, *ids, last, plane.middle), id=f"plane-{plane.name}")


def plane_slider(plane: Plane, slider_id: str, place_id: str, last: int, value: int) -> tuple[Markup, Markup]:
    """Returns the caption of a slice, with its place, and a slider from 0 to ``last`` that moves it."""
    caption = element(
        "figcaption", element("label", f"{plane.name.capitalize()} slice ({plane.axis})", for_=slider_id),
        element("output", place(plane, plane.middle), id=place_id, for_=slider_id),
    )
    return caption, element("input", type="range", id=slider_id, min=0, max=last, value=value, aria_describedby=place_id)


def stills(planes: list[Plane], of: str, high: float) -> Markup:
    """Returns pictures without controls, and a bar of their grey values: black is 0, white is ``high`` (1/mm) and above."""
    figures = []
    for plane in planes:
        words = f"{plane.name.capitalize()} slice ({place(plane, plane.middle)})"
        figures.append(element("figure", picture(plane, of), element("figcaption", words)))
    ramp = data_uri(png_bytes(np.arange(256, dtype=np.uint8)[None]))
    bar = "0", element("img", src=ramp, alt="from black to white"), f"{number(high)} 1/mm and above"
    return joined(element("div", *figures, class_="slices stills"), element("p", *bar, class_="values"))


def picture(plane: Plane, of: str, *, canvases: int = 0, has_lines: bool = False) -> Markup:
    """Returns a slice with world axes at its edges and a scale bar. canvases: number of canvases on top of the slice, for
    the script. has_lines: two lines on top show where the other slices are."""
    width_mm, height_mm = plane.size_mm
    image = element(
        "img", src=data_uri(plane.still),
        alt=f"{plane.name.capitalize()} slice of the {of}, {plane.right} to the right, {plane.up} up",
        style=f"aspect-ratio: {width_mm:.6g} / {height_mm:.6g}", draggable="false",
    )
    lines = [element("i", class_=way, aria_hidden="true") for way in ("across", "upwards")] if has_lines else []
    sheet = element("div", image, *canvases * [element("canvas", aria_hidden="true")], class_="sheet")
    ways = {"left": f"−{plane.right}", "right": f"+{plane.right}", "top": f"+{plane.up}", "bottom": f"−{plane.up}"}
    marks = (element("b", way, class_=edge, aria_hidden="true") for edge, way in ways.items())
    bar_mm = round_length(_BAR * width_mm)
    bar = element("span", f"{number(bar_mm)} mm", class_="bar", style=f"width: {100 * bar_mm / width_mm:.6g}%")
    return element("div", sheet, *lines, *marks, bar, class_="picture")


def place(plane: Plane, k: int) -> str:
    """Returns the position of the slice ``plane.indices[k]`` as text, such as "z = 1.5 mm, 17 of 32"."""
    where = number(plane.first_mm + plane.indices[k] * plane.step_mm, plane.step_mm)
    return f"{plane.axis} = {where} mm, {plane.indices[k] + 1} of {plane.count}"


def choice(name: str, prefix: str, words: Mapping[str, str]) -> Markup:
    """Returns buttons that choose one of the values in ``words``; the first is chosen initially."""
    labels = list[Markup]()
    for value, text in words.items():
        button = element("input", type="radio", name=name, id=f"{prefix}-{value}", value=value, checked=not labels)
        labels.append(element("label", button, text))
    return element("fieldset", element("legend", "Show"), *labels, class_="choice")


def _plane_data(plane: Plane) -> dict[str, object]:
    places = [place(plane, k) for k in range(len(plane.indices))]
    names = ("axis", "right", "up", "count", "indices", "first_mm", "step_mm", "layers")
    facts = {name: getattr(plane, name) for name in names}
    return {**facts, "width_mm": plane.size_mm[0], "decimals": decimals_of(plane.step_mm) + 1, "places": places}


def decimals_of(step: float) -> int:
    """Returns how many decimals are needed to tell values apart that differ by ``step``."""
    return int(min(20, max(0, math.ceil(-math.log10(step))))) if step > 0 else 0
