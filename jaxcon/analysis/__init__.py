"""Analysis of scenes, methods and gradients.

Reports: report, Report, Finding, diagnose, Diagnosis, find_first_failure, Failure, integrability,
    Integrability.
Gradients: check_gradients, GradientCheck, gradient_growth, GradientGrowth.
Memory: memory, Memory, gradient_memory, GradientMemory.
Comparison of methods: tradeoff, Tradeoff.
"""

from jaxcon.analysis.diagnosis import Diagnosis, diagnose
from jaxcon.analysis.failures import Failure, find_first_failure
from jaxcon.analysis.findings import Finding
from jaxcon.analysis.gradients import GradientCheck, check_gradients
from jaxcon.analysis.growth import GradientGrowth, gradient_growth
from jaxcon.analysis.integrability import Integrability, integrability
from jaxcon.analysis.memory import GradientMemory, Memory, gradient_memory, memory
from jaxcon.analysis.report import Report, report
from jaxcon.analysis.tradeoff import Tradeoff, tradeoff


def __dir__() -> list[str]:
    """Lists the public names of this namespace."""
    return [*__all__]


__all__ = [
    "report",
    "Report",
    "Finding",
    "diagnose",
    "Diagnosis",
    "find_first_failure",
    "Failure",
    "integrability",
    "Integrability",
    "check_gradients",
    "GradientCheck",
    "gradient_growth",
    "GradientGrowth",
    "memory",
    "Memory",
    "gradient_memory",
    "GradientMemory",
    "tradeoff",
    "Tradeoff",
]
