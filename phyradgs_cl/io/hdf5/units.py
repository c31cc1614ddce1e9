"""Units in files: the names that are accepted, and their factors to millimetres, seconds and radians."""

import math
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class Quantity:
    """A physical quantity: factors from the accepted unit names to the package's unit. ``assumed``: of a dataset
    without units. ``largest``, in the package's unit: numbers past it are damage, and would overflow later."""

    name: str
    assumed: str
    largest: float
    factors: MappingProxyType[str, float]

    def factor(self, unit: str) -> float | None:
        """Multiplier for a value in ``unit``, or None if the name is unknown."""
        return self.factors.get(unit.strip())

    @property
    def accepted(self) -> str:
        """The short unit names, for messages."""
        return ", ".join(name for name in self.factors if len(name) <= 4 and name.isascii())


def _quantity(name: str, assumed: str, largest: float, factors: dict[tuple[str, ...], float]) -> Quantity:
    flat = {unit: factor for names, factor in factors.items() for unit in names}
    return Quantity(name, assumed, largest, MappingProxyType(flat))


LENGTH = _quantity("length", "mm", 1e9, {
    ("mm", "millimeter", "millimetre", "millimeters", "millimetres"): 1.0,
    ("cm", "centimeter", "centimetre", "centimeters", "centimetres"): 10.0,
    ("m", "meter", "metre", "meters", "metres"): 1000.0,
    ("um", "\u00b5m", "\u03bcm", "micrometer", "micrometre", "micrometers", "micrometres"): 1e-3,
})  # fmt: skip
TIME = _quantity("time", "s", 1e12, {
    ("s", "sec", "second", "seconds"): 1.0,
    ("ms", "millisecond", "milliseconds"): 1e-3,
    ("us", "\u00b5s", "\u03bcs", "microsecond", "microseconds"): 1e-6,
})  # fmt: skip
ANGLE = _quantity("angle", "deg", 1e8, {
    ("deg", "degree", "degrees", "\u00b0"): math.pi / 180, ("rad", "radian", "radians"): 1.0
})  # fmt: skip
ATTENUATION = _quantity("attenuation", "1/mm", 1e9, {
    ("1/mm", "mm^-1", "mm-1"): 1.0, ("1/cm", "cm^-1", "cm-1"): 0.1, ("1/m", "m^-1", "m-1"): 1e-3
})  # fmt: skip
