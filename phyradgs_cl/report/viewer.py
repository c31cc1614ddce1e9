"""The part of a page in which one walks through the volume, with keyboard, mouse or finger."""

from __future__ import annotations

from phyradgs_cl.report.facts import number, shown
from phyradgs_cl.report.markup import Markup, element, joined, json_block
from phyradgs_cl.report.slices import Plane, Windows

_LAYER_NAMES = {"result": "Result", "truth": "Truth", "difference": "Difference"}


def viewer(planes: list[Plane], windows: Windows) -> Markup:
    """Three pictures with a slider each, a choice of layers where there is a truth, and the data behind them."""
    layers = list(planes[0].layers)
    choice = _choice(layers) if len(layers) > 1 else None
    figures = element("div", *(_figure(plane) for plane in planes), class_="slices")
    told = (
        "Arrow keys, Page Up and Down, Home and End move a slider; a click in a picture moves the other two."
    )
    return joined(
        choice,
        figures,
        element("p", _legend(windows), class_="note", id="legend"),
        element("p", told, class_="note"),
        json_block("slice-data", {plane.name: _data(plane) for plane in planes}),
    )


def _figure(plane: Plane) -> Markup:
    """One orientation: picture, cross lines, where the slice is, slider."""
    middle, name = len(plane.indices) // 2, f"{plane.name.capitalize()} slice"
    slider_id, place_id = f"slider-{plane.name}", f"place-{plane.name}"
    slider = element(
        "input",
        type="range",
        id=slider_id,
        min=0,
        max=len(plane.indices) - 1,
        step=1,
        value=middle,
        aria_describedby=place_id,
    )
    caption = element(
        "figcaption",
        element("label", f"{name} ({plane.axis})", for_=slider_id),
        element("output", _place(plane, middle), id=place_id, for_=slider_id),
    )
    return element("figure", _picture(plane, middle, name), caption, slider, id=f"plane-{plane.name}")


def _picture(plane: Plane, k: int, name: str) -> Markup:
    width_mm, height_mm = plane.size_mm
    image = element(
        "img",
        src=f"data:image/png;base64,{plane.layers['result'][k]}",
        alt=f"{name} of the volume, {plane.right} to the right, {plane.up} up",
        style=f"aspect-ratio: {width_mm:.6g} / {height_mm:.6g}",
        draggable="false",
    )
    lines = (element("i", class_=way, aria_hidden="true") for way in ("across", "upwards"))
    return element("div", image, *lines, class_="picture")


def _place(plane: Plane, k: int) -> str:
    """Where a slice is; the page's script says it in the same words."""
    return f"{plane.axis} = {number(plane.positions_mm[k])} mm, {plane.indices[k] + 1} of {plane.count}"


def _choice(layers: list[str]) -> Markup:
    def one(layer: str) -> Markup:
        button = element(
            "input", type="radio", name="layer", id=f"layer-{layer}", value=layer, checked=layer == "result"
        )
        return element("label", button, _LAYER_NAMES[layer])

    return element("fieldset", element("legend", "Show"), *(one(layer) for layer in layers), class_="choice")


def _legend(windows: Windows) -> str:
    grey = f"Black is {shown(windows.low)}, white {shown(windows.high)} 1/mm."
    if windows.difference is None:
        return grey
    return f"{grey} Difference, result less truth: blue −{shown(windows.difference)}, red +{shown(windows.difference)} 1/mm."


def _data(plane: Plane) -> dict[str, object]:
    places = [_place(plane, k) for k in range(len(plane.indices))]
    facts = {"axis": plane.axis, "right": plane.right, "up": plane.up, "count": plane.count}
    return {**facts, "indices": plane.indices, "places": places, "layers": plane.layers}
