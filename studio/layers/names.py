"""Names above the objects."""

from typing import Any

from studio.layers.base import Layer
from studio.text import bare

_ABOVE_M = 0.07  # above the dots of the relations


class NameLayer(Layer):
    """A label above every object; it moves with the object."""

    label = "Names"
    hint = "The name of every object, above it"

    def build(self) -> list[Any]:
        """Add the labels."""
        labels = []
        for item in self.page.bundle.objects:
            top = self.page.pickable.geometry(item.id).vertices[:, 2].max()
            labels.append(
                self.page.server.scene.add_label(
                    f"/objects/{item.id}/name",
                    bare(self.page.name_of(item.id), 60),
                    position=(0, 0, top + _ABOVE_M),
                    anchor="bottom-center",
                    font_screen_scale=0.85,
                )
            )
        return labels
