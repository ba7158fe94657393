"""Training data and training of the networks that ship in `reconstruction/`; not part of the wheel.

`python -m priors.dataset` films generated rooms and keeps what the pipeline measures in them beside the truth;
`python -m priors.train` trains, `python -m priors.evaluate` compares on held-out families.
"""
