"""The verbs of the `simrecon` command, one module each; nothing heavy is imported before a verb is chosen."""
