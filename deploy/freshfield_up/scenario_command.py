"""``freshfield scenario``: list, show, start and check scenario files, and tell their keys."""

from __future__ import annotations

import argparse
import json
import re
import shutil
from pathlib import Path

from freshfield import plugins
from freshfield.frame import valid_id
from freshfield.scenario import SCENARIO_FOLDER, Scenario, ScenarioError, load


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The commands below ``freshfield scenario``."""
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    shipped = commands.add_parser("list", help="the shipped scenarios, and which of them need recorded data")
    shipped.set_defaults(run=_list)
    show = commands.add_parser("show", help="print a scenario file")
    show.add_argument("scenario", help="the name of a shipped one, or a file")
    show.set_defaults(run=_show)
    init = commands.add_parser("init", help="write a scenario file of your own, to edit")
    init.add_argument("file", type=Path, help="the file to write, mine.yaml; an existing one is refused")
    init.add_argument("--like", default="room", metavar="NAME", help="the shipped scenario to start from [%(default)s]")
    init.set_defaults(run=_init)
    check = commands.add_parser("check", help="read every section of a file; opens no data, camera or port")
    check.add_argument("scenario", help="file, or the name of a shipped one")
    check.set_defaults(run=_check)
    keys = commands.add_parser("keys", help="what a section may say: keys, bounds, defaults")
    keys.add_argument("section", nargs="?", help="cameras, source, effects, channel, faults or edge [all]")
    keys.add_argument("name", nargs="?", help="one source, effect, fault, field or policy, also one of your own [all]")
    keys.set_defaults(run=_keys)
    schema = commands.add_parser("schema", help="print the JSON Schema of scenario files, for editors")
    schema.set_defaults(run=_schema)


def _list(_: argparse.Namespace) -> int:
    for file in sorted(SCENARIO_FOLDER.glob("*.yaml")):
        scenario = load(file)
        data = scenario.source.get("data")
        print(f"{scenario.name:12} {scenario.description}{f' [--data: {data}]' if data else ''}")
    return 0


def _show(args: argparse.Namespace) -> int:
    print(load(args.scenario).path.read_text(encoding="utf-8"), end="")
    return 0


def _has_files_of(folder: Path, shipped: Path) -> bool:
    return all((folder / file.relative_to(shipped)).is_file() for file in shipped.rglob("*") if file.is_file())


def _init(args: argparse.Namespace) -> int:
    model = load(args.like)
    name = args.file.stem
    if args.file.suffix != ".yaml" or not valid_id(name):
        raise ScenarioError(f"{args.file}: expected a name of letters, digits, '.', '_' and '-' that ends in .yaml")
    text = model.path.read_text(encoding="utf-8")
    folders = []  # of files that the scenario names
    if model.path.parent == SCENARIO_FOLDER:
        folders = [folder for folder in SCENARIO_FOLDER.iterdir() if folder.is_dir() and f" {folder.name}/" in text]
        # Those of an earlier file, which may have been changed, serve this one as well.
        folders = [folder for folder in folders if not _has_files_of(args.file.parent / folder.name, folder)]
    for target in (args.file, *(args.file.parent / folder.name for folder in folders)):
        if target.exists():
            raise ScenarioError(f"{target}: exists; choose another name or folder, or remove it first")
    args.file.parent.mkdir(parents=True, exist_ok=True)
    for folder in folders:
        shutil.copytree(folder, args.file.parent / folder.name)
    args.file.write_text(re.sub(r"(?m)^name: .*$", f'name: "{name}"', text), encoding="utf-8")
    step = f"freshfield scenario check {args.file}"
    if model.source.get("data") == "rig.json":  # a video's calibration
        step = "camera-node calibrate rig (its first lines say how)"
    print(f"wrote {args.file}, like {model.name}; next: {step}")
    return 0


def _check(args: argparse.Namespace) -> int:
    print("\n".join(checked(load(args.scenario))))
    return 0


def checked(scenario: Scenario) -> list[str]:
    """What each package makes of its section, a line each. Raises ScenarioError."""
    from camera_node.settings import LiveConfig, WorldConfig, errors_of, source_config
    from camera_node.sources.with_effects import camera_effects
    from camera_node.synthetic import make_scene
    from channel_emu.model.settings import channel_from_mapping

    source = source_config(scenario)
    for camera in scenario.cameras:
        camera_effects(scenario, source, camera)
    if isinstance(source, WorldConfig):
        with errors_of(f"{scenario.path}: source"):
            make_scene(source.scene, {"count": len(scenario.cameras), **source.scene_parameters()})
    if isinstance(source, WorldConfig | LiveConfig) and source.arm is not None:
        from camera_node.robot.arm.camera_poses import arm_model, load_hand_eyes

        load_hand_eyes(scenario, source.arm, scenario.cameras)
        arm_model(scenario, source.arm)
    if isinstance(source, LiveConfig) and source.trajectory is not None:
        from camera_node.pose.trajectories import flange_mount

        flange_mount(scenario, source.trajectory, scenario.path.parent)
    channel = channel_from_mapping(
        scenario.channel, f"{scenario.path}: channel", scenario.path.parent, scenario.cameras
    )
    try:
        from edge_server.fields.registry import settings_of
        from edge_server.scheduler import make_policy
        from edge_server.settings import cameras_move, described, read_config
    except ImportError as error:
        raise ScenarioError(f"edge: not checked, {error.name} is missing: install the extra edge") from None
    edge = read_config(scenario)
    with errors_of(f"{scenario.path}: edge.field"):
        settings_of(edge.field, edge.field_options)
    with errors_of(f"{scenario.path}: edge.policy"):
        make_policy(edge.policy.name, edge.policy.value, scenario.rng("policy"))
    held = f", {', '.join(scenario.held_out)} held out" if scenario.held_out else ", none held out"
    states = f", states {', '.join(channel.state_names)}" if channel.chain else ""
    effects = f" with {', '.join(source.effects)}" if source.effects else ""
    moving = "a camera" if cameras_move(scenario) else ""
    link = channel.preset if "preset" in scenario.channel or not scenario.channel else "its own"
    return [
        f"{scenario.path}: valid",
        f"  cameras  {len(scenario.cameras)}{held}",
        f"  source   {plugins.short_name(source.kind)}{effects}",
        f"  channel  {link}: mean delay {channel.mean_delay_ms:.3g} ms{states}",
        f"  edge     {described(scenario, edge, moving)}",
    ]


def _keys(args: argparse.Namespace) -> int:
    from freshfield_up import scenario_keys

    print(scenario_keys.text(args.section, args.name))
    return 0


def _schema(_: argparse.Namespace) -> int:
    from freshfield_up import scenario_keys

    print(json.dumps(scenario_keys.schema(), indent=2))
    return 0
