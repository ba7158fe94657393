"""Physical attributes: what a thing is made of, what it weighs, how it slides and bounces, and how sure that is."""
