"""The report of a scene: one HTML page that shows what every stage made, what it cost, and where it is wrong.

`collect.py` gathers the bundle, the stage results and the truth; `pictures.py` and `plots.py` draw; `sections.py` says
what the page holds, in the blocks of `blocks.py`; `page.py` renders them with the template beside it.
"""
