"""The user's corrections (`--overrides FILE`): parsing, addressing of objects, application to the results of stages."""
