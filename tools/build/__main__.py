"""Make a file that ships with the package again, from its sources.

    python tools/build NAME [-o FILE]

`schemas` makes data_schemas/, `lighting_model` and `reflectance_model` the light and the people of
scan2albedo/reflectance/data; `albedo_prior`, `appearance` and `proportions` learn from ../shared/data;
`recognition_calibration` prints the constants of recognition/result_identification.py.
"""

import importlib
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

if __name__ == "__main__":
    names = sorted(file.stem for file in Path(__file__).parent.glob("[a-z]*.py"))
    if len(sys.argv) < 2 or sys.argv[1] not in names:
        sys.exit(f"{(__doc__ or '').strip()}\n\nNAME is one of {', '.join(names)}")
    importlib.import_module(f"build.{sys.argv[1]}").main(sys.argv[2:])
