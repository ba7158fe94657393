"""Labels that programs rely on."""

STRUCTURE = "structure"
"""Of the static body of all measured surface that is of no object and on no plane of the room."""
