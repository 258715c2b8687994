"""Which hypotheses of a block are worth a closer look, and the closer look."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.blocks import write
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.simd.tracing import LANES
from rs_localizer.core.state import STATE_SIZE
from rs_localizer.estimation.prior_terms import PriorTerms, held_terms
from rs_localizer.estimation.refine import anneal, refine
from rs_localizer.estimation.residuals import truncated_cost
from rs_localizer.estimation.view import POINT_SIZE

# Of local optimisation, at the last scale.
_ITERATIONS = 3
# Steps of a descent: at its first scale, where it has far to go, and at each of the others.
_FIRST_STEPS, _STEPS, _RATIO = 20, 3, 0.6
# Gain, in noise variances, below which another step is not worth its time.
_TOLERANCE = 1.0


@kernel
def state_of_model(model: Array) -> Array:
    """State (model B) of a solver's model A (18,): ``omega = -w``, ``v = w x C - t``."""
    state = np.zeros(STATE_SIZE)
    for k in range(12):
        state[k] = model[k]
    c, w, t = model[9:12], model[12:15], model[15:18]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        state[12 + i] = -w[i]
        state[15 + i] = w[j] * c[k] - w[k] * c[j] - t[i]
    return state


@kernel
def best_models(
    models: Array, data: Array, gradient: Array, scale: float, keep: int, bar: float
) -> tuple[Array, Array]:
    """States (keep,24) and costs (keep,) of the models (k,18,h) with the least truncated error.

    A model is left as soon as its cost exceeds that of the worst kept one, or ``bar``. Places that
    no model takes have infinite cost.
    """
    states = np.zeros((keep, STATE_SIZE))
    costs = np.empty(keep)
    costs[:] = np.inf
    solutions, _, count = models.shape
    for h in range(count):
        for s in range(solutions):
            if np.isnan(models[s, 0, h]):
                continue
            state = state_of_model(models[s, :, h])
            limit = min(costs[keep - 1], bar)
            cost = truncated_cost(data, state, gradient, scale, limit)
            if cost < limit:
                place = keep - 1
                while place > 0 and cost < costs[place - 1]:
                    costs[place] = costs[place - 1]
                    write(states[place], states[place - 1])
                    place -= 1
                costs[place] = cost
                write(states[place], state)
    return states, costs


@kernel
def optimize(
    states: Array,
    costs: Array,
    data: Array,
    gradient: Array,
    first_scale: float,
    last_scale: float,
    prior: PriorTerms,
    noise: float,
) -> tuple[Array, float]:
    """Local optimisation of the states with finite cost; the best state and its truncated cost.

    Each is refined on all points under Tukey's loss while its scale falls from the first to the
    last; the truncated cost is that of the last scale.
    """
    best = np.zeros(STATE_SIZE)
    best_cost = np.inf
    for i in range(len(states)):
        if not np.isfinite(costs[i]):
            continue
        state = anneal(data, states[i], gradient, first_scale, last_scale, prior, noise)
        state, _, _, _ = refine(
            data, state, gradient, last_scale, 1.0, prior, noise, 1, _ITERATIONS, _TOLERANCE
        )
        cost = truncated_cost(data, state, gradient, last_scale, best_cost)
        if cost < best_cost:
            best, best_cost = state, cost
    return best, best_cost


@kernel
def descend(
    data: Array,
    start: Array,
    gradient: Array,
    first_scale: float,
    last_scale: float,
    prior: PriorTerms,
    noise: float,
) -> tuple[Array, float]:
    """As :func:`optimize`, of one state, with steps that are tried before they are taken.

    It takes ten times as long and comes through where pose and motion are hard to tell apart.
    """
    state, scale, iterations = start, first_scale, _FIRST_STEPS
    while scale > last_scale:
        state, _, _, _ = refine(
            data, state, gradient, scale, 1.0, prior, noise, 1, iterations, _TOLERANCE
        )
        scale, iterations = _RATIO * scale, _STEPS
    state, _, _, _ = refine(
        data, state, gradient, last_scale, 1.0, prior, noise, 1, _FIRST_STEPS, _TOLERANCE
    )
    return state, truncated_cost(data, state, gradient, last_scale, np.inf)


def warm_up() -> None:
    """Compile what a plane comes to that faces the camera."""
    nothing = np.zeros((0, POINT_SIZE * LANES))
    descend(nothing, np.zeros(STATE_SIZE), np.zeros(2), 1.0, 1.0, held_terms(), 1.0)
