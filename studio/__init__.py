"""The studio: a scene of the registry in a web page, to look at, correct and play; served by viser.

`scene_view.StudioPage` is one served scene; parts (`parts.Part`) add tabs to it. `server` puts pages and the gallery of
the registry behind one address. `simrecon studio` runs `command.run`. No other package imports this one.
"""
