"""What the command line says of answers."""

import json

import numpy as np
from small_field import make_field

from jsecon.app.ask import Answer
from jsecon.app.outputs import write_answers
from jsecon.pipeline.progress import Listener
from jsecon.query.select import query_region


class Told(Listener):
    def __init__(self):
        self.lines = []

    def say(self, text):
        self.lines.append(text)


def test_an_answer_without_a_region_says_so_and_one_without_gaussians_differs(scene, cameras, tmp_path):
    field, _ = make_field(scene, cameras)
    nothing = np.zeros(field.gaussians.count, bool)
    none = Answer("unicorn", "votes", query_region(field, -1), nothing, {})
    empty = Answer("faint", "votes", query_region(field, 1, similarity_threshold=2.0), nothing, {})
    told = Told()
    write_answers(field, [none, empty], tmp_path, told, views=1)
    first, second, pictures = told.lines
    assert first.startswith("'unicorn': 0 of 64 Gaussians")
    assert first.endswith("no region matches it, no Gaussian is selected")
    assert second.endswith("region 1, no Gaussian is selected")
    assert pictures.endswith("answers.html")
    assert "no region matches it" in (tmp_path / "answers.html").read_text()
    written = [json.loads(file.read_text()) for file in sorted(tmp_path.rglob("*.json"))]
    assert sorted((w["query"], w["region"]) for w in written) == [("faint", 1), ("unicorn", None)]
