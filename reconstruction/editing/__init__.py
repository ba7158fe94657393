"""The user's corrections (`--overrides FILE`): read, addressed to objects, applied to results of stages."""
