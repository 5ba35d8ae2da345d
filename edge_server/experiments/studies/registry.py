"""The studies by name, as ``edge-server study`` knows them. A new study is a ``Study`` and a line here."""

from __future__ import annotations

from edge_server.experiments.studies.age_curves import LAMBDA, MAT, MAT_DELAY
from edge_server.experiments.studies.depth_rate import DEPTH
from edge_server.experiments.studies.learned_schedulers import ABLATION, DRIFT, PPO_SELECT, PPO_WAIT, WEIGHTS
from edge_server.experiments.studies.metric_distortions import METRIC_DISTORTIONS
from edge_server.experiments.studies.preferences import PREFERENCES
from edge_server.experiments.studies.study import Study
from edge_server.experiments.studies.viewpoints import VIEWPOINTS
from edge_server.experiments.studies.waiting_curves import IMAGES, OMEGA, REPRESENTATIONS

_OF_TRIALS = (MAT, MAT_DELAY, LAMBDA, OMEGA, IMAGES, REPRESENTATIONS)
_OF_CAPTURES = (VIEWPOINTS, PREFERENCES)
_OF_LEARNING = (PPO_SELECT, PPO_WAIT, ABLATION, WEIGHTS, DRIFT)
STUDIES: dict[str, Study] = {
    study.name: study for study in (METRIC_DISTORTIONS, *_OF_TRIALS, DEPTH, *_OF_CAPTURES, *_OF_LEARNING)
}
# Studies of trials on a channel, which --channel replaces.
ON_A_CHANNEL = tuple(study.name for study in _OF_TRIALS)
# Studies of captures: they are not part of "all".
CAPTURING = tuple(study.name for study in _OF_CAPTURES)
# Studies that train: they take long and are not part of "all" either.
LEARNING = tuple(study.name for study in _OF_LEARNING)
# Studies of whole deployments, whose fields learn for seconds: not part of "all" either.
DEPLOYED = (DEPTH.name,)
# Studies that consist of cases: --case selects some of them.
CASED = tuple(name for name in LEARNING if name != WEIGHTS.name)
