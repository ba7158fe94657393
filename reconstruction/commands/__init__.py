"""Verbs of the `simrecon` command, one module each; heavy modules are imported when the verb runs."""
