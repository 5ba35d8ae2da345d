"""``freshfield check-plugin``: whether a class from outside, such as a policy, keeps the contract of its kind."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import itertools
import traceback
from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from freshfield import plugins
from freshfield.geometry import Pinhole, Pose, look_at
from freshfield.settings import ScenarioError, Settings, bare_type, read_settings

FAR = 1e300  # beyond what any parameter can mean; a product of two such numbers is infinite
HOUR_NS = 3600 * 10**9  # no policy waits longer
FRAMES = ((0, 0.0), (1, 0.04), (2**40, 1e9))  # numbers of frames and their seconds; the last is 30 years on
LENS = Pinhole.from_fov(16, 12, 60.0)
POSES = [look_at(eye, [0.0, 0.0, 0.0]) for eye in ([2.0, 0.0, 1.0], [0.0, 2.0, 1.0], [-2.0, 0.0, 1.0])]
NOISE = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8)
IMAGES = {"noisy": NOISE, "black": NOISE * 0, "white": NOISE * 0 + 255, "1 x 1": NOISE[:1, :1]}


@dataclasses.dataclass(frozen=True)
class Contract:
    """What is checked of one class."""

    make: Callable[..., Any]  # a fresh instance from a seed, and parameters by name
    cases: Mapping[str, Callable[[], Any]]  # makes the inputs of a case anew
    use: Callable[[Any, Any], Any]  # what an instance makes of a case's inputs; raises where it is wrong
    refused: Mapping[str, tuple[float, ...]]  # parameter -> values that ``make`` has to refuse by ValueError
    extra: Mapping[str, Callable[[Any], Any]] = dataclasses.field(default_factory=dict)  # given ``make``; raise

    def outcomes(self) -> Iterator[tuple[str, str]]:
        """Each check and what failed of it: empty if nothing did. Without an instance it ends."""
        checks: dict[str, Callable[[], Any]] = {"is constructed": partial(self.make, 1)}
        checks |= {case: partial(self.check_case, case) for case in self.cases}
        checks |= {f"{key} out of range is refused": partial(self.check_refused, key) for key in self.refused}
        checks |= {check: partial(run, self.make) for check, run in self.extra.items()}
        for number, (check, run) in enumerate(checks.items()):
            failed = ""
            try:
                run()
            except AssertionError as error:
                failed = str(error)
            except Exception as error:  # whatever the code of others raises
                at = traceback.extract_tb(error.__traceback__)[-1]
                failed = f"{type(error).__name__}: {error} ({Path(at.filename).name}, line {at.lineno})"
            yield check, failed
            if failed and number == 0:
                return

    def check_case(self, case: str) -> None:
        """Answers are right, repeat bit for bit, and leave the inputs as they were."""
        inputs = self.cases[case]()
        before, answers = content(inputs), content(self.use(self.make(1), inputs))
        expect(content(inputs) == before, "an input was changed; copy arrays and mappings before you write to them")
        repeated = content(self.use(self.make(1), self.cases[case]()))
        expect(answers == repeated, "two runs differ; draw only from the rng or seed given")

    def check_refused(self, key: str) -> None:
        for value in self.refused[key]:
            with contextlib.suppress(ValueError):
                self.make(1, **{key: value})
                raise AssertionError(f"{value:g} is accepted; give its annotation bounds, or raise ValueError")


def expect(kept: object, text: str) -> None:
    """Raise AssertionError unless ``kept``. text: what was found, and how to mend it."""
    if not kept:
        raise AssertionError(text)


def expect_like(what: str, value: Any, example: Any) -> None:
    """Expect a value of the example's type; an array also of its dtype and shape, and finite."""
    shown, wanted = (
        f"array {each.dtype} {each.shape}" if isinstance(each, np.ndarray) else type(each).__name__
        for each in (value, example)
    )
    expect(shown == wanted, f"{what}: expected {wanted}, got {shown}")
    expect(not isinstance(value, float | np.ndarray) or np.isfinite(value).all(), f"{what}: a value is not finite")


def content(value: Any) -> Any:
    """A value to compare bit for bit: arrays by type, shape and bytes; dataclasses by their public fields."""
    if isinstance(value, np.ndarray):
        return str(value.dtype), value.shape, value.tobytes()
    if dataclasses.is_dataclass(value):
        return [content(getattr(value, f.name)) for f in dataclasses.fields(value) if not f.name.startswith("_")]
    if isinstance(value, Mapping):
        return [(key, content(each)) for key, each in value.items()]
    return [content(each) for each in value] if isinstance(value, list | tuple) else value


