"""All entries of the suite; each is in it once its module has been imported."""

from __future__ import annotations

from benchmarks import entries_cost, entries_error
from benchmarks.suite import ENTRIES

MODULES = (entries_cost, entries_error)
__all__ = ["ENTRIES", "MODULES"]
