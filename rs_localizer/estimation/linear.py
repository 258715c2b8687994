"""Other typical speeds, as the linearized points of the best motion foresee them.

Where points tell the motion well, slower ones and rest are so near that a fit of their own, and
what it leaves of the points, would be the same to second order: of their errors a small part.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.columns import Columns, with_prior
from rs_localizer.estimation.evidence import Sizes
from rs_localizer.estimation.model_error import Examined, judged
from rs_localizer.estimation.prior_terms import PriorTerms
from rs_localizer.estimation.refine import apply_step, solve_positive
from rs_localizer.estimation.spectrum import Powers

# Errors of second order, as parts of the noise, that are small; and beyond which a fit had better
# not start where the linearized points lead.
_SMALL, _LARGE = 0.02, 1.0


@kernel
def foreseen(
    state: Array, columns: Columns, given: Array, terms: PriorTerms, freedom: float, noise: float,
    shake_sizes: Array, shake_prior: Array, field_sizes: Array, field_prior: Array,
    focal_length: float, depth: float,
) -> tuple[bool, Array, float, Examined]:  # fmt: skip
    """Whether the best motion under another prior is near, its state, cost (px^2), and the rest.

    Where it is not, the state is one to start a fit from, and the rest nothing.

    Args:
        state: (24,) at which the points are linearized.
        columns: of motion, shaking and field there, without a prior.
        given: (24,) where a fit would start that knows of no linearized points.
        terms: the other prior.
        freedom, noise, ...: see :func:`rs_localizer.estimation.model_error.examine`.
        focal_length: px.
        depth: m, of the points.
    """
    still, back = _still(state, columns)
    start = apply_step(state, back)
    known = with_prior(still, terms, start, noise)
    motion = known.products[:PARAMETERS, :PARAMETERS]
    step, solved = solve_positive(motion, known.with_errors[:PARAMETERS])
    reach = 0.0 if solved else np.inf
    for part in range(6):
        square = 0.0
        for k in range(3 * part, 3 * part + 3):
            square += (back[k] + step[k]) ** 2
        # Over half a readout; turns and moves take turns.
        weight = 1.0 / (1.0, 2.0, 8.0)[part // 2]
        reach += weight * np.sqrt(square) / (depth if part % 2 == 1 else 1.0)
    second = 0.5 * focal_length * reach * reach / noise
    if not second < _SMALL:
        nothing = Sizes(0.0, 0.0, noise, 1.0, 1.0, 0.0, shake_sizes, field_sizes)
        no_tones = Powers(0.0, np.zeros((0, 0)))
        return False, apply_step(start, step) if second < _LARGE else given, 0.0, Examined(
            step, still.products, nothing, 0.0, 0.0, no_tones, 0.0, 0.0, False, still
        )  # fmt: skip
    examined = judged(
        still, terms, start, freedom, noise, shake_sizes, shake_prior, field_sizes, field_prior
    )
    return True, apply_step(start, examined.step), examined.cost, examined


@inlined
def _still(state: Array, columns: Columns) -> tuple[Columns, Array]:
    """Columns of motion and field told from a camera at rest, and the step (18,) there.

    There priors of the motion have their means, which they may hold it to.
    """
    back = np.zeros(PARAMETERS)
    for k in range(6, PARAMETERS):
        back[k] = -state[6 + k]
    shake = columns.shake
    size = len(columns.with_errors) - shake
    products, with_errors = np.empty((size, size)), np.empty(size)
    squared = columns.squared_errors
    for i in range(size):
        row = columns.products[i if i < PARAMETERS else i + shake]
        moved = 0.0
        for k in range(PARAMETERS):
            moved += row[k] * back[k]
        for k in range(PARAMETERS):
            products[i, k] = row[k]
        for k in range(PARAMETERS, size):
            products[i, k] = row[k + shake]
        before = columns.with_errors[i if i < PARAMETERS else i + shake]
        with_errors[i] = before - moved
        if i < PARAMETERS:
            squared += back[i] * (moved - 2.0 * before)
    return Columns(products, with_errors, squared, 0), back