def numbers(model: type[Settings], base: type[Settings] = Settings) -> dict[str, tuple[float, ...]]:
    """The numbers among the parameters, without those of ``base``, and values that each has to refuse."""
    own = [f for f in msgspec.structs.fields(model) if f.name not in base.__struct_fields__]
    return {f.name: (-FAR, FAR) for f in own if bare_type(f.type) in (int, float)}


def views(image: Any) -> list[Any]:
    """A view of each of three cameras that show an image, 2 m away everywhere."""
    from edge_server.fields import View

    lens, depth_m = Pinhole.from_fov(image.shape[1], image.shape[0], 60.0), np.full(image.shape[:2], 2.0, np.float32)
    return [View(f"cam{i}", image.copy(), pose, lens, i, None, depth_m.copy()) for i, pose in enumerate(np.copy(POSES))]


def policy(name: str) -> Contract:
    from edge_server.scheduler import POLICIES, Epoch, SelectionWindow, make_policy
    from edge_server.scheduler.learned.state import State

    def make(seed: int, value: float | None = None) -> Any:
        return make_policy(name, value, np.random.default_rng(seed))

    def epochs(rows: Any) -> list[tuple[Epoch, Epoch]]:
        """For each row of ages, ms: an epoch to plan at and, an hour later, one to select at."""
        made = []
        for number, ages in enumerate(rows):
            now_ns = 2 * HOUR_NS * (number + 1)
            times = {f"cam{i}": now_ns - round(age * 1e6) for i, age in enumerate(ages)}
            rig = State(np.array(ages), np.zeros((len(ages), 6)), None, np.ones(len(ages), bool), tuple(times))
            before = Epoch(now_ns - HOUR_NS, number, {}, lambda parts=(), rig=rig: rig)
            made.append((before, dataclasses.replace(before, now_ns=now_ns, generated_ns=times, received_ns={**times})))
        return made

    def use(made: Any, given: list[tuple[Epoch, Epoch]]) -> Any:
        answers = []
        for before, then in given:
            window, there = made.plan(before), {*then.generated_ns}
            expect_like("plan", window, SelectionWindow())
            expect(window.wait_until_ns <= then.now_ns, "plan: it waits for more than an hour")
            chosen = made.select(then, window)
            expect(isinstance(chosen, tuple), f"select: expected a tuple of cameras, got {type(chosen).__name__}")
            # A policy may wait for a second camera, but not for ever.
            right = len(there & {*chosen}) == len(chosen) and len(chosen) >= (len(there) > 1)
            expect(right, f"select: expected cameras, one at least, out of {sorted(there)}, got {chosen!r}")
            answers.append((window, chosen))
        return answers

    cases = {
        "six cameras": partial(epochs, np.random.default_rng(0).uniform(0, 1000, (20, 6))),
        "no frame yet": partial(epochs, [[]]),
        "one camera": partial(epochs, [[100.0]]),
        "frames of now, of the future, very old": partial(epochs, [[0.0, -500.0, 1.8e6]]),
    }
    found = POLICIES[name][0] if name in POLICIES else plugins.find("policy", name, POLICIES)
    return Contract(make, cases, use, {"value": (-1.0, float("nan"))} if getattr(found, "parameter", None) else {})


def effect(name: str) -> Contract:
    from camera_node.synthetic.effects import effect_class

    found, parts = effect_class(name), attrgetter("image", "camera_to_world", "intrinsics", "depth")

    def use(made: Any, given: list[Any]) -> Any:
        shown, pose, lens, depth_m = parts(given[0])
        kinds: dict[str, tuple[Callable[[int, float], Any], Any]] = {  # kind -> asks about a frame, a right answer
            "image": (lambda i, t: made.apply(shown, i, t), shown),
            "clock": (lambda i, t: made.node_ns(round(t * 1e9)), 0),
            "pose": (lambda i, t: made.reported(Pose.from_matrix(pose), i, t).matrix(), pose),
            "delay": (lambda i, t: made.instant_s(t), 0.0),
            "mount": (lambda i, t: made.placed(pose, t), pose),
            "depth": (lambda i, t: made.measure(depth_m, shown, lens, i).counts, depth_m.astype(np.uint16)),
        }
        ask, example = kinds[found.kind]
        answers = [ask(*frame) for frame in FRAMES]
        for answer in answers:
            expect_like(found.kind, answer, example)
        return answers

    def make(seed: int, **given: Any) -> Any:
        return read_settings(found, given, f"effect {name}").start(np.random.default_rng(seed))

    cases = {f"a {case} image": partial(views, image) for case, image in IMAGES.items()}
    return Contract(make, cases, use, numbers(found))


