"""Checks the figures of the documentation: `python docs/check_figures.py`.

`docs/figures.csv` has one row for each figure, however often it stands: the figure as printed (several between "; "),
its pages, kind and source. "result": an expression over `experiments/results/*/metrics.json`, each under the name of
its folder, with a value for each number. "measured": command and date; the row is the result. "constant": no
measurement. A figure is a number with a unit, with two decimals, or in a table with one. On docs/results only tables
are checked: their rows or cells may instead stand in the table.md of an experiment that the page names.
"""

import csv
import json
import re
import statistics
from itertools import product
from pathlib import Path

CHECKED = ("README.md", "docs/*.md", "docs/tutorials/*.md", "docs/results/*.md")
UNIT = r"\s(?:dB|s|ms|min|minutes|seconds|[kMGT]i?B|mm|cm|%)(?!\w)"
NUMBER = re.compile(rf"(?<![\w.,])(?<!\w[+-])([+-]?\d+(?:,\d{{3}})*(?:\.\d+)?(?:e-?\d+)?)(?!\w|[.,]\d)({UNIT})?")
NO_PROSE = re.compile(
    r"^```.*?^```$|^    [^\n]*$|\$\$.*?\$\$|\$[^$\n]+\$|(?<=\])\([^)\n]*\)|\*", re.MULTILINE | re.DOTALL
)


def prose(text: str) -> str:
    """The lines of a page without code blocks, formulas, targets of links, and digits in code."""
    text = NO_PROSE.sub(lambda match: "\n" * match[0].count("\n"), text)
    return re.sub(r"`[^`\n]*`", lambda match: re.sub(r"\d", "N", match[0]), text)


def numbers(text: str) -> list[str]:
    """All numbers of a text, without units and commas."""
    return [number.replace(",", "") for number, _ in NUMBER.findall(text)]


def places(figure: str, text: str) -> list[re.Match[str]]:
    """Where a figure stands in a text, also across lines."""
    return [*re.finditer(r"(?<![\w.,+-])" + r"\s+".join(map(re.escape, figure.split())) + r"(?!\w|[.,]\d)", text)]


def rounded(value: float, printed: str) -> str:
    """The printed number if it is the value, rounded, else the value with as many decimals."""
    digits, _, exponent = printed.partition("e")
    decimals = len(digits.partition(".")[2])
    new = f"{value:{'+' if printed[0] == '+' else ''}.{decimals}{'e' if exponent else 'f'}}"
    return printed if abs(float(printed) - value) <= 0.500001 * 10 ** (int(exponent or 0) - decimals) else new


def leaves(node: object) -> list[float]:
    """The numbers of a result, in its order."""
    if isinstance(node, (dict, list, tuple)):
        return [value for child in (node.values() if isinstance(node, dict) else node) for value in leaves(child)]
    return [float(node)] if isinstance(node, (int, float)) else []


def cells(line: str) -> list[str]:
    """The cells of a table's line, in the words of the results."""
    return [cell.strip(" `").lower().replace("jsecon", "ours") for cell in line.strip("|").split("|")]


def stands(text: str, labels: list[str], rows: list[tuple[list[str], list[float]]]) -> bool:
    """Whether a row of results under one of the labels has the numbers of a text, in their order."""
    for names, values in rows:
        pairs = [(a, b) for a, b in product(names, labels) if b.islower() and min(len(a), len(b)) > 3]
        rest = iter(values if any(a in b or b in a for a, b in pairs) else ())
        if all(any(number == rounded(value, number) for value in rest) for number in numbers(text)):
            return True
    return False


def faults(root: Path) -> list[str]:
    """A sentence for each figure that differs from its source, has none, or is missing on its page."""
    files = {path.parent.name: path for path in sorted(root.glob("experiments/results/*/metrics.json"))}
    names = {"mean": statistics.fmean} | {name: json.loads(path.read_text()) for name, path in files.items()}
    checked = [str(path.relative_to(root)) for glob in CHECKED for path in sorted(root.glob(glob))]
    table = list(csv.DictReader((root / "docs/figures.csv").read_text().splitlines()))
    texts = {page: (root / page).read_text() for page in [*checked, *" ".join(row["pages"] for row in table).split()]}
    found, wanted = [], []
    for row in table:
        wanted += product(row["pages"].split(), row["figure"].split("; "))
        values = leaves(eval(row["source"], names)) if row["kind"] == "result" else []
        for old, value in zip(numbers(row["figure"]), values, strict=row["kind"] == "result"):
            for page in row["pages"].split() if rounded(value, old) != old else ():
                lines = [str(texts[page].count("\n", 0, at.start()) + 1) for at in places(old, texts[page])]
                found.append(f"{page}:{','.join(lines)}: {old} is {rounded(value, old)} by {row['source']}")
    for page, text in texts.items():
        left, full, title, of_results = prose(text), prose(text), "", page.startswith("docs/results/")
        for figure in sorted({figure for of, figure in wanted if of == page}, key=len, reverse=True):
            if len(places(figure, full)) < wanted.count((page, figure)):
                found.append(f"{page}: {figure} stands there less often than in docs/figures.csv")
            for match in places(figure, left):
                left = left[: match.start()] + re.sub(r"[^\n]", " ", match[0]) + left[match.end() :]
        named = tuple(re.findall(r"experiments[./](?:results/)?(\w+)", text))
        tables = [path.with_name("table.md").read_text() for name, path in files.items() if name.startswith(named)]
        rows = [(cells(line), [*map(float, numbers(line))]) for lines in tables for line in lines.splitlines()]
        for line, (rest, whole) in enumerate(zip(left.splitlines(), full.splitlines()), 1):
            title = (title or whole) if whole.startswith("|") else ""
            alone = [n + u for n, u in NUMBER.findall(rest) if u or "e" in n or len(n.partition(".")[2]) > (not title)]
            if not alone or whole == title or page not in checked or (of_results and not title):
                continue
            label, *values = cells(rest)
            pairs = [pair for pair in zip(cells(title)[1:], values) if any(text.lower() in pair[1] for text in alone)]
            by_cell = pairs and all(stands(value, [label, head, value], rows) for head, value in pairs)
            if not of_results or not (by_cell or stands(" ".join(values), [label, *values], rows)):
                found.append(f"{page}:{line}: no row of docs/figures.csv or of results has {', '.join(alone)}")
    return found


if __name__ == "__main__":
    raise SystemExit("\n".join(faults(Path(__file__).resolve().parent.parent)) or 0)
