"""Table of materials (density, friction, restitution, wall thickness, with ranges), and the choice for an object.

Sources, named at each row:

- [ETB-solids] The Engineering ToolBox, "Solids - Densities"; [ETB-wood] "Wood Species - Densities";
  [ETB-friction] "Friction - Coefficients for Common Materials and Surfaces" (static, dry, against wood where given).
- [Ashby] M. F. Ashby, "Materials Selection in Mechanical Design", 5th ed., appendix A: property ranges.
- [CRC] "CRC Handbook of Chemistry and Physics", "Coefficients of Friction".
- [Cross] R. Cross, "The bounce of a ball", Am. J. Phys. 67 (1999) 222: how much energy blunt household contacts keep.

Values are the middle of the sources' values for household goods, ranges their span. Restitution is the least certain:
it depends on shape and speed as much as on the material.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


class Spread(NamedTuple):
    """A value and its plausible range."""

    value: float
    low: float
    high: float

    def widened(self, other: "Spread") -> "Spread":
        """Return the same value with a range that includes another one."""
        return Spread(self.value, min(self.low, other.low), max(self.high, other.high))


@dataclass(frozen=True)
class Material:
    """Properties of a solid material."""

    density_kg_m3: Spread
    friction: Spread  # against a typical household surface, dimensionless
    restitution: Spread
    wall_m: Spread  # wall thickness of hollow objects


def _material(density: tuple, friction: tuple, restitution: tuple, wall_m: tuple) -> Material:
    return Material(Spread(*density), Spread(*friction), Spread(*restitution), Spread(*wall_m))


MATERIALS = {
    # Pine 500, particle board 650-700, oak 700-750 kg/m3 [ETB-wood]; wood on wood 0.25-0.5, up to 0.6 [ETB-friction].
    "wood": _material((650, 420, 800), (0.45, 0.25, 0.60), (0.20, 0.05, 0.45), (0.015, 0.008, 0.022)),
    # Earthenware 1900 to porcelain 2500 kg/m3 [Ashby]; glazed on wood as glass.
    "ceramic": _material((2350, 1900, 2500), (0.40, 0.25, 0.55), (0.15, 0.02, 0.50), (0.004, 0.003, 0.006)),
    # Soda-lime glass 2440-2490, lead glass to 2800 kg/m3 [Ashby]; glass on wood 0.2-0.5 [CRC].
    "glass": _material((2480, 2400, 2800), (0.35, 0.20, 0.50), (0.20, 0.02, 0.60), (0.003, 0.0015, 0.005)),
    # Aluminum 2700, steel 7850 kg/m3 [ETB-solids]; household goods are of both; metal on wood 0.2-0.6 [ETB-friction].
    "metal": _material((5000, 2700, 7850), (0.40, 0.20, 0.60), (0.15, 0.02, 0.50), (0.001, 0.0002, 0.003)),
    # PP 890, ABS 1050, PET 1400 kg/m3 [Ashby]; plastic on wood 0.25-0.5 [CRC].
    "plastic": _material((1000, 890, 1400), (0.35, 0.20, 0.50), (0.25, 0.05, 0.55), (0.002, 0.0005, 0.004)),
    # Corrugated board 150-250 as a whole, solid board 690, paper 700-1150 kg/m3 [ETB-solids]; paper on wood 0.3-0.6.
    "paper": _material((750, 500, 1150), (0.45, 0.30, 0.60), (0.10, 0.02, 0.30), (0.003, 0.0005, 0.005)),
    # Foam 25-60 [Ashby], fiber fill and cloth over a frame: as a whole; cloth on wood 0.4-0.7 [ETB-friction].
    "fabric": _material((150, 40, 350), (0.55, 0.35, 0.80), (0.05, 0.00, 0.20), (0.020, 0.010, 0.040)),
    # Sandstone 2300, granite 2650, marble 2700 kg/m3 [ETB-solids]; stone on wood 0.4 [ETB-friction].
    "stone": _material((2650, 2200, 2900), (0.45, 0.30, 0.65), (0.15, 0.02, 0.50), (0.020, 0.010, 0.030)),
    # Apples 800-900, citrus fruit 950, potatoes 1080 kg/m3 [ETB-solids]; friction as of wet wood.
    "food": _material((950, 750, 1100), (0.45, 0.25, 0.65), (0.15, 0.02, 0.40), (0.010, 0.005, 0.020)),
    # Household things as a whole: from cloth and board to ceramic.
    "unknown": _material((800, 150, 2500), (0.40, 0.20, 0.65), (0.15, 0.02, 0.55), (0.005, 0.001, 0.015)),
}

_BY_LABEL = {
    "wood": "table desk shelf bookshelf bookcase cabinet drawer dresser nightstand bench stool door crate tray rack "
    "picture painting frame board furniture bed wardrobe chair cube block",
    "ceramic": "mug cup bowl plate vase pot saucer teapot planter",
    "glass": "glass jar window mirror wineglass",
    "metal": "can tin pan kettle moka drill tool lamp knife fork spoon sink fridge oven microwave heater",
    "plastic": "bottle bin basket toy pitcher keyboard mouse phone remote monitor tv container bucket dish_rack",
    "paper": "box carton book magazine paper notebook package milk",
    "fabric": "sofa couch cushion pillow armchair curtain towel blanket carpet rug bag cloth mattress",
    "food": "fruit apple orange lemon banana bread food vegetable",
    "stone": "stone rock sculpture statue trophy",
}
_HOLLOW = (
    "shelf bookshelf bookcase cabinet drawer dresser nightstand wardrobe fridge oven microwave can tin bottle carton "
    "box milk package lamp monitor tv container bin kettle moka pot pitcher jar"
)
# Density of packages with their contents, kg/m3: the mean, and that of heavy contents (syrup, sand-like goods; a box of
# books). The lower end of the range is the empty package.
_FILLED = {
    "can": (950.0, 1250.0),
    "tin": (950.0, 1250.0),
    "bottle": (950.0, 1150.0),
    "carton": (950.0, 1100.0),
    "milk": (1000.0, 1050.0),
    "jar": (950.0, 1300.0),
    "package": (450.0, 900.0),
    "box": (450.0, 900.0),
}


@dataclass(frozen=True)
class MaterialChoice:
    """The assumed material of an object, and how it fills the object's shape."""

    name: str
    hollow: bool  # closed and empty: the walls alone have mass
    filled_kg_m3: tuple[float, float] | None  # mean and largest density with contents; None: no package
    reason: str  # provenance
    sure: bool = True  # False: guessed by color or size, with the ranges of any household object
    mass_kg: tuple[float, float] | None = None  # estimated range; None: computed from the shape

    @property
    def material(self) -> Material:
        """The material; a guess has ranges that include those of an unknown one."""
        own, other = MATERIALS[self.name], MATERIALS["unknown"]
        if self.sure:
            return own
        return Material(
            own.density_kg_m3.widened(other.density_kg_m3),
            own.friction.widened(other.friction),
            own.restitution.widened(other.restitution),
            own.wall_m,
        )


