"""The last step: a finished run -> a scene bundle in the registry."""

from reconstruction.publish.write import publish_scene

__all__ = ["publish_scene"]
