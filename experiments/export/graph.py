"""What exports share: torchvision where its compiled part is missing, random weights, a graph written and checked."""

import dataclasses
import importlib.util
import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch

from jsecon.files import atomic_write
from jsecon.networks.session import Graph

OPSET = 17
_DECLARED: list = []


def declare_missing_operators() -> None:
    """Lets torchvision be imported where its compiled operators are missing (there is no build of it for a plain CPU).

    They are declared, not made: what is exported here calls none of them.
    """
    try:
        import torchvision  # noqa: F401
    except RuntimeError:
        spec = importlib.util.find_spec("torchvision")
        text = (Path(str(spec and spec.origin)).parent / "_meta_registrations.py").read_text()
        library = torch.library.Library("torchvision", "DEF")
        for name in sorted(set(re.findall(r"torchvision::(\w+)", text))):
            library.define(f"{name}(Tensor none) -> Tensor")
        _DECLARED.append(library)  # a library that is collected takes its operators with it


def shake(model: torch.nn.Module, seed: int) -> None:
    """Random numbers in place of the constants (0, 1, 1e-6) that layers start from, so that none hides a mistake.

    A norm's gain is drawn about 1, everything else that is constant about 0, with deviation 0.1.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.numel() > 1 and float(parameter.std()) < 1e-9:
                around = 1.0 if float(parameter.flatten()[0]) == 1.0 else 0.0
                parameter.copy_(around + 0.1 * torch.randn(parameter.shape, generator=generator))


STRETCH = 30.0
"""of random mask logits, which an untrained decoder keeps near 0"""


class Wrapped(torch.nn.Module):
    """A part of a model, as a module of its own for the tracer."""

    def __init__(self, model: torch.nn.Module):
        super().__init__()
        self.model = model


@dataclasses.dataclass(frozen=True)
class Agreement:
    """How far ONNX Runtime is from PyTorch on one graph."""

    graph: str
    outputs: dict[str, float]
    """name -> largest absolute difference."""
    scales: dict[str, float]
    """name -> largest absolute value in PyTorch."""
    same_signs: dict[str, float]
    """name -> share of the numbers of the same sign: of a mask's logits, the share of equal pixels."""
    megabytes: float


def write_graph(
    path: Path,
    module: torch.nn.Module,
    inputs: Mapping[str, torch.Tensor],
    outputs: list[str],
    *,
    free: Mapping[str, Mapping[int, str]] | None = None,
    other: Mapping[str, torch.Tensor] | None = None,
    reference: Callable[[Mapping[str, torch.Tensor]], list[torch.Tensor]] | None = None,
) -> Agreement:
    """Writes `module` as an ONNX file and compares what it gives with PyTorch.

    `inputs` are traced; `other` inputs (default: the same), of other sizes along the axes that `free` names, are what
    is compared. `reference` (default: the module) computes the official outputs.
    """
    module.eval().requires_grad_(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    with torch.inference_mode(), warnings.catch_warnings(), atomic_write(path) as temporary:
        warnings.simplefilter("ignore")  # of the tracer: sizes are fixed but where `free` says so
        torch.onnx.export(
            module,
            tuple(inputs.values()),
            str(temporary),
            input_names=list(inputs),
            output_names=outputs,
            dynamic_axes={name: dict(axes) for name, axes in (free or {}).items()},
            opset_version=OPSET,
            dynamo=False,
        )
    given = other or inputs
    with torch.inference_mode():
        wanted = reference(given) if reference is not None else module(*given.values())
    wanted = [wanted] if isinstance(wanted, torch.Tensor) else list(wanted)
    found = Graph(path).run({name: tensor.numpy() for name, tensor in given.items()}, outputs)
    return Agreement(
        path.name,
        {name: _largest(found[name] - tensor.numpy()) for name, tensor in zip(outputs, wanted, strict=True)},
        {name: _largest(tensor.numpy()) for name, tensor in zip(outputs, wanted, strict=True)},
        {n: float(((found[n] > 0) == (t.numpy() > 0)).mean()) for n, t in zip(outputs, wanted, strict=True)},
        path.stat().st_size / 1e6,
    )


def _largest(array: np.ndarray) -> float:
    return float(np.abs(array).max(initial=0.0))
