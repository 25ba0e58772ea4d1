"""What an experiment leaves behind: whole files, and nothing of the machine that made them."""

import dataclasses
import json
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
