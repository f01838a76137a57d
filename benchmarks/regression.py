"""Whether the scenes have become slower, by ratios that hold on other machines.

    python -m benchmarks.regression [--factor 1.5] [--update]

Each scene at one batch in float32, relative to MuJoCo in C in the same run where it is installed,
and to the elementwise peak of the machine: world-steps for each million operations at the peak.
`regression.json` holds the ratios as they were; `--update` rewrites it.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from benchmarks import peers, roofline, targets, throughput, timing
from benchmarks.accuracy import has_mujoco

FILE = Path(__file__).with_suffix(".json")
BATCH = 1024
Ratios = dict[str, dict[str, float]]


def ratios(scenes: list[str], solver: str = "Sparse") -> Ratios:
    """Over MuJoCo and over the peak, by scene."""
    found: Ratios = {}
    for name in scenes:
        method = throughput.method_of(name, solver)
        rate = throughput.run_batch(name, method, np.float32, BATCH, repeats=3)[0].median
        found[name] = {"over_peak": rate / (roofline.peak() / 1e6)}
        if has_mujoco():
            found[name]["over_mujoco"] = rate / peers.mujoco_rate(name, seconds=0.2).median
    return found


def slower(before: Ratios, now: Ratios, factor: float) -> list[str]:
    """What fell by more than the factor, in words; over MuJoCo where both runs have it."""
    said = []
    for name, found in now.items():
        known = before.get(name, {})
        measures = [m for m in ("over_mujoco", "over_peak") if m in known and m in found][:1]
        for measure in measures:
            old, new = known[measure], found[measure]
            if new * factor < old:
                said.append(f"{name}: {measure} fell from {old:.3g} to {new:.3g}")
    return said


def main() -> None:
    """Prints what became slower and exits with 1, or says that nothing did."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=list(targets.SCENES))
    parser.add_argument("--factor", type=float, default=1.5, help="by which a ratio may fall")
    parser.add_argument("--update", action="store_true", help="rewrite the file")
    options = parser.parse_args()
    timing.use_all_cores()
    stored = json.loads(FILE.read_text()) if FILE.exists() else {"ratios": {}}
    before, now = stored["ratios"], ratios(options.scenes)
    print("| scene | over MuJoCo | before | over the peak | before |\n|---|---|---|---|---|")
    for name in now:
        cells = [
            f"{source.get(name, {}).get(measure, float('nan')):.3g}"
            for measure in ("over_mujoco", "over_peak")
            for source in (now, before)
        ]
        print(f"| {name} | " + " | ".join(cells) + " |")
    if options.update:
        result = {"machine": timing.machine(), "batch": BATCH, "ratios": before | now}
        FILE.write_text(json.dumps(result, indent=1) + "\n")
        print(f"wrote {FILE.name}")
        return
    cores = stored.get("machine", {}).get("cores")
    if cores != timing.cores():
        print(f"the ratios before are of {cores} cores, these of {timing.cores()}")
    fallen = slower(before, now, options.factor)
    print("\n".join(fallen) or f"nothing fell by more than {options.factor:g}")
    sys.exit(bool(fallen))


if __name__ == "__main__":
    main()
