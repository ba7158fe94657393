"""Compiled Adam step (Kingma and Ba 2015)."""

import math

import numba


@numba.njit(cache=True, nogil=True)
def adam_rows(
    start, stop, parameters, gradients, first, second, visits, rows, rates, beta1, beta2, epsilon
):  # pragma: no cover - compiled
    """Take one Adam step on rows[start:stop]; bias correction uses each row's number of visits."""
    for k in range(start, stop):
        i = rows[k]
        visits[i] += 1
        correct1 = 1.0 / (1.0 - beta1 ** visits[i])
        correct2 = 1.0 / (1.0 - beta2 ** visits[i])
        for c in range(parameters.shape[1]):
            g = float(gradients[i, c])
            a = beta1 * first[i, c] + (1.0 - beta1) * g
            b = beta2 * second[i, c] + (1.0 - beta2) * g * g
            first[i, c], second[i, c] = a, b
            parameters[i, c] -= rates[c] * a * correct1 / (math.sqrt(b * correct2) + epsilon)
