"""Render a scene as one HTML page: the results, cost and errors of every stage.

`collect.py` gathers the bundle, the stage results and the truth. `sections.py` builds the sections from the blocks of
`blocks.py`, with images of `pictures.py` and plots of `plots.py`. `page.py` renders them with the template.
"""
