"""``edge-server fetch-lpips``: converts the public LPIPS package's weights to the arrays that we read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edge_server.command import command_parser, exit_status
from edge_server.fidelity.lpips_weights import FILES, FOLDER_VARIABLE, open_lpips
from freshfield.files import out_folder

DESCRIPTION = f"""\
Fetch the weights of LPIPS with its authors' package and convert them to the folder that --lpips takes.

  pip install 'freshfield[edge,lpips]'
  edge-server fetch-lpips --out ~/lpips
  export {FOLDER_VARIABLE}=~/lpips            # or --lpips ~/lpips where a command takes it

The package lpips holds the learned channel weights; torchvision fetches AlexNet, trained on ImageNet, from the
network at this command's first call (240 MB).
"""


class FetchError(ValueError):
    """Weights that cannot be fetched or converted; one line says why."""


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    parser = command_parser("edge-server fetch-lpips", DESCRIPTION)
    parser.add_argument("--out", type=out_folder, required=True, metavar="DIR", help="folder to write")
    args = parser.parse_args(argv)
    return exit_status(parser.prog, lambda: print(*convert(*_fetch(), args.out), sep="\n"), FetchError)


def _fetch() -> tuple[dict[str, Any], dict[str, Any]]:
    """State dictionaries of AlexNet's features and of the learned weights."""
    try:
        import lpips
        import torch
        import torchvision
    except ImportError as error:
        raise FetchError(f"needs {error.name}: pip install 'freshfield[edge,lpips]'") from None
    except RuntimeError as error:  # torchvision's, built for another torch
        raise FetchError(
            f"lpips or torchvision cannot be loaded ({error}): install it from the index of torch"
        ) from None
    file = Path(lpips.__file__).parent / "weights" / "v0.1" / "alex.pth"
    try:
        lins = torch.load(file, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError) as error:
        raise FetchError(f"{file}: the package lpips has no such weights ({error}): install lpips 0.1.4") from None
    try:
        backbone = torchvision.models.alexnet(weights="IMAGENET1K_V1")
    except (OSError, RuntimeError) as error:  # no network, or a download that was cut short
        raise FetchError(f"torchvision cannot fetch AlexNet: {error}; is there a network?") from None
    return backbone.features.state_dict(), lins


def convert(features: Mapping[str, Any], lins: Mapping[str, Any], out: Path) -> list[Path]:
    """Write the two files into ``out``, check that they load and return their paths.

    features: torchvision's ``features`` of AlexNet, "0.weight" and so on.
    lins: the package's "lin0.model.1.weight" (1, C, 1, 1) and so on.
    Raises FetchError if they do not make a working LPIPS.
    """
    learned = {}
    for k in range(len(lins)):
        name = f"lin{k}.model.1.weight"
        if name not in lins:
            raise FetchError(f"the learned weights have no {name}: another version of lpips?")
        learned[f"lin{k}"] = np.asarray(lins[name], dtype=np.float32).reshape(-1)
    arrays = {f"features.{name}": np.asarray(value, dtype=np.float32) for name, value in features.items()}
    out.mkdir(parents=True, exist_ok=True)
    paths = [out / name for name in FILES]
    for path, content in zip(paths, (arrays, learned)):
        with path.open("wb") as file:
            np.savez(file, **content)  # type: ignore[arg-type]  # arrays by name, not its one option
    metric, missing = open_lpips(out)
    if metric is None:
        raise FetchError(str(missing))
    return paths
