"""What an experiment leaves behind: whole files, and nothing of the machine that made them; the page that names all
experiments; and the verdicts of the export (the export itself needs torch, and is no part of CI)."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from experiments import results


@dataclasses.dataclass(frozen=True)
class Data:
    root: str = str(results.CAPTURES / "apc_bin")
    sizes: tuple = (("views", 8), ("place", "/somewhere/else/demos"))


@dataclasses.dataclass(frozen=True)
class Options:
    data: Data = Data()
    out: Path = results.HOME / "results" / "x"
    home: str = str(Path.home() / "datasets" / "lerf")
    relative: str = "models"
    steps: int | None = None


def test_config_names_no_place_of_this_machine(tmp_path):
    results.save(tmp_path, Options(), {"miou": 0.5}, "| a |")
    config = json.loads((tmp_path / "config.json").read_text())
    assert config == {
        "data": {"root": "../shared/captures/apc_bin", "sizes": [["views", 8], ["place", ".../demos"]]},
        "out": "experiments/results/x",
        "home": "~/datasets/lerf",
        "relative": "models",
        "steps": None,
    }
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"miou": 0.5}
    assert (tmp_path / "table.md").read_text() == "| a |\n"


@pytest.mark.parametrize("file", sorted((results.HOME / "results").glob("*/config.json")), ids=lambda f: f.parent.name)
def test_committed_configs_are_portable(file):
    config = json.loads(file.read_text())
    assert results.portable(config) == config
    assert "../.." not in file.read_text()


EXPERIMENTS = Path(__file__).parent.parent.parent / "experiments"
TEXT = (EXPERIMENTS / "README.md").read_text()
SHARED = {"cells", "memory_maps", "results"}
"""modules at the root that are no experiments"""


def test_the_readme_names_every_experiment_and_no_other():
    runnable = {path.stem for path in EXPERIMENTS.glob("*.py")} - SHARED
    runnable |= {path.parent.name for path in EXPERIMENTS.glob("*/__main__.py")}
    assert set(re.findall(r"python -m experiments\.(\w+)", TEXT)) == runnable
