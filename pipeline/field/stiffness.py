"""How fast a fixture's force changes with place, as a field gives it, and why.

With q the depth, n its direction of rise and H the Hessian of q, the force ``-f_max f(q) n`` has
the derivative ``-f_max (f'(q) n n^T + f(q) H)``. One of H's own values is 0, along n; the others
are the curvatures of the level surface of q, ``1 / r`` each, r the distance to where its normals
meet. So one rate is along the force, ``f_max f'(q)``, and two are across it, ``f_max f(q) / r``.

Where the level surface bulges away from the fixture's surface its normals meet at r >= q, and as
f(q) / q is the mean slope of f up to q, the rates across are no larger than the largest slope: a
spring that can be rendered along the force can be rendered in all directions. Where it is hollow, r
is negative and shrinks to 0 towards the medial axis: there the force drives apart, the faster the
nearer, which no law of this form avoids. A field limits it by its spacing, see
``certificate.rate_bound_n_per_mm``.
"""

from __future__ import annotations

import numpy as np

from pipeline.field.reader import ForceField
from pipeline.geometry import Float

STEP_MM = 0.1
"""Over which a field's force is compared, centred on the place."""


def field_rates_n_per_m(field: ForceField, points_mm: Float, phases: Float, name: str) -> Float:
    """Rates of a field's force in its three principal directions.

    Parameters
    ----------
    field
        Any field.
    points_mm
        ``(n, 3)`` in its frame.
    phases
        ``(n,)`` or one for all.
    name
        The fixture.

    Returns
    -------
    ``(n, 3)`` rising, N/m, own values of the symmetric part of the derivative, taken by central
    differences: positive holds, as a spring does; negative drives apart.
    """
    derivative = np.empty((len(points_mm), 3, 3))
    for axis, step_mm in enumerate(STEP_MM / 2 * np.eye(3)):
        ahead_n = field.force_n(points_mm + step_mm, phases, name)
        behind_n = field.force_n(points_mm - step_mm, phases, name)
        derivative[:, :, axis] = (ahead_n - behind_n) / STEP_MM
    stiffness_n_per_m = -1000 * (derivative + derivative.transpose(0, 2, 1)) / 2
    return np.asarray(np.linalg.eigvalsh(stiffness_n_per_m), dtype=np.float64)
