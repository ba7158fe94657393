"""Reconstruct many videos: a list or a folder in, scenes in the registry and a table of results out.

`listing` reads the rows, `plan` decides which of them run, `driver` hands jobs to an `Engine` and writes the `journal`,
`attempt` runs one video in its own process, and `results` and `page` write the tables and the overview page.
"""
