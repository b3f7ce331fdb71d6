"""Count the modules that one scan enters on its way through `process`, and the returns between packages.

    python tools/count_journey.py

A return is a pair (calling module, called module) whose called package stands above the caller's, or beside
it: stages are beside each other. Nothing is counted of imports.
"""

from __future__ import annotations

import sys
from types import FrameType

from scan2albedo.pipeline.process import process
from scan2albedo.synthetic import raw_scan

FLOORS = ("core", "optimization", "geometry", "io", "lighting", "face_model", "templates", "stage")
FLOORS += ("rendering", "applications", "report", "pipeline")
STAGES = ("registration", "fitting", "sampling", "albedo")


def main() -> None:
    modules, returns = set[str](), set[tuple[str, str]]()

    def package(name: str) -> str:
        return name.split(".")[1] if name.count(".") else "core"

    def floor(name: str) -> int:
        own = package(name)
        return FLOORS.index("stage" if own in STAGES else own) if own in (*FLOORS, *STAGES) else -1

    def entered(frame: FrameType, event: str, _: object) -> None:
        name, caller = frame.f_globals.get("__name__", ""), frame.f_back
        if event != "call" or not name.startswith("scan2albedo.") or frame.f_code.co_name == "<module>":
            return
        modules.add(name)
        above = caller.f_globals.get("__name__", "") if caller is not None else ""
        if (
            above.startswith("scan2albedo.")
            and package(above) != package(name)
            and floor(name) >= floor(above)
        ):
            returns.add((above, name))

    scan, _ = raw_scan(0)
    sys.setprofile(entered)
    process(scan, quality="draft")
    sys.setprofile(None)
    between = {pair for pair in returns if {package(name) for name in pair} <= set(STAGES)}
    print(
        f"{len(modules)} modules entered, {len(returns)} returns between packages, {len(between)} of stages"
    )
    for pair in sorted(returns):
        print("  {} -> {}".format(*pair))


if __name__ == "__main__":
    main()
