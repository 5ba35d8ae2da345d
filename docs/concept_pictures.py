"""The pictures of concepts.md, from real runs in virtual time: ``python docs/concept_pictures.py``, some minutes."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from channel_emu.model.link import EventKind
from channel_emu.model.settings import channel_from_mapping
from channel_emu.virtual.simulate import simulate
from edge_server.experiments.virtual.from_scenario import build_deployment
from edge_server.experiments.virtual.simulate import usual_settings
from edge_server.experiments.virtual.virtual_deployment import VirtualDeployment
from edge_server.fidelity.scorer import Scorer
from edge_server.fields.splat.kernels.project import Gaussians
from edge_server.settings import ComputeConfig, read_config
from freshfield.scenario import load

FOLDER = Path(__file__).parent / "concepts"
SEED = 7
CAPTURED, NETWORK, COMPUTING, SHOWN = "#555555", "#1f77b4", "#ff7f0e", "#2ca02c"


def draw_age(file: Path) -> None:
    """The age of the newest frame that arrived, of one camera behind preset ch5, over a second."""
    run = simulate(channel_from_mapping({"preset": "ch5"}), 1, 1.2, SEED).runs[0]
    came = [t for t in run.transits if t.outcome is EventKind.DELIVERED]
    figure, axis = plt.subplots(figsize=(8.5, 3.2), layout="constrained")
    instants, ages, newest = [], [], None
    for each in came:
        at = (each.ended_ns or 0) / 1e6
        if newest is not None:
            instants.append(at)
            ages.append(at - newest)
        newest = each.offered_ns / 1e6
        instants.append(at)
        ages.append(at - newest)
    axis.plot(instants, ages, color=NETWORK, label="age of what the edge knows")
    axis.plot(
        [t.offered_ns / 1e6 for t in came], [0] * len(came), "^", color=SHOWN, label="captured, and delivered later"
    )
    lost = [t.offered_ns / 1e6 for t in run.transits if t.outcome is EventKind.DROPPED_BUSY]
    axis.plot(lost, [0] * len(lost), "x", color=CAPTURED, label="captured, but dropped: the link was busy")
    axis.set(xlim=(0, 1000), ylim=(-12, None), xlabel="time, ms", ylabel="age, ms")
    figure.legend(loc="outside upper center", ncols=3, fontsize=8)
    figure.savefig(file, dpi=110)


def deployment_of(scenario_name: str, compute: ComputeConfig, seconds: float) -> VirtualDeployment:
    """A deployment after so many seconds of virtual time."""
    scenario = load(scenario_name, SEED)
    settings = dataclasses.replace(usual_settings(read_config(scenario)), compute=compute)
    deployment = build_deployment(scenario, settings, scorer=Scorer(None))
    deployment.run(seconds)
    return deployment


def draw_virtual_time(file: Path, runs: dict[str, VirtualDeployment]) -> None:
    """What some publications have behind them: capture, network, waiting, computing; and until when each is shown."""
    figure, axes = plt.subplots(len(runs), 1, figsize=(8.5, 5.4), sharex=True, layout="constrained")
    for axis, (title, deployment) in zip(axes, runs.items()):
        found = [p for p in deployment.publications if p.ages_ms][-8:]
        start = found[0].published_ns - 1e6 * 400
        for row, (each, after) in enumerate(pairwise(found)):
            published, following = ((p.published_ns - start) / 1e6 for p in (each, after))
            captured, decided = published - np.array(each.ages_ms), published - each.update_ms
            axis.plot(captured, [row] * len(captured), "^", color=CAPTURED, markersize=4)
            axis.barh(row, decided - captured.min(), left=captured.min(), height=0.35, color=NETWORK, alpha=0.5)
            axis.barh(row, published - decided, left=decided, color=COMPUTING)
            axis.barh(row, following - published, left=published, color=SHOWN)
        axis.set(title=title, ylabel="publication", yticks=[])
        axis.invert_yaxis()
    parts = {"captures that it uses": CAPTURED, "network and waiting": NETWORK, "computing": COMPUTING, "shown": SHOWN}
    handles = [plt.Rectangle((0, 0), 1, 1, color=color) for color in parts.values()]
    figure.legend(handles, list(parts), loc="outside lower center", ncols=4)
    axes[-1].set_xlabel("virtual time, ms")
    figure.savefig(file, dpi=110)


def draw_layers(file: Path, deployment: VirtualDeployment) -> None:
    """What a held-out camera shows: the static field, the moving set, both, and the truth."""
    snapshot: Any = deployment.shown_now()
    truth: Any = deployment.truth
    now_ns = deployment.clock.now_ns()
    image, lens, pose = truth.view(next(iter(truth.cameras)), now_ns)
    count, degree = len(snapshot.static), snapshot.gaussians.sh_degree
    parts = {"static field": snapshot.gaussians.params[:count], "moving set": snapshot.gaussians.params[count:]}
    pictures = {
        name: dataclasses.replace(snapshot, gaussians=Gaussians(params, degree)).render(pose, lens).color
        for name, params in parts.items()
    }
    pictures |= {"both: what is shown": snapshot.render(pose, lens).color, "the truth, never trained on": image}
    figure, axes = plt.subplots(1, 4, figsize=(8.5, 2.5), layout="constrained")
    for axis, (title, picture) in zip(axes, pictures.items()):
        axis.imshow(picture)
        axis.set_title(title, fontsize=9)
        axis.axis("off")
    figure.savefig(file, dpi=110)


def main() -> None:
    """Write all pictures."""
    FOLDER.mkdir(exist_ok=True)
    draw_age(FOLDER / "age.png")
    charged = deployment_of("room", ComputeConfig(ms_per_update=40.0), 5.0)
    runs = {"computing is free": deployment_of("room", ComputeConfig(), 2.0), "an update is charged 40 ms": charged}
    draw_virtual_time(FOLDER / "virtual-time.png", runs)
    draw_layers(FOLDER / "layers.png", charged)


if __name__ == "__main__":
    main()