def fault(name: str) -> Contract:
    from channel_emu.model import faults
    from channel_emu.model.link import MAX_SIZE_BYTES, Transit

    found, right = faults.params_class(name), {"extra_ns": 0, "loses": True, "duplicates": True, "flips": ()}

    def make(seed: int, **given: Any) -> Any:
        return faults.make({name: read_settings(found, given, f"fault {name}")}, seed, "cam01")[0]

    def messages(size: int) -> list[Transit]:
        return [Transit(i, None, size, t, t, t, t + 10**7) for i, t in enumerate(range(0, 10**9, 10**7))]

    def use(made: Any, given: list[Transit]) -> Any:
        expect_like("next_reset_ns", made.next_reset_ns(-1), 0)
        answers = [[getattr(made, method)(transit) for method in right] for transit in given]
        for answer in answers:
            for method, value in zip(right, answer):
                expect_like(method, value, right[method])
            expect(answer[0] >= 0, f"extra_ns: expected nanoseconds from 0, got {answer[0]}")
        return answers

    def any_order(make: Callable[..., Any]) -> None:
        same = use(make(1), messages(5000)) == use(make(1), messages(5000)[::-1])[::-1]
        expect(same, "draw by the number of the offer (channel_emu.model.counter_rng)")

    sizes = {"usual messages": 5000, "empty messages": 0, "the largest messages": MAX_SIZE_BYTES}
    refused = {key: (-FAR,) for key in numbers(found)}  # no delay or rate is too large: a link ends at NEVER_NS
    extra = {"does not depend on the order of questions": any_order}
    return Contract(make, {case: partial(messages, size) for case, size in sizes.items()}, use, refused, extra)


def field(name: str) -> Contract:
    from edge_server.fields import Budget, FitReport
    from edge_server.fields.common.settings import FieldSettings
    from edge_server.fields.registry import make_field, settings_of

    def use(made: Any, given: list[Any]) -> Any:
        expect_like("fit", made.fit(given, Budget(steps=1)), FitReport(0, 0.0, 0.0, 0, 0))
        return [shown(each) for each in (made, made.snapshot(), made.snapshot().at(5))] if given else []

    def shown(renderer: Any) -> Any:
        out = renderer.render(POSES[0], LENS)
        for what, like in (("color", NOISE), ("depth", NOISE[..., 0]), ("opacity", NOISE[..., 0])):
            values = getattr(out, what)
            expect_like(what, values, like.astype(np.float32))
            expect(values.min() >= 0 and (what == "depth" or values.max() <= 1), f"{what}: below 0, or above 1")
        return content(out)

    def goes_on(make: Callable[..., Any]) -> None:
        first, second = make(1), make(1)
        use(first, views(NOISE))
        second.load_state(first.state())
        snapshot, before = first.snapshot(), shown(first)
        expect(shown(second) == before, "load_state: it renders something else than the field of that state")
        use(first, views(NOISE * 0))
        expect(shown(snapshot) == before, "snapshot: it changes with the field; copy what it renders from")
        with contextlib.suppress(ValueError):
            second.load_state({"of another field": np.zeros(3)})
            raise AssertionError("load_state: the state of another field is accepted; raise ValueError")

    cases: dict[str, Any] = {"no view": list, "one camera": lambda: views(NOISE)[:1]}
    cases |= {f"three {case} images": partial(views, image) for case, image in IMAGES.items()}
    refused = numbers(type(settings_of(name)), FieldSettings)
    extra = {"snapshots stay and states go on": goes_on}
    return Contract(lambda seed, **given: make_field(name, given, seed), cases, use, refused, extra)