def choose_material(
    label: str, label_confidence: float, mean_rgb: np.ndarray, extents_m: np.ndarray
) -> MaterialChoice:
    """Choose a material by label, else by color and size.

    Args:
        label: words separated by spaces or underscores.
        label_confidence: in [0, 1]; below 0.25 the label is ignored.
        mean_rgb: mean color (3,), 0 to 255.
        extents_m: size of the upright box (3,).
    """
    words = label.lower().replace("_", " ").split()
    joined = {label.lower().replace(" ", "_"), *words}
    largest = float(np.max(extents_m))
    if label_confidence >= 0.25:
        # The last word names the object ("milk carton", "sauce bottle").
        for word in [*joined.intersection(["dish_rack"]), *reversed(words)]:
            for name, members in _BY_LABEL.items():
                if word in members.split():
                    filled = _FILLED.get(word) if largest <= 0.5 else None
                    return MaterialChoice(name, word in _HOLLOW.split(), filled, f"label '{label}'")
    red, green, blue = (float(x) for x in mean_rgb)
    brown = red > green > blue and 25 < red - blue < 140 and red < 220
    if largest > 0.5:
        reason = "size of furniture" + (", brown" if brown else "")
        return MaterialChoice("wood", True, None, reason, sure=False)
    if brown:
        return MaterialChoice("wood", False, None, "brown color", sure=False)
    return MaterialChoice("unknown", False, None, "nothing known of it")
