"""All tolerances of the tests, named by the source of the error."""

import numpy as np

ROUND_OFF = {np.dtype("float64"): 1e-12, np.dtype("float32"): 1e-5}
"""Identities that hold up to rounding: relative, a few operations deep."""

IDENTITY = 1e-12
"""Identities in float64 that hold up to rounding."""

DERIVATIVE = 1e-10
"""Hand-written against automatic derivatives: rounding, many operations deep."""

DIFFERENCE = 1e-6
"""Derivatives against central differences, relative."""

QUADRATURE = 1e-10
"""Integrals of smooth functions by Gauss quadrature against closed forms, relative."""
