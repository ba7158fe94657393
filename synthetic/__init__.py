"""Rooms of our own making with known truth: procedural furniture, a film crew, and captures for tests.

`room.build_room` furnishes, `film.film_room` films, `capture.make_test_capture` returns both as pipeline
artefacts, `videos` writes video files, sound and broken ones. Nothing here is used when a user's video is
reconstructed.
"""