def selector(name: str) -> Contract:
    from edge_server.fields import Budget, Field, View
    from edge_server.fields.registry import FIELD, make_field
    from edge_server.viewpoints.candidates import half_hemisphere
    from edge_server.viewpoints.registry import CaptureState, make_selector

    def fitted(seen: list[View]) -> Field:
        made = make_field(FIELD)
        made.fit(seen, Budget(steps=1))
        return made

    def capture(count: int, captured: int) -> CaptureState:
        candidates = half_hemisphere([0.0, 0.0, 0.0], 2.0, LENS, count)
        seen = [View(f"v{i}", NOISE.copy(), candidates.poses[i], LENS, i) for i in range(captured)]
        state = CaptureState(candidates, count, np.random.default_rng(0), fitted, list(range(captured)), seen)
        state.open[:captured] = False
        return state

    def use(made: Any, state: CaptureState) -> Any:
        values = made.values(state)
        expect(np.shape(values) == state.open.shape, f"values: expected one a candidate, got {np.shape(values)}")
        expect_like("values of open candidates", values[state.open], np.zeros(state.open.sum()))
        return made.name, values

    cases = {"nothing captured": partial(capture, 8, 0), "one candidate": partial(capture, 1, 0)}
    cases |= {"half captured": partial(capture, 8, 4), "all captured": partial(capture, 8, 8)}
    return Contract(lambda seed: make_selector(name), cases, use, {})


def source(name: str) -> Contract:
    from camera_node.capture import Camera, ShotCache
    from camera_node.settings import FPS_RANGE, MODELS, SourceConfig, own_class, source_config
    from camera_node.sources.base import Shot
    from camera_node.sources.registry import open_sources
    from freshfield.scenario import parse

    if name in MODELS:
        raise plugins.PluginError(f"source {name} is built in: its tests are the project's; one of your own is checked")
    keys = own_class(name)[1]

    def make(seed: int, **given: Any) -> Any:
        told = {"cameras": {"count": 2}, "seed": seed, "source": {"kind": name, **given}}
        scenario = parse(plugins.absolute(told, Path()), Path("check-plugin"))
        config = source_config(scenario)
        opened = open_sources(scenario, config, scenario.cameras)
        return {camera: Camera(each, config, ShotCache(0), depth_every=1) for camera, each in opened.items()}

    def use(made: Any, ticks: Any) -> Any:
        answers = {}
        for tick, (asked, camera) in itertools.product(ticks, made.items()):
            own = camera.source
            expect(own.camera == asked, "camera: not the one of the call")
            right = isinstance(own.fps, Fraction) and FPS_RANGE[0] <= own.fps <= FPS_RANGE[1]
            expect(right, f"fps: expected a Fraction, {FPS_RANGE[0]} to {FPS_RANGE[1]:g}, got {own.fps!r}")
            expect(isinstance(own.intrinsics, Pinhole), "intrinsics: expected a freshfield.geometry.Pinhole")
            number = own.content(tick)
            expect(number in range(own.contents or 2**63), f"content: expected 0 to contents - 1, got {number!r}")
            shot = own.read(number)
            right = isinstance(shot, Shot) and isinstance(shot.pose, Pose)
            expect(right, f"read: expected a Shot with a Pose, got {type(shot).__name__}")
            sent = camera.shot(number)  # raises ValueError for what cannot be sent
            expect(not camera.depth_failed, "depth: it cannot be sent; the log says why")
            answers[own.camera, tick] = content((sent.payload, sent.pose.matrix(), sent.encoded_depth))
        return None if keys.waits else sorted(answers.items())

    def any_order(make: Callable[..., Any]) -> None:
        same = use(make(1), range(4)) == use(make(1), range(3, -1, -1))
        expect(same, "a shot depends on those read before: captures are skipped where time is short")

    cases: dict[str, Any] = {"the first frames": lambda: range(4), "a frame after a year": lambda: [2**30]}
    return Contract(make, cases, use, numbers(keys, SourceConfig), {"does not depend on the order of reads": any_order})


CONTRACTS = {"source": source, "policy": policy, "effect": effect, "fault": fault, "field": field, "selector": selector}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``freshfield check-plugin``."""
    parser.add_argument("kind", choices=tuple(CONTRACTS), metavar="KIND", help=f"one of {', '.join(CONTRACTS)}")
    parser.add_argument("name", metavar="NAME", help="FILE.py:CLASS, MODULE:CLASS, or the name of an entry point")
    parser.add_argument("parameters", nargs="*", metavar="KEY=VALUE", help="of it; not given: its defaults")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print one line a check. Returns 1 if one failed."""
    found = CONTRACTS[args.kind](args.name)
    try:
        given = {key: yaml.safe_load(value) for key, _, value in (each.partition("=") for each in args.parameters)}
    except yaml.YAMLError as error:
        raise ScenarioError(f"parameters: expected KEY=VALUE: {' '.join(str(error).split())}") from None
    outcomes = list(dataclasses.replace(found, make=partial(found.make, **given)).outcomes())
    for check, failed in outcomes:
        print(f"FAILED  {check}: {failed}" if failed else f"ok      {check}")
    return int(any(failed for _, failed in outcomes))
