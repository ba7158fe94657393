"""Materials: density, friction and restitution, and which one a thing is probably made of.

Sources. Densities: The Engineering ToolBox, "Densities of Solids" and "Wood Species - Densities"; Ashby, "Materials
Selection in Mechanical Design" (5th ed.), appendix A. Friction: static coefficients against wood or the like from The
Engineering ToolBox, "Friction - Friction Coefficients and Calculator", and CRC Handbook of Chemistry and Physics,
"Coefficients of Friction"; where a range is given, its middle. Restitution: Cross, "The bounce of a ball" (Am. J.
Phys. 67, 1999) and Bharadwaj et al., Coefficient-of-restitution measurements; household contacts lose most of the
energy, so that values are at the low end.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Material:
    """Properties of solid matter."""

    density_kg_m3: float
    friction: float  # against a typical household surface, dimensionless
    restitution: float
    wall_m: float  # typical wall thickness of hollow things made of it


MATERIALS = {
    # Oak 700, pine 500, particle board 650-700 kg/m3 (ToolBox); wood on wood 0.25-0.5.
    "wood": Material(650.0, 0.45, 0.20, 0.015),
    # Stoneware 2300-2500 kg/m3 (Ashby); glazed on wood about 0.4.
    "ceramic": Material(2350.0, 0.40, 0.15, 0.004),
    # Soda-lime glass 2500 kg/m3 (Ashby); glass on wood 0.3-0.4.
    "glass": Material(2500.0, 0.35, 0.20, 0.003),
    # Steel 7850, aluminium 2700 kg/m3 (ToolBox); household goods mix both; metal on wood 0.2-0.6.
    "metal": Material(5000.0, 0.40, 0.15, 0.001),
    # PP 905, ABS 1050, PET 1380 kg/m3 (Ashby); plastic on wood 0.3-0.4.
    "plastic": Material(1000.0, 0.35, 0.25, 0.002),
    # Paper 700-1150, board 690 kg/m3 (ToolBox); paper on wood about 0.4-0.5.
    "paper": Material(750.0, 0.45, 0.10, 0.003),
    # Upholstery: foam 30-60, fibre fill and cloth over a frame: 150 kg/m3 as a whole; cloth on wood 0.4-0.6.
    "fabric": Material(150.0, 0.55, 0.05, 0.020),
    # Granite 2650, marble 2700 kg/m3 (ToolBox); stone on wood about 0.4.
    "stone": Material(2650.0, 0.45, 0.15, 0.020),
    # Mostly water: fruit 850-1050 kg/m3, packed dry food less; fruit on wood about 0.4.
    "food": Material(950.0, 0.45, 0.15, 0.010),
    # Household things as a whole: between plastic and wood.
    "unknown": Material(800.0, 0.40, 0.15, 0.005),
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
_HOLLOW = frozenset(
    [
        "shelf",
        "bookshelf",
        "bookcase",
        "cabinet",
        "drawer",
        "dresser",
        "nightstand",
        "wardrobe",
        "fridge",
        "oven",
        "microwave",
        "can",
        "tin",
        "bottle",
        "carton",
        "box",
        "milk",
        "package",
        "lamp",
        "monitor",
        "tv",
        "container",
        "bin",
        "kettle",
        "moka",
        "pot",
        "pitcher",
        "jar",
    ]
)
# What packages hold weighs as much as the package is large: their mean density with contents, kg/m3.
_FILLED = {
    "can": 950.0,
    "tin": 950.0,
    "bottle": 950.0,
    "carton": 950.0,
    "milk": 1000.0,
    "jar": 1000.0,
    "package": 450.0,
}


@dataclass(frozen=True)
class MaterialChoice:
    """What a thing is taken to be made of, and how it fills its outline."""

    name: str
    hollow: bool  # closed outside but empty inside: mass from walls only
    filled_density_kg_m3: float  # mean density of a package with its contents, 0 where it is no package
    reason: str  # provenance


def choose_material(
    label: str, label_confidence: float, mean_rgb: np.ndarray, extents_m: np.ndarray
) -> MaterialChoice:
    """Choose a material by label, else by color and size.

    Args:
        label: Coarse label, words separated by spaces or underscores.
        label_confidence: In [0, 1]; below 0.25 the label is not believed.
        mean_rgb: Mean color (3,), 0 to 255.
        extents_m: Size of the upright box (3,).

    Returns:
        The choice with its reason.
    """
    words = label.lower().replace("_", " ").split()
    joined = {label.lower().replace(" ", "_"), *words}
    if label_confidence >= 0.25:
        # The last word names the thing ("milk carton", "sauce bottle").
        for word in [*joined.intersection(["dish_rack"]), *reversed(words)]:
            for name, members in _BY_LABEL.items():
                if word in members.split():
                    hollow = word in _HOLLOW
                    large = float(np.max(extents_m)) > 0.5
                    filled = 0.0 if large else _FILLED.get(word, 450.0 if word == "box" else 0.0)
                    return MaterialChoice(name, hollow, filled, f"label '{label}'")
    largest = float(np.max(extents_m))
    red, green, blue = (float(x) for x in mean_rgb)
    brown = red > green > blue and 25 < red - blue < 140 and red < 220
    if largest > 0.5:
        return MaterialChoice("wood", True, 0.0, "size of furniture" + (", brown" if brown else ""))
    if brown:
        return MaterialChoice("wood", False, 0.0, "brown color")
    return MaterialChoice("unknown", False, 0.0, "nothing known of it")
