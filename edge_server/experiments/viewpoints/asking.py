"""``edge-server viewpoints --ask``: comparisons by a person on the page, or by a simulated expert."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from edge_server.experiments.common.arguments import OptionError
from edge_server.experiments.viewpoints import capture_constants as tuned
from edge_server.experiments.viewpoints.reconstructions import identity, sprites, taste_score, varied_plans
from edge_server.experiments.viewpoints.stage import Stage
from edge_server.progress import ProgressLine
from edge_server.viewpoints.candidates import ViewpointError
from edge_server.viewpoints.experts import SimulatedExpert
from edge_server.viewpoints.features import StepFeatures
from edge_server.viewpoints.preference_session import PERSON, PreferenceSession
from freshfield.files import write_json
from freshfield.transport import Transport
from freshfield.untrusted import read_bytes

ANSWERS = "answers.json"
ShowPlan = Callable[[list[str], bytes], None]


def compare(
    stage: Stage,
    who: str,
    *,
    views: int,
    count: int,
    questions: int,
    steps: int,
    seed: int,
    out: Path,
    page: tuple[str, int],
    transport: Transport,
) -> tuple[PreferenceSession, ShowPlan | None]:
    """Run a session until it is finished; returns it and, with a page, the function that shows the plan
    there. It continues from OUT/answers.json, which is written after each answer.

    who: PERSON, or the taste of a simulated expert.
    views: number of views of each reconstruction. count: number of reconstructions. questions: their number.
    steps: optimizer steps of each fit.
    page: host and port.
    Raises ViewpointError for answers of another session, and OptionError or TransportError if the page cannot
    be served.
    """
    plans = varied_plans(stage, count, views, seed)
    features_of = StepFeatures(stage.candidates)
    orders = tuple(tuple(plan.order) for plan in plans)
    features = np.array([features_of.trajectory(order) for order in orders])
    by = PERSON if who == PERSON else SimulatedExpert(who, np.zeros(0), np.random.default_rng()).label
    made_of = identity(stage, plans, steps, seed)
    session = PreferenceSession(stage.name, orders, features, questions, seed, by, made_of=made_of)
    path = out / ANSWERS
    if path.exists():
        try:
            session = session.imported(read_bytes(path))
        except (OSError, ViewpointError) as error:
            raise ViewpointError(f"{path}: {error}; move it away, or name another --out") from None
    if who == PERSON:
        progress = ProgressLine(sys.stderr)
        with progress.running("reconstructions"):
            made = sprites(
                stage,
                plans,
                steps,
                seed,
                out / "reconstructions",
                lambda k: progress("reconstructions", (k + 1) / len(plans)),
            )
        return _on_the_page(session, made, path, page, transport)
    print(f"{len(plans)} reconstructions are made and compared by a {by}", flush=True)
    scores = [taste_score(stage, stage.fit(plan.views, steps, seed), who) for plan in plans]
    expert = SimulatedExpert(who, np.array(scores), np.random.default_rng(seed))
    while (asked := session.question) is not None:
        first = expert.answer(asked.left, asked.right).prefers_first
        session = session.answered("left" if first else "right")
        write_json(path, session.as_json())
    return session, None


def check_page(page: tuple[str, int], transport: Transport) -> None:
    """OptionError or TransportError where a page cannot be served there: said before the fits, which take minutes."""
    from edge_server.page import PageError, check_port

    transport.guard(page[0], "preference page", http=True)
    try:
        check_port(page[0].strip("[]"), page[1])
    except PageError as error:
        raise OptionError(str(error)) from None


def _on_the_page(
    session: PreferenceSession, made: list[bytes], path: Path, page: tuple[str, int], transport: Transport
) -> tuple[PreferenceSession, ShowPlan]:
    """made: pictures of the reconstructions. path: of the answers."""
    from edge_server.page.preferences import PageError, PreferencePage

    asking = PreferencePage(
        session, made, tuned.PATH_FRAMES, tuned.PATH_COLUMNS, lambda s: write_json(path, s.as_json())
    )
    try:
        url, close = asking.serve(*page, transport)
    except PageError as error:
        raise OptionError(str(error)) from None
    print(f"compare at {url}; Ctrl-C stops, and the next call goes on", flush=True)
    asking.finished.wait()

    def show(lines: list[str], png: bytes) -> None:
        asking.show_plan(lines, png)
        asking.seen.wait(tuned.PLAN_SHOWN_S)
        close()

    return asking.session, show
