"""Physical attributes: what a thing is made of, what it weighs, how it slides and bounces, and how sure that is."""

from reconstruction.assets.physics.mass import physical_attributes
from reconstruction.assets.physics.materials import MATERIALS, MaterialChoice, choose_material

__all__ = ("MATERIALS", "MaterialChoice", "choose_material", "physical_attributes")
