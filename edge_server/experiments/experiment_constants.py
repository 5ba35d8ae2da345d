"""Numbers of experiments; those of engine and studies stand in their folders, of viewpoints in that of the server."""

from __future__ import annotations

from typing import Any

# --- scores in virtual time (virtual.simulate_command, virtual.now_and_all, virtual.truth, rollouts.rollout) ---
# ``simulate``: least time between two publications that are scored; what is shown is scored at a random instant in each
# such period.
SCORED_EVERY_MS = 250.0
CYCLE_MS = 250.0  # most between two decisions of ``simulate`` where updates follow a cycle
# The same period of random instants in ``compare``, ``frontier`` and trainings of running deployments.
SHOWN_EVERY_MS = 125.0
RESCORED_EVERY_S = 2.0  # between two times that the frames so far of moving held-out cameras are scored anew
# From then on these scores count: the first seconds are of a field that has seen next to nothing.
RESCORES_COUNT_FROM_S = 4.0
NOISE_FRAMES = 8  # frames of a real camera from which its noise is estimated, which bounds what moves

# --- runs in virtual time (virtual.simulate_command, virtual.from_scenario) ---
PROGRESS_EVERY_S = 1.0  # of virtual time, between two lines of progress of ``simulate``
# Encoded frames kept in memory: in virtual time a minute of nineteen cameras passes in seconds.
FRAME_CACHE_BYTES = 512 * 2**20

# --- ``compare`` (compare_command) ---
# Until what is shown counts, and for how long it does. Decisions have no effect until the layers of a field have begun.
COMPARE_LEAD_S, COMPARE_SPAN_S = 5.0, 8.0

# --- ``costs`` (virtual.costs_command) ---
COSTS_SHARES = (0.2, 0.6, 1.0)  # steps of an update, as shares of the scenario's, one run each
COSTS_SETTLED_SHARE = 0.5  # first share of a run's updates that is left out: they build the field
COSTS_SLOWEST_SHARE = 0.1  # share of updates that is left out, the slowest: the machine was busy
COSTS_EPOCH_MS = 40.0  # least time between two decisions

# --- intervals and verdicts over seeds, and figures (common.statistics, common.drawn_images, studies.verdicts) ---
RESAMPLES = 2000  # times that seeds are drawn anew for an interval
FEWEST_SEEDS = 5  # for resampling; fewer say too little about how seeds differ
FALSE_DISCOVERY_RATE = 0.05  # expected share of wrong verdicts among those that are decided
DRAWN_HEIGHT_PX = 220  # of an image in a figure of images side by side

# --- ``fit`` (fitting.fit, fitting.misfits, frontier.from_scratch) ---
# Seconds after which to evaluate: dense while a field learns fastest, then every 30 s. The last slice is at least this
# share of the whole: the learning rate falls within a slice, and a field needs a long one to converge.
FIT_MARKS_S, FIT_THEN_EVERY_S, FIT_LAST_SHARE = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0), 30.0, 0.4
SHORTEST_SLICE_S = 0.05  # of fitting; an evaluation that is due sooner is left out
SCORED_OF_TRAINING = 8  # training views that are scored if no view is held out
# A view is named that reads so many dB less than the median, and so many standard deviations of them all: some views
# of a recording are blurred or show more detail. What reads more than LOOKS_RIGHT_DB fits, whatever the others read.
MISFIT_DB, MISFIT_DEVIATIONS, LOOKS_RIGHT_DB = 6.0, 4.0, 30.0
MISFITS_NAMED = 5  # views that are named; of the others their number is said

# --- what is fitted to (scenes.multiview_still, scenes.recorded) ---
STILL_SIZE_PX = 128  # image width and height of a synthetic scene, before its scale
NAMED_VIEWS = 6  # views that an error names
# A pixel whose weight is larger is scored: undistortion and shrinking leave some that are masked in part.
LEAST_SCORED_WEIGHT = 0.5

# --- training of schedulers (rollouts.episode, rollouts.setting, training, studies.learning) ---
# Instants lie on a grid that contains MOVING_LAGS_MS of ``fidelity_constants``, so that evaluations share renderings of
# the truth: one costs ten times a score.
INSTANT_GRID_MS = 10
EPISODES, EPISODES_A_BATCH = 600, 10  # of a training; of one update of the policy
# Random instants of an episode at which something is decided, the last SPAN_MS of it after LEAD_MS; longest wait.
DECISIONS, LEAD_MS, SPAN_MS, HORIZON_MS = 4, 1000.0, 6000.0, 2000.0
ACTION_SAMPLES = 2  # actions that are tried at each decision
TRAINING_SIDE_PX = 64  # of the images of synthetic scenes
# The warm field of an episode: steps before the first decision, steps of an update where nothing says them, and how
# long before a decision it learns the newest frames.
WARM_STEPS, UPDATE_STEPS, REFRESH_MS = 150, 100, 300.0
TRUTHS_KEPT = 8192  # renderings of held-out cameras kept in memory
TRAINING_STEPS, SCRATCH_STEPS = 20, 50  # optimizer steps of an update; of one that starts with an empty field
# Options with which ``splat`` learns the small images of a training faster than with its defaults: half of its
# Gaussians, as many as an image of 64 x 64 has pixels.
QUICK_SPLAT: dict[str, Any] = {"gaussians": 4096, "start": 2048}
EVALUATION_FITS = 2  # fits of the field for each choice that is evaluated: their mean is less noisy than one
# Batches averaged in a point of the drawn learning curve: single ones differ by more than training changes them.
SMOOTHED_BATCHES = 9

# --- ``frontier`` (frontier.update_time, frontier.frontier_command) ---
FRONTIER_COSTS_S = 1.0  # of virtual time, in which costs are measured
FRONTIER_LEAD_S = 5.0  # of virtual time, until what is shown counts
LAYERS_S = 0.02  # shortest update time of layers, as used in scenarios with layers
STATIC_STEPS_PER_S = 250.0  # of the static field of layers, whose steps run on another core
