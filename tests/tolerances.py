"""Every tolerance of the tests, by what limits the accuracy."""

import numpy as np

ROUND_OFF = {np.dtype("float64"): 1e-12, np.dtype("float32"): 1e-5}
"""Identities that hold but for rounding: relative, a few operations deep."""

IDENTITY = 1e-12
"""Identities in float64 that hold but for rounding."""

DERIVATIVE = 1e-10
"""Derivatives written by hand against automatic ones: rounding, many operations deep."""

DIFFERENCE = 1e-6
"""Derivatives against central differences, relative."""

QUADRATURE = 1e-10
"""Integrals of smooth functions by Gauss's rule against closed forms, relative."""
