"""The studies by name, as ``edge-server study`` knows them. A new study is a ``Study`` and a line here."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from edge_server.experiments.studies.study import Study

# name -> (module, name of the study in it, one line of help)
STUDIES = {
    "metrics": (
        "metric_distortions",
        "METRIC_DISTORTIONS",
        "figure 3.6: what PSNR, SSIM and LPIPS say of three artifacts",
    ),
    "mat": ("age_curves", "MAT", "figures 5.6, 5.7: fidelity against the maximum age of used views"),
    "mat-delay": ("age_curves", "MAT_DELAY", "figure 5.8: the best maximum age against the mean delay"),
    "lambda": ("age_curves", "LAMBDA", "equation 5.8: fidelity against the weight of timeliness"),
    "omega": ("waiting_curves", "OMEGA", "figures 6.3, 6.4: threshold and wait in all readings, by traffic and queue"),
    "images": ("waiting_curves", "IMAGES", "figures 6.5, 6.6: LPIPS and age against the number of images"),
    "representations": (
        "waiting_curves",
        "REPRESENTATIONS",
        "figure 6.7: the same trade-off with other representations",
    ),
    "phase": ("trade_map", "PHASE", "where the trade-off exists: speed x delay x memory x compute"),
    "viewpoints": (
        "viewpoints",
        "VIEWPOINTS",
        "tables 4.1, 4.3, figures 4.7, 4.8: which views to take of a still object",
    ),
    "preferences": (
        "preferences",
        "PREFERENCES",
        "figure 4.6, tables 4.2, 4.3: what simulated experts' preferences teach",
    ),
    "ppo-select": ("learned_schedulers", "PPO_SELECT", "figure 5.9: a scheduler that learns which views to use"),
    "ppo-wait": (
        "learned_schedulers",
        "PPO_WAIT",
        "figure 6.8: a scheduler that learns how long to wait, or a maximum age",
    ),
    "ablation": ("learned_schedulers", "ABLATION", "how much ages, poses and semantics in the state contribute"),
    "weights": (
        "learned_schedulers",
        "WEIGHTS",
        "policies learned with other weights of the reward, judged by all of them",
    ),
    "drift": ("learned_schedulers", "DRIFT", "the channel changes: policies learned before and afterwards"),
    "semantics": ("learned_schedulers", "SEMANTICS", "where image embeddings in the state help, and where they cost"),
}
# Studies that train: they take long and are not part of "all".
LEARNING = tuple(name for name, (module, *_) in STUDIES.items() if module == "learned_schedulers")
# Studies of captures: they are not part of "all" either.
CAPTURING = ("viewpoints", "preferences")
# Studies that consist of cases: --case selects some of them.
CASED = ("ppo-select", "ppo-wait", "ablation", "drift", "semantics")
# Studies of trials on a channel, which --channel replaces.
ON_A_CHANNEL = ("mat", "mat-delay", "lambda", "omega", "images", "representations", "phase")


def make_study(name: str) -> Study:
    """The study of that name."""
    module, attribute, _ = STUDIES[name]
    study: Study = getattr(importlib.import_module(f"edge_server.experiments.studies.{module}"), attribute)
    return study
