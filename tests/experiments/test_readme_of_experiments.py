"""experiments/README.md has short table cells, and names each experiment and no other."""

import re
from pathlib import Path

EXPERIMENTS = Path(__file__).parent.parent.parent / "experiments"
TEXT = (EXPERIMENTS / "README.md").read_text()
SHARED = {"cells", "results"}
"""modules at the root that are no experiments"""


def test_it_names_every_experiment_and_no_other():
    runnable = {path.stem for path in EXPERIMENTS.glob("*.py")} - SHARED
    runnable |= {path.parent.name for path in EXPERIMENTS.glob("*/__main__.py")}
    assert set(re.findall(r"python -m experiments\.(\w+)", TEXT)) == runnable
